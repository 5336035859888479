"""A state of the pipeline as a file: the same to the last bit, in what it holds and in what follows from it."""

from __future__ import annotations

import dataclasses
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from recorded_run import ROLES, SETTINGS, recorded_run
from reported import raises
from same_leaves import differences
from vggtgeo.solvers.levenberg_marquardt import IterationRecord

from vggtgeo.bundle.marginalisation import empty_prior
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.persistence import Format, by_name
from vggtgeo.slam.camera.camera_estimate import Readout
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.run import run_frames
from vggtgeo.slam.sparse_map.factors import MeasuredBaseline, MeasuredRotation
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.state import PendingWindow, Slam
from vggtgeo.slam.state_file import STATE_CLASSES, VERSION
from vggtgeo.slam.tracking.pose_acceptance import TrackingQuality
from vggtgeo.slam.tracking.tracking_state import SeenPoints, UnplacedFrame
from vggtgeo.slam.window.sliding_window import WindowPrior

STATE = Format("state", VERSION, by_name(STATE_CLASSES))
MIDDLE = 4
"""Frame of the recorded run whose state is saved."""


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a state in the middle of the run."""
    path = tmp_path_factory.mktemp("state") / "state.npz"
    STATE.write(path, full(recorded_run().states[MIDDLE]))
    return path


def full(slam: Slam) -> Slam:
    """The state with something in every field that a good run leaves empty."""
    frame = recorded_run().frames[MIDDLE]
    newest = slam.keyframes[-1]
    lost = UnplacedFrame(frame.index, frame.timestamp, frame.image, newest.features, frame.depth)
    compressed = (slam.keyframes[0].compressed(), *slam.keyframes[1:])
    slam = merge_pending_window(slam)
    adjustment, state = slam.window.solved
    one = jnp.ones(1)
    under_way: Future[Slam] = Future()
    under_way.set_result(slam)
    tries = IterationRecord(one, one, jnp.full(1, jnp.nan), state.poses.wxyz_xyz[None])
    seen = SeenPoints(np.zeros(1, np.int32), np.ones((1, 2), np.float32))
    return replace(
        slam,
        tracker=replace(slam.tracker, frames=(*slam.frames[:-1], replace(slam.frames[-1], seen=seen)), waiting=(lost,)),
        map=replace(
            slam.map,
            keyframes=compressed,
            factors=(*slam.map.factors, MeasuredRotation(0, np.eye(3), np.eye(3)), MeasuredBaseline(0, 1, 0.1, 1e-3)),
            axes=(np.eye(3),),
            pose_sigma=np.ones((2, 2)),
        ),
        window=replace(
            slam.window, prior=WindowPrior(adjustment.keyframes, empty_prior(4)), iterations=tries, fixed=(0,)
        ),
        camera=replace(
            slam.camera,
            lens=Camera((140.0, 140.0, 80.0, 60.0), 160, 120, (-0.1, 0.0, 0.0, 0.0), known=False),
            readout=Readout(0.02, False, 3.0),
        ),
        notes=("a note",),
        pending=PendingWindow(7, slam, under_way),
    )


def test_every_field_comes_back_to_the_bit(saved: Path) -> None:
    """Each leaf of the loaded state, all classes through, is that of the saved one; oracle: a walk over the fields,
    which knows no class by name.
    """
    before = full(recorded_run().states[MIDDLE])
    empty = [field.name for field in dataclasses.fields(Slam) if _is_empty(getattr(before, field.name))]
    assert empty == []  # a new field is to be given a content in `full`
    assert list(differences(before, STATE.read(saved)[0])) == []


def _is_empty(value: Any) -> bool:
    return value is None or (isinstance(value, tuple) and not value)


def test_the_run_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    """Every state after the saved one, up to the end, is that of the undisturbed run; oracle: that run."""
    run = recorded_run()
    STATE.write(tmp_path / "state.npz", run.states[MIDDLE])
    loaded, _ = STATE.read(tmp_path / "state.npz")
    rest = iter(run.frames[MIDDLE + 1 :])
    again = list(run_frames(rest, run.sequence.camera, ROLES, SETTINGS, Clock(), loaded))
    again[-1] = merge_pending_window(again[-1])
    assert loaded.pending is not None  # a window was being adjusted when the state was saved
    assert len(again[-1].keyframes) > len(loaded.keyframes)
    for one, other in zip(run.states[MIDDLE + 1 :], again, strict=True):
        assert list(differences(one, other)) == []


def test_arrays_that_fields_share_are_stored_once(saved: Path) -> None:
    """An array that two fields hold is one array again; oracle: identity, before and after."""
    before, after = recorded_run().states[MIDDLE].keyframes[0], STATE.read(saved)[0].keyframes[0]
    for keyframe in (before, after):
        assert keyframe.points.pixels is keyframe.features.pixels


@dataclass(frozen=True, eq=False)
class Box:
    """Anything."""

    content: Any


BOX = Format("box", 2, by_name([Box]))
VALUES: dict[str, Any] = {
    "floats": (0.1, -0.0, 1e-320, float("inf"), -float("inf"), float("nan"), 2**70, -1, True, None, "ü\ud800"),
    "containers": ([1, (2, [])], {"a": {}, "b": ()}, (), b"", b"\x00\xff", np.array(["a", "bc"]), Box),
    "scalars": (np.float64(0.1), np.float32(np.nan), np.int16(-3), np.bool_(True)),
    "orders": tuple(
        np.arange(120.0).reshape(4, 5, 6)[view]
        for view in (np.s_[:], np.s_[::-1], np.s_[:, ::2, 1], np.s_[..., ::-1], np.s_[0, 0, :0], np.s_[2, 1, 3])
    ) + (np.eye(3).T.copy("F"), np.ones((4, 3)).T, np.broadcast_to(np.float32(2), (3, 3)), np.zeros((0, 2))),
    "jax": (jnp.arange(3.0), jnp.asarray(2.0), jnp.asarray(True), jnp.asarray(2.0) * jnp.ones(()), jnp.float32(3)),
}  # fmt: skip


@pytest.mark.parametrize("name", VALUES)
def test_any_value_comes_back(name: str, tmp_path: Path) -> None:
    """Numbers that JSON does not know, orders in memory, weak types; oracle: the values."""
    BOX.write(tmp_path / "box", Box(VALUES[name]), {"why": name})
    again, facts = BOX.read(tmp_path / "box")
    assert list(differences(Box(VALUES[name]), again)) == []
    assert facts == BOX.facts(tmp_path / "box") == {"why": name}


@pytest.mark.parametrize("value", [object(), {1: 2}, np.array([None]), TrackingQuality(), Keyframe])
def test_what_is_not_listed_is_not_written(value: Any, tmp_path: Path) -> None:
    """A class that nobody listed ends the writing with the way to it, and leaves no file; oracle: the error."""
    with raises("content[1]", error=TypeError):
        BOX.write(tmp_path / "box", Box((1, value)))
    assert not list(tmp_path.iterdir())
