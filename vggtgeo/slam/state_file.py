"""The state of the pipeline as a file: `step` goes on from it as from the state that was saved, to the last bit.

Everything is stored, also what could be made again (the view of the reference, the last window's problem): that needs
the poses and the camera of the moment when it was made, which are gone, and costs more to compute than to read.
A window that is adjusted beside tracking is waited for, and its result is stored apart: it is taken up at the frame at
which it is due.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import jaxlie

from vggtgeo.bundle.padding import SlotIndex
from vggtgeo.bundle.problem import Edges, Problem, State
from vggtgeo.bundle.terms.baseline import BaselinePrior
from vggtgeo.bundle.terms.depth import DepthPrior
from vggtgeo.bundle.terms.intrinsics import IntrinsicsPrior
from vggtgeo.bundle.terms.line import LineTerm
from vggtgeo.bundle.terms.marginal import MarginalPrior
from vggtgeo.bundle.terms.point import PointTerm
from vggtgeo.bundle.terms.relative_pose import RelativePose, SurfaceAlignment
from vggtgeo.bundle.terms.rotation import RotationPrior
from vggtgeo.geometry.camera import Camera
from vggtgeo.geometry.cameras import Pinhole
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import path_of
from vggtgeo.io.record_file import AGAIN, Header, Layout
from vggtgeo.io.records import by_name, with_field
from vggtgeo.models.classical.pixel_matcher import PixelDescriptors
from vggtgeo.models.onnx.fit import Fit
from vggtgeo.models.onnx.mast3r import Mast3rView
from vggtgeo.models.roles import Features, LineFeatures, LineMatches, PointMatches, Segments
from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRelativePose, MeasuredRotation
from vggtgeo.slam.sparse_map.keyframe import Keyframe, Slots
from vggtgeo.slam.sparse_map.keyframe_images import CompressedImage, KeyframeImages
from vggtgeo.slam.state import FramePose, PendingWindow, Readout, SecondMotion, SeenPoints, Slam, Waiting
from vggtgeo.slam.state_checks import check_state
from vggtgeo.slam.tracking.evidence import Evidence
from vggtgeo.slam.tracking.rgbd_view import Points, RgbdView
from vggtgeo.slam.window.adjustment import Adjustment
from vggtgeo.slam.window.window_prior import WindowPrior
from vggtgeo.solvers.kernels import Barron, Cauchy, GemanMcClure, Huber, Square
from vggtgeo.solvers.levenberg_marquardt import IterationRecord

STATE_CLASSES: tuple[type, ...] = (
    *(
        Slam,
        Camera,
        PendingWindow,
        FramePose,
        SecondMotion,
        SeenPoints,
        Waiting,
        Evidence,
        Keyframe,
        Slots,
        KeyframeImages,
        CompressedImage,
    ),
    *(Features, PixelDescriptors, Mast3rView, Fit, LineFeatures, Segments, Pair, PointMatches, LineMatches),
    *(MeasuredRotation, MeasuredBaseline, MeasuredRelativePose, WindowPrior, MarginalPrior, Readout),
    *(Adjustment, Problem, State, Edges, SlotIndex, Pinhole, jaxlie.SE3, jaxlie.SO3),
    *(PointTerm, LineTerm, DepthPrior, IntrinsicsPrior, RelativePose, SurfaceAlignment, RotationPrior, BaselinePrior),
    *(Square, Huber, Cauchy, GemanMcClure, Barron, IterationRecord, RgbdView, Points),
)
"""All that a file may name; a state with anything else in it is not written."""
VERSION = 14


def _with_recorded_times(header: Header) -> Header:
    """Version 1 did not know when a map's keyframes were recorded."""
    tree, classes = with_field(header["tree"], header["classes"], "Keyframe", "recorded")
    return {**header, "tree": tree, "classes": classes}


def _with_lens(header: Header) -> Header:
    """Version 2 did not know lenses that a run found."""
    tree, classes = with_field(header["tree"], header["classes"], "Slam", "lens")
    return {**header, "tree": tree, "classes": classes}


def _with_first_pass(header: Header) -> Header:
    """Version 3 did not know first passes."""
    tree, classes = with_field(header["tree"], header["classes"], "Slam", "camera_found", False)
    return {**header, "tree": tree, "classes": classes}


