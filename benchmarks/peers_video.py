"""Compare this system with COLMAP on videos without depth: frames with a pose, submaps, accuracy and time.

    .venv/bin/python benchmarks/peers_video.py ../shared/data/balcony ../shared/data/building-walk [--stride 2]
        [--mapping incremental global] [--seeds 0 1] [--frames 0 302] [--no-ours] [--unknown-camera]

COLMAP (the extra with pycolmap) gets the same frames, the same camera (fixed; with `--unknown-camera` neither gets
one), pairs of frames up to 10 apart, and for each frame the 10 others, farther apart, that are most similar by this
system's global descriptor. Its options are its defaults. Matches are made once per clip, and mapped again with every
seed.

The table has a row for each run: frames in the largest submap and in all; submaps; ATE of the largest submap after
Sim(3) in cm, or in hundredths of the ground truth's unit, and in % of its path; seconds. Below, the same distance
between each two runs of COLMAP.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import deque
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import cv2
import jax
import numpy as np
import pycolmap
from vggtgeo.models.classical import SiftMatcher, global_descriptor

from vggtgeo.datasets import Sequence, open_sequence
from vggtgeo.datasets.frame import Frame
from vggtgeo.evaluation.association import associate
from vggtgeo.evaluation.pose_errors import absolute_error
from vggtgeo.geometry import rigid
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.slam.run import default_roles, finish, frame_trajectory, run
from vggtgeo.slam.state import submaps_by_size

NEIGHBOURS, ALIKE = 10, 10
"""Number of near frames, on each side, and of similar frames with which a frame is matched."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run of one system: the trajectory of each submap, the largest first, and its seconds."""

    name: str
    submaps: list[Trajectory]
    seconds: float


def main() -> None:
    """Run both over every clip, and print a table."""
    options = _options()
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR
    jax.config.update("jax_enable_x64", True)
    print("| clip | run | largest submap | all | submaps | ATE Sim(3), cm | % of the path | s |\n" + "|---" * 8 + "|")
    for path in options.clips:
        sequence = open_sequence(path)
        first, past = options.frames
        frames = [replace(frame, depth=None) for frame in sequence.frames(first, past, options.stride)]
        truth = sequence.ground_truth()
        runs = []
        for seed in options.seeds if options.ours else ():
            runs.append(_ours(frames, sequence, seed, options.unknown_camera))
            print(_row(path.name, runs[-1], truth, len(frames)), flush=True)
        with tempfile.TemporaryDirectory() as folder:
            theirs = []
            for run in _colmap(frames, sequence, Path(folder), options):
                theirs.append(run)
                print(_row(path.name, run, truth, len(frames)), flush=True)
        for one, other in combinations(theirs, 2):
            apart, share = _error(one.submaps[0], other.submaps[0])
            print(f"\n{path.name}: {one.name} and {other.name} are {apart:.2f} apart, {share:.2f} % of the path\n")


def _ours(frames: list[Frame], sequence: Sequence, seed: int, unknown: bool) -> Run:
    began = time.monotonic()
    camera = None if unknown else sequence.camera
    roles = default_roles(False).seeded(seed)
    slam = finish(deque(run(frames, roles, camera=camera), maxlen=1).pop(), roles)
    submaps = [frame_trajectory(slam, submap) for submap in range(len(submaps_by_size(slam)))]
    return Run(f"ours, seed {seed}", submaps, time.monotonic() - began)


def _colmap(frames: list[Frame], sequence: Sequence, folder: Path, options: argparse.Namespace) -> list[Run]:
    began = time.monotonic()
    images, database = folder / "images", folder / "database.db"
    images.mkdir()
    names = [f"{row:06d}.png" for row in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        cv2.imwrite(str(images / name), frame.image[..., ::-1])
    reader = pycolmap.ImageReaderOptions()
    if not options.unknown_camera:
        reader.camera_model, parameters = _camera(sequence)
        reader.camera_params = ",".join(f"{value:.9g}" for value in parameters)
    device = pycolmap.Device.cpu
    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader, device=device
    )
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(folder / "pairs.txt")
    pairs = "\n".join(f"{names[first]} {names[second]}" for first, second in sorted(_pairs(frames)))
    Path(pairing.match_list_path).write_text(pairs)
    pycolmap.match_image_pairs(database, pairing_options=pairing, device=device)
    shared, runs = time.monotonic() - began, []
    for mapping in options.mapping:
        for seed in options.seeds:
            began = time.monotonic()
            models = _mapped(mapping, database, images, folder / f"{mapping}{seed}", seed, not options.unknown_camera)
            submaps = [_trajectory(model, frames) for model in models.values()]
            submaps.sort(key=len, reverse=True)
            runs.append(Run(f"COLMAP {mapping}, seed {seed}", submaps, shared + time.monotonic() - began))
    return runs


