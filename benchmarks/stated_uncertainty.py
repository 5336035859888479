"""Compare the stated uncertainties of poses with their errors on clips with ground truth.

    python benchmarks/stated_uncertainty.py ../shared/data/icl-office ../shared/data/redkitchen --frames 100

Each frame states the standard deviation of its pose relative to its keyframe in the worst direction, and each keyframe
the full information matrix of its tracked motion. The table has a row for each clip: the share of frames whose error is
within three standard deviations (expected: at least 95 %), of translation and of rotation, the median error and the
median stated deviation; then the median squared Mahalanobis distance of the keyframes' motions (expected: 5.3,
chi-square of 6 degrees of freedom) and the factor of the standard deviations that would give that. The ground truth of
the real clips has errors (`../shared/data/README.md`); only that of icl-office is exact.

    python benchmarks/stated_uncertainty.py office room ../shared/data/icl-office --whole

runs whole clips, and simulated scenes by name, and compares the deviation in `uncertainty.txt` of every frame with its
error: relative to the first pose, whose error in the ground truth then counts in every frame, and after alignment of
the whole path: of positions by SE(3), of rotations by the best single rotation. The last two columns are the NEES
relative to the first pose, as in `vggtgeo bench`. With `--rgb-only` the path has the scale of the best Sim(3);
`--start` and `--end` run a part of each clip.

    python benchmarks/stated_uncertainty.py office room ../shared/data/icl-office --drawn 10

The stated deviation of a frame includes errors that no run can detect: the depth camera's constant factor, the
calibration, the time of an image, the principal point. Rendered clips have none of these errors, so their errors are
far smaller than stated. Here each of ten runs of a clip has them, drawn with the stated standard deviations: depth
times a factor, a wrong focal length, all cameras turned by one angle, and true poses at times beside those of the
images. The table has a row for each clip: the NEES per dimension, its mean over the runs with the standard error of
that mean, and the share of poses within three standard deviations.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2 as chi_square
from short_runs import Piece

import vggtgeo as vg
from vggtgeo.benchmark.inputs import RenderedWalk
from vggtgeo.datasets import Sequence, open_sequence, without_depth
from vggtgeo.evaluation import pose_consistency
from vggtgeo.geometry import rigid
from vggtgeo.simulation.degradations import Recording, with_depths
from vggtgeo.slam.camera.given_camera import FOCAL_SIGMA
from vggtgeo.slam.global_map.pose_uncertainty import CENTRE, DEPTH_SCALE, MOMENT
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.pose_acceptance import tangent

HEADER = (
    "| clip | frames | within 3 sigma: translation | rotation | median error, mm | stated | median error, deg | stated "
    "| motions of keyframes: median distance | sigma times |\n" + "|---" * 10 + "|"
)

WHOLE = (
    "| source | frames | stated, mm | error, mm: aligned | to the first pose | stated, deg | error, deg: aligned "
    "| to the first pose | within 3 sigma: place, aligned | to the first pose "
    "| rotation, aligned | to the first pose | NEES: place | rotation |\n" + "|---" * 14 + "|"
)

DRAWN = (
    "| source | runs | NEES: place | rotation | within 3 sigma of the first pose: place | rotation |\n"
    + "|---" * 6
    + "|"
)


def main() -> None:
    """Run every clip and print the table."""
    options = _options()
    if options.drawn:
        print(DRAWN)
        for path in options.clips:
            print(_drawn_row(path.name, _source(path), options.drawn), flush=True)
        return
    if options.whole:
        print(WHOLE)
        for path in options.clips:
            source = without_depth(_source(path)) if options.rgb_only else _source(path)
            result = vg.reconstruct(source, options=vg.RunOptions(start=options.start, end=options.end, dense="none"))
            assert result.record is not None
            truth = vg.Trajectory.load_tum(options.truth) if options.truth else result.record.truth
            assert truth is not None, f"{path} has no truth"
            scale = 1.0 if result.metric else vg.evaluate_trajectory(result.trajectory, truth).sim3.alignment.scale
            print(_whole_row(path.name, result, truth, scale), flush=True)
        return
    print(HEADER)
    for path in options.clips:
        piece = Piece.of(path, options.frames)
        slam = piece.run()
        true = rigid.invert(piece.truth.poses)
        row_of = {frame.index: row for row, frame in enumerate(piece.frames)}
        print(_row(piece.name, slam, true, row_of), flush=True)


def _row(name: str, slam: Slam, true: np.ndarray, row_of: dict[int, int]) -> str:
    frames = []
    for record in slam.frames:
        reference = row_of[slam.keyframes[record.reference].frame]
        arrived = record.arrival is not None or row_of[record.frame] == reference
        if record.tracked and not arrived and np.isfinite(record.quality.sigma_translation):
            off = _error(record.relative, true[reference], true[row_of[record.frame]])
            stated = record.quality.sigma_translation, record.quality.sigma_rotation
            frames.append((np.linalg.norm(off[:3]), np.linalg.norm(off[3:]), *stated))
    moved, turned, sigma_moved, sigma_turned = np.array(frames).T
    distances = []
    for factor in slam.map.odometry_factors:
        first, second = (row_of[slam.keyframes[number].frame] for number in factor.keyframes)
        off = _error(factor.pose, true[first], true[second])
        distances.append(off @ factor.information @ off)
    typical = float(np.median(distances))
    cells = (
        *(
            f"{100 * np.mean(error < 3 * sigma):.0f} %"
            for error, sigma in ((moved, sigma_moved), (turned, sigma_turned))
        ),
        *(f"{1e3 * np.median(value):.1f}" for value in (moved, sigma_moved)),
        *(f"{np.rad2deg(np.median(value)):.3f}" for value in (turned, sigma_turned)),
        f"{typical:.1f}",
        f"{np.sqrt(typical / chi_square.ppf(0.5, 6)):.2f}",
    )
    return "| " + " | ".join((name, str(len(moved)), *cells)) + " |"


def _whole_row(name: str, result: vg.Result, truth: vg.Trajectory, scale: float) -> str:
    stated = result.uncertainty
    assert stated is not None
    rows = [int(np.argmin(np.abs(truth.timestamps - time))) for time in result.trajectory.timestamps]
    found, true = result.trajectory.poses.copy(), truth.poses[rows]
    found[:, :3, 3] *= scale
    against_first = [rigid.invert(poses[0])[None] @ poses for poses in (found, true)]
    off = np.array([tangent(rigid.invert(one) @ other) for one, other in zip(*against_first, strict=True)])
    first = np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1)
    places, targets = (poses[:, :3, 3] - poses[:, :3, 3].mean(0) for poses in (found, true))
    turn, _ = Rotation.align_vectors(targets, places)
    aligned = np.linalg.norm(turn.apply(places) - targets, axis=1)
    each, goals = (Rotation.from_matrix(poses[:, :3, :3]) for poses in (found, true))
    turned_off = (goals.inv() * (goals * each.inv()).mean() * each).magnitude()
    moved, turned = scale * stated.translation, stated.rotation
    consistency = pose_consistency(result.trajectory, truth, moved, turned, scale)
    nees = [f"{one.mean() / 3:.2f}" for one in consistency]
    compared = ((aligned, moved), (first[0], moved), (turned_off, turned), (first[1], turned))
    known = np.isfinite(moved)
    within = [f"{100 * np.mean(error[known] <= 3 * sigma[known]):.0f} %" for error, sigma in compared]
    cells = [f"{1e3 * np.nanmedian(values):.1f}" for values in (moved, aligned, first[0])]
    angles = [f"{np.rad2deg(np.nanmedian(values)):.3f}" for values in (turned, turned_off, first[1])]
    return "| " + " | ".join((name, str(len(moved)), *cells, *angles, *within, *nees)) + " |"


def _source(path: Path) -> Sequence:
    """Return the clip, or the simulated scene of that name."""
    return open_sequence(path) if path.exists() else vg.simulate(path.name, 80, rate=6.0)


def _drawn_row(name: str, source: Sequence, runs: int) -> str:
    truth = source.ground_truth()
    assert truth is not None, f"{name} has no truth"
    recording, squares, within = Recording(list(source.frames()), source.camera, truth), [], []
    for seed in range(runs):
        result = vg.reconstruct(
            RenderedWalk(name, _with_unseen_errors(recording, seed)), options=vg.RunOptions(dense="none")
        )
        assert result.record is not None
        stated, true = result.uncertainty, result.record.truth
        assert stated is not None
        assert true is not None
        both = pose_consistency(result.trajectory, true, stated.translation, stated.rotation, 1.0)
        squares.append([one.mean() / 3 for one in both])
        within.append([np.mean(one <= 3.0**2) for one in both])
    mean, error = np.mean(squares, 0), np.std(squares, 0, ddof=1) / np.sqrt(runs)
    nees = [f"{value:.2f} ± {spread:.2f}" for value, spread in zip(mean, error, strict=True)]
    shares = [f"{100 * share:.0f} %" for share in np.mean(within, 0)]
    return "| " + " | ".join((name, str(runs), *nees, *shares)) + " |"


def _with_unseen_errors(recording: Recording, seed: int) -> Recording:
    """Return the recording with errors that no run can detect, drawn with the stated standard deviations: one depth
    factor, one focal length, one turn of all cameras (the effect of a wrong principal point), and a time shift for each
    image.
    """
    rng = np.random.default_rng(seed)
    longer, wider = np.exp(rng.normal(0.0, (DEPTH_SCALE, FOCAL_SIGMA)))
    fx, fy, cx, cy = recording.camera.intrinsics
    camera = replace(recording.camera, intrinsics=(wider * fx, wider * fy, cx, cy))
    times = recording.truth.timestamps
    inside = np.clip(times + rng.normal(0.0, MOMENT, len(times)), times[0], times[-1])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    centres = [np.interp(inside, times, column) for column in recording.truth.positions.T]
    poses[:, :3, :3] = Slerp(times, Rotation.from_matrix(recording.truth.poses[:, :3, :3]))(inside).as_matrix()
    poses[:, :3, 3] = np.stack(centres, 1)
    aside = rng.normal(0.0, CENTRE, 2) * (recording.camera.height / fy, recording.camera.width / fx)
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec([*aside, 0.0]).as_matrix()
    changed = with_depths(recording, lambda depth, row: longer * depth)
    return replace(changed, camera=camera, truth=vg.Trajectory(times, poses))


def _error(motion: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the tangent vector of a motion's error, translation first; `first` and `second` are true poses, world ->
    camera.
    """
    return tangent(motion @ first @ rigid.invert(second))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--rgb-only", action="store_true")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--end", type=int)
    parser.add_argument("--truth", type=Path, help="poses to compare one clip with (TUM format)")
    parser.add_argument(
        "--drawn", type=int, default=0, help="number of runs of each, with errors that no run can detect"
    )
    options = parser.parse_args()
    if options.truth and not (options.whole and len(options.clips) == 1):
        parser.error("--truth goes with --whole and one clip")
    if options.drawn == 1 or options.drawn < 0 or (options.drawn and options.whole):
        parser.error("--drawn is a number of runs, at least 2, and goes without --whole")
    if (options.rgb_only or options.start or options.end) and not options.whole:
        parser.error("--rgb-only, --start and --end go with --whole")
    return options


if __name__ == "__main__":
    main()
