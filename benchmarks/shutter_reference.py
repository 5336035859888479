r"""COLMAP's own adjustment, told of a rolling shutter: what readout does it prefer, and where does its path go?

    D=../shared/data/redkitchen
    .venv/bin/vggtgeo run $D --rgb-only -o runs/redkitchen-rgb
    .venv/bin/python benchmarks/shutter_reference.py runs/redkitchen-rgb $D/reference-colmap.txt --scale-from \
        $D/groundtruth-colour.txt

COLMAP has no model of a rolling shutter, so that its path is bent by one, and a run that takes it out is farther from
COLMAP than one that does not. Here the tracks of the run's key points go to pycolmap's bundle adjustment (everything
free, OPENCV camera, Cauchy loss), which starts from the reference poses, not from the run's; first as they were seen,
then with each pixel where it would be at the middle of the readout, by the motion of the reference and the depth of the
point. Columns: COLMAP's robust cost, which judges each readout; and ATE in cm after Sim(3), of COLMAP's path to the
reference that it started from, of the run to COLMAP's path.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap

from vggtgeo.evaluation.alignment import umeyama
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.mapping.tracks import Tracks
from vggtgeo.results.scene import Scene
from vggtgeo.simulation.degradations import camera_velocities
from vggtgeo.slam.camera.rolling_shutter import image_shift

SOFT = 2.0
"""Pixels: where COLMAP's loss begins to doubt a match."""
ROUNDS = 2
"""Of COLMAP's adjustment, each goes on from the last."""


@dataclass(frozen=True, eq=False)
class Model:
    """Poses [k, 4, 4], world -> camera, tracks, and the camera as COLMAP has it."""

    poses: np.ndarray
    tracks: Tracks
    camera: np.ndarray

    @property
    def centres(self) -> np.ndarray:
        """Of the cameras, float64 [k, 3]."""
        return np.asarray(rigid.invert(self.poses)[:, :3, 3])


def main() -> None:
    """Print a row for each readout."""
    options = _options()
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING
    scene = Scene.load(options.run)
    reference = Trajectory.load_tum(options.reference)
    if options.scale_from:
        reference = _scaled_like(reference, Trajectory.load_tum(options.scale_from))
    rows = np.abs(reference.timestamps[None] - scene.timestamps[:, None]).argmin(1)
    poses = rigid.invert(reference.poses)
    motions = camera_velocities(reference.timestamps[rows], reference)
    own = Model(scene.poses, scene.tracks, scene.intrinsics)
    begun = Model(poses[rows], _brought(own, poses[rows]), scene.intrinsics)
    count = f"{len(rows)} keyframes, {len(scene.tracks)} points, {len(scene.tracks.point)} observations"
    print(f"{count}; the run to the reference: {_ate(own, begun):.2f} cm\n")
    print("| readout, ms | COLMAP's cost | median, px | COLMAP to the reference, cm | the run to COLMAP, cm | camera |")
    print("|" + "---|" * 6)
    for milliseconds in options.readouts:
        found, cost, median = _adjusted(begun, motions, milliseconds / 1000, scene.size)
        camera = ", ".join(f"{value:.1f}" for value in found.camera[:4])
        errors = f"{_ate(found, begun):.2f} | {_ate(own, found):.2f}"
        print(f"| {milliseconds:g} | {cost:.0f} | {median:.3f} | {errors} | {camera} |", flush=True)


def _adjusted(begun: Model, motions: np.ndarray, seconds: float, size: tuple[int, int]) -> tuple[Model, float, float]:
    """What COLMAP makes of the tracks with this readout taken out, its robust cost, and the median residual."""
    model, tracks = begun, begun.tracks
    view = tracks.view
    for _ in range(ROUNDS):
        depth = _local(model)[:, 2]
        shift = image_shift(
            tracks.pixel[:, None], 1 / depth[:, None], motions[view], begun.camera, size[::-1], columns=False
        )[:, 0]
        pixel = tracks.pixel - seconds * shift
        model = _colmap(replace(model, tracks=replace(model.tracks, pixel=pixel)), size)
    camera = pycolmap.Camera(model="OPENCV", width=size[0], height=size[1], params=model.camera)
    squared = np.sum((np.asarray(camera.img_from_cam(_local(model))) - pixel - 0.5) ** 2, 1)
    return model, float(SOFT**2 / 2 * np.log1p(squared / SOFT**2).sum()), float(np.sqrt(np.median(squared)))


