"""`show`: a map to turn, in a notebook or as a page of its own."""

from __future__ import annotations

from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.io.errors import InputError
from vggtgeo.io.given import check_kind
from vggtgeo.report import MapView, Pictured, check_viewer, map_scene, pictured
from vggtgeo.results.result import Result
from vggtgeo.slam.submaps import submaps_by_size

NOTEBOOK_POINTS = 150_000
"""Of the view: a notebook keeps it in its file, some 3 MB."""


def show(result: Result, truth: Trajectory | None = None, *, max_points: int = NOTEBOOK_POINTS) -> MapView:
    """Return a 3D view of a result: a notebook displays it, and its `save(path)` writes a page.

    The view has the coloured map, the mesh, the camera path with its uncertainty, and the keyframes; a click on a
    keyframe shows its image. A result loaded from a folder has no images.

    Args:
        result: of `vggtgeo.reconstruct` or `vggtgeo.read`, with at least one pose.
        truth: ground truth, camera -> world, aligned and shown beside the path; by default that of the run.
        max_points: of the view; a larger map is decimated.

    Raises:
        InputError: an argument is invalid, no frame has a pose, or the package `k3d` is not installed.

    Example:
        >>> import vggtgeo as vg
        >>> update = next(vg.run(vg.simulate("room", 3, size=(160, 120))))
        >>> view = vg.show(vg.Result.of(update))  # in a notebook its last line shows it
        >>> "Map in 3D" in view.html
        True

    """
    check_kind("result", result, Result, "of `vggtgeo.reconstruct` or `vggtgeo.read`")
    check_kind("truth", truth, Trajectory | None, "for example of `sequence.ground_truth()`")
    check_viewer()
    if not len(result.trajectory):
        raise InputError("`result` has no pose: no frame was tracked, and there is no map to show")
    record = result.record
    if record is not None:
        keyframes = pictured([record.slam.keyframes[number] for number in submaps_by_size(record.slam)[0]])
    else:
        poses = zip(result.keyframes.timestamps, result.keyframes.poses, strict=True)
        keyframes = [Pictured(f"keyframe {row}", pose, time) for row, (time, pose) in enumerate(poses)]
    scene = map_scene(
        result.cloud,
        result.trajectory,
        keyframes,
        result.intrinsics,
        mesh=result.mesh,
        truth=truth if truth is not None or record is None else record.truth,
        uncertainty=result.uncertainty,
        metric=result.metric,
        truth_in_metres=result.summary.get("truth", {}).get("in_metres", True),
        max_points=max_points,
    )
    return MapView.of(scene, "map")