def _mapped(
    mapping: str, database: Path, images: Path, out: Path, seed: int, known: bool
) -> dict[int, pycolmap.Reconstruction]:
    out.mkdir()
    pycolmap.set_random_seed(seed)
    if mapping == "global":
        whole = pycolmap.GlobalPipelineOptions()
        whole.random_seed = seed
        return dict(pycolmap.global_mapping(database, images, out, whole))
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    if known:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
    return dict(pycolmap.incremental_mapping(database, images, out, options))


def _camera(sequence: Sequence) -> tuple[str, list[float]]:
    """Return model and parameters of a camera as COLMAP has them: the centre of its first pixel is at 0.5, 0.5."""
    fx, fy, cx, cy = sequence.camera.intrinsics
    pinhole = [fx, fy, cx + 0.5, cy + 0.5]
    lens = list(sequence.camera.distortion)
    if sequence.camera.fisheye:
        return "OPENCV_FISHEYE", [*pinhole, *lens]
    if len(lens) > 4:
        return "FULL_OPENCV", [*pinhole, *lens, *[0.0] * (8 - len(lens))]
    return ("OPENCV", [*pinhole, *lens]) if lens else ("PINHOLE", pinhole)


def _pairs(frames: list[Frame]) -> set[tuple[int, int]]:
    """Return pairs of frames that are near each other, and of distant frames that look alike."""
    count, matcher = len(frames), SiftMatcher()
    pairs = {(row, other) for row in range(count) for other in range(row + 1, min(row + NEIGHBOURS + 1, count))}
    vectors = [global_descriptor(matcher.describe(frame.image)) for frame in frames]
    length = next((len(vector) for vector in vectors if vector is not None), 1)
    places = np.stack([np.zeros(length) if vector is None else vector for vector in vectors])
    alike = places @ places.T
    for row in range(count):
        alike[row, max(row - NEIGHBOURS, 0) : row + NEIGHBOURS + 1] = -np.inf
        for other in np.argsort(-alike[row])[:ALIKE]:
            if np.isfinite(alike[row, other]):
                pairs.add((min(row, int(other)), max(row, int(other))))
    return pairs


def _trajectory(model: pycolmap.Reconstruction, frames: list[Frame]) -> Trajectory:
    poses = {int(Path(image.name).stem): image.cam_from_world().matrix() for image in model.images.values()}
    rows = sorted(poses)
    whole = np.tile(np.eye(4), (len(rows), 1, 1))
    whole[:, :3] = [poses[row] for row in rows]
    return Trajectory(np.array([frames[row].timestamp for row in rows]), rigid.invert(whole))


def _row(clip: str, run: Run, truth: Trajectory, frames: int) -> str:
    if not run.submaps:
        return f"| {clip} | {run.name} | 0 of {frames} | 0 | 0 | | | {run.seconds:.0f} |"
    error, share = _error(run.submaps[0], truth)
    counts = f"{len(run.submaps[0])} of {frames} | {sum(map(len, run.submaps))} | {len(run.submaps)}"
    return f"| {clip} | {run.name} | {counts} | {error:.2f} | {share:.2f} | {run.seconds:.0f} |"


def _error(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """Return the ATE after Sim(3), in hundredths of the ground truth's unit and in % of its path, over the frames that
    both have.
    """
    error = absolute_error(*associate(estimate, truth), "sim3").statistics.rmse
    path = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum()
    return 100 * float(error), 100 * float(error / path)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--stride", type=int, default=1, help="take every n-th frame")
    parser.add_argument("--frames", type=int, nargs=2, default=(0, None), metavar=("FIRST", "PAST"))
    parser.add_argument("--mapping", nargs="*", choices=("incremental", "global"), default=["incremental"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--no-ours", dest="ours", action="store_false", help="run COLMAP only")
    parser.add_argument("--unknown-camera", action="store_true", help="let both systems estimate the camera")
    return parser.parse_args()


if __name__ == "__main__":
    main()