def _with_readout(header: Header) -> Header:
    """Version 6 did not know rolling shutters."""
    tree, classes = with_field(header["tree"], header["classes"], "Slam", "readout")
    return {**header, "tree": tree, "classes": classes}


def _with_second_motions(header: Header) -> Header:
    """Version 7 placed frames against a second keyframe when a map was done."""
    tree, classes = with_field(header["tree"], header["classes"], "FramePose", "second")
    tree, classes = with_field(tree, classes, "Slam", "between", [])
    return {**header, "tree": tree, "classes": classes}


def _with_fisheyes(header: Header) -> Header:
    """Version 10 did not know fisheyes."""
    tree, classes = with_field(header["tree"], header["classes"], "Camera", "fisheye", False)
    return {**header, "tree": tree, "classes": classes}


def _with_seen_points(header: Header) -> Header:
    """Version 11 did not place frames against the points of the map as it is in the end."""
    tree, classes = with_field(header["tree"], header["classes"], "FramePose", "seen")
    return {**header, "tree": tree, "classes": classes}


def _with_rows(header: Header) -> Header:
    """Version 12 had one row of landmarks a keyframe."""
    tree, classes = header["tree"], header["classes"]
    for kind, field in (("Problem", "host"), ("Edges", "row_of"), ("SlotIndex", "part"), ("SlotIndex", "step")):
        tree, classes = with_field(tree, classes, kind, field)
    return {**header, "tree": tree, "classes": classes}


def _as_it_is(header: Header) -> Header:
    """What the next version added has gone since."""
    return header


def _without_old_checks(header: Header) -> Header:
    """Version 13 kept what single checks of the verdict needed."""
    gone = {
        "Slam": ("focal_wanted", "focal_without_lens", "focal_with_lens"),
        "FrameEvidence": ("depth_median", "depth_changed", "contrast", "enlarged", "edges_elsewhere"),
    }
    kept = {
        number: [place for place, field in enumerate(fields) if field not in gone.get(kind, ())]
        for number, (kind, fields) in enumerate(header["classes"])
    }

    def without(part: Any) -> Any:
        if isinstance(part, list):
            return [without(item) for item in part]
        if not isinstance(part, dict):
            return part
        inside = {key: without(item) for key, item in part.items()}
        if part.keys() == {"c", "v"}:
            inside["v"] = [inside["v"][place] for place in kept[part["c"]] if place < len(inside["v"])]
        return inside

    classes = [
        [kind, [fields[place] for place in kept[number]]] for number, (kind, fields) in enumerate(header["classes"])
    ]
    return {**header, "tree": without(header["tree"]), "classes": classes}


UPGRADES = {
    1: _with_recorded_times,
    2: _with_lens,
    3: _with_first_pass,
    4: _as_it_is,
    5: _as_it_is,
    6: _with_readout,
    7: _with_second_motions,
    8: _as_it_is,
    9: _as_it_is,
    10: _with_fisheyes,
    11: _with_seen_points,
    12: _with_rows,
    13: _without_old_checks,
}
"""Of states, and of maps and checkpoints, which hold them."""
STATE = Layout("state", VERSION, by_name(STATE_CLASSES), UPGRADES)


def save_state(path: str | os.PathLike[str], slam: Slam) -> None:
    """Writes a state, atomically; no pickles.

    Raises:
        TypeError: the state holds something of a class that is not in `STATE_CLASSES` (the descriptors of a matcher of
            your own, say).

    """
    STATE.write(path_of("path", path), slam)


@in_double_precision
def load_state(path: str | os.PathLike[str]) -> Slam:
    """The state that `save_state` wrote, bit by bit.

    Raises:
        InputError: the file is missing, damaged, of a version that is not known, or holds no state.

    """
    found, _ = STATE.read(path_of("path", path))
    return checked_state(Path(path), found)


def checked_state(path: Path, found: object) -> Slam:
    """What was read, if its parts belong together; InputError otherwise."""
    if not isinstance(found, Slam):
        raise InputError(f"`{path}` holds a {type(found).__name__}; expected the state of a run")
    try:
        check_state(found)
    except (TypeError, AttributeError, ValueError, IndexError) as error:
        raise InputError(f"`{path}` is no state that vggtgeo wrote, or was changed since: {error}; {AGAIN}") from None
    return found