def _colmap(model: Model, size: tuple[int, int]) -> Model:
    """The model after COLMAP's bundle adjustment."""
    tracks, images = model.tracks, range(1, len(model.poses) + 1)
    whole = pycolmap.Reconstruction()
    begin = model.camera if len(model.camera) > 4 else [*model.camera[:2], *(model.camera[2:] + 0.5), 0, 0, 0, 0]
    camera = pycolmap.Camera(model="OPENCV", width=size[0], height=size[1], params=begin, camera_id=1)
    whole.add_camera_with_trivial_rig(camera)
    places = np.empty(len(tracks.view), int)
    for number in images:
        seen = np.flatnonzero(tracks.view == number - 1)
        places[seen] = np.arange(len(seen))
        image = pycolmap.Image(name=str(number), keypoints=tracks.pixel[seen] + 0.5, camera_id=1, image_id=number)
        whole.add_image_with_trivial_frame(image, pycolmap.Rigid3d(model.poses[number - 1][:3]))
    bounds = np.searchsorted(tracks.point, np.arange(len(tracks) + 1))
    for point, (low, high) in enumerate(pairwise(bounds)):
        ends = zip(tracks.view[low:high] + 1, places[low:high], strict=True)
        track = pycolmap.Track([pycolmap.TrackElement(int(image), int(place)) for image, place in ends])
        whole.add_point3D(tracks.points[point], track, np.zeros(3, np.uint8))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point, options.print_summary = True, False
    options.ceres.loss_function_type, options.ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, SOFT
    pycolmap.bundle_adjustment(whole, options)
    poses = np.tile(np.eye(4), (len(images), 1, 1))
    poses[:, :3] = [whole.image(number).cam_from_world().matrix() for number in images]
    points = np.stack([whole.point3D(point + 1).xyz for point in range(len(tracks))])
    return Model(poses, replace(tracks, points=points), np.asarray(whole.camera(1).params))


def _local(model: Model) -> np.ndarray:
    """The point of each observation in its camera, float64 [m, 3]."""
    poses = model.poses[model.tracks.view]
    points = model.tracks.points[model.tracks.point]
    return np.asarray(np.einsum("mij,mj->mi", poses[:, :3, :3], points) + poses[:, :3, 3])


def _brought(model: Model, poses: np.ndarray) -> Tracks:
    """The tracks of a model where other poses of its keyframes are, by Sim(3)."""
    moved = umeyama(model.centres, rigid.invert(poses)[:, :3, 3], with_scale=True)
    return replace(model.tracks, points=moved.points(model.tracks.points))


def _scaled_like(trajectory: Trajectory, metric: Trajectory) -> Trajectory:
    """With lengths in metres, so that errors are in cm."""
    rows = np.abs(metric.timestamps[None] - trajectory.timestamps[:, None]).argmin(1)
    poses = trajectory.poses.copy()
    poses[:, :3, 3] *= umeyama(trajectory.positions, metric.positions[rows], with_scale=True).scale
    return Trajectory(trajectory.timestamps, poses)


def _ate(model: Model, to: Model) -> float:
    """After Sim(3), cm."""
    moved = umeyama(model.centres, to.centres, with_scale=True).points(model.centres)
    return 100 * float(np.sqrt(np.mean(np.sum((moved - to.centres) ** 2, 1))))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a run's folder")
    parser.add_argument("reference", type=Path, help="COLMAP's poses of all frames (TUM format)")
    parser.add_argument("--scale-from", type=Path, help="a trajectory in metres")
    parser.add_argument("--readouts", type=float, nargs="+", default=[0, 10, 20, 25, 30, 35, 45, -20], help="ms")
    return parser.parse_args()


if __name__ == "__main__":
    main()
