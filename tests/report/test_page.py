"""The page of a run, and what it is made of: residual sizes, the record of windows, pictures of the map."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from checked_page import CheckedPage
from recorded_run import FRAMES, RecordedRun
from scenes import make_scene
from vggtgeo.solvers.kernels import Square

from vggtgeo.bundle.residual_values import residual_sizes
from vggtgeo.cli.progress import errors_line
from vggtgeo.evaluation import evaluate_trajectory
from vggtgeo.figures import map_view
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.mapping.dense import DenseMap, dense_depths
from vggtgeo.report import RunRecord, has_viewer, map_scene, view_html, write_page
from vggtgeo.results.summary import summarise
from vggtgeo.slam.run import frame_trajectory
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.findings import Finding, Verdict, conclude
from vggtgeo.slam.window.sliding_window import MAX_ITERATIONS


def test_residual_sizes_of_known_noise() -> None:
    """Noise of 0.7 px, and a prior off by one sigma, are found as such; oracle: the noise put in, at the truth."""
    scene = make_scene(keyframes=4, points=200, lines=40, noise=0.7, depth_error=0.05)
    problem, state, _ = scene.at_truth(kernel=Square())
    sizes = eqx.filter_jit(residual_sizes)(problem, state)
    assert float(sizes.rms["points"]) == pytest.approx(0.7 * np.sqrt(2), rel=0.03)
    assert float(sizes.rms["lines"]) == pytest.approx(0.7, rel=0.1)
    assert float(sizes.rms["depth"]) == pytest.approx(1.0, rel=0.1)
    count = len(scene.observations.point_edge), len(scene.observations.line_edge), len(scene.observations.host)
    assert tuple(int(sizes.count[name]) for name in ("points", "lines", "depth")) == count
    assert f"({count[0]})" in str(sizes)


def test_an_absent_kind_has_no_size() -> None:
    """Without lines their size is NaN and their count 0, so that nobody reads a zero residual."""
    problem, state, _ = make_scene(keyframes=2, points=4, lines=0).at_truth()
    sizes = eqx.filter_jit(residual_sizes)(problem, state).to_dict()
    assert np.isnan(sizes["lines"])
    assert sizes["lines_count"] == 0


def _page(run: RecordedRun, folder: Path, slam: Slam | None = None, **options: object) -> str:
    """The text of the page of this run, or of a changed state of it."""
    slam = slam or run.slam
    truth = run.sequence.ground_truth()
    path = frame_trajectory(slam)
    report = evaluate_trajectory(path, truth) if len(path) else None
    facts = {"simulated": True, "frames_per_second": 9.9, "interrupted": False}
    verdict = options.get("verdict", Verdict("good"))
    settings, seconds = {"seed": 0, "no_lines": False}, {"track": 1.0, "all": 2.0}
    summary = summarise(slam, verdict, settings=settings, seconds=seconds, report=report, **facts)
    deep = any(np.isfinite(keyframe.depth).any() for keyframe in slam.keyframes)
    maps = tuple(dense_depths(slam.keyframes, slam.intrinsics, "auto" if deep else "none"))
    dense = DenseMap(maps, slam.keyframes, maps, slam.intrinsics, options.get("cloud", run.cloud), 0.02)
    given = {"windows": tuple(run.recorder.records), "truth": truth, "warnings": (), "title": "a <room>"}
    given = {name: options.get(name, value) for name, value in given.items()}
    record = RunRecord(slam, dense, **given)
    write_page(
        folder / "report.html", record, options.get("summary", summary), verdict, options.get("view", lambda: None)
    )
    return (folder / "report.html").read_text()


def test_a_run_that_was_found_nowhere_in_a_known_map_has_a_page(run: RecordedRun, tmp_path: Path) -> None:
    """Localised only, and in another place: keyframes and a map, and no frame with a pose. All is written but the
    path; it ended in an error after all the work.
    """
    nowhere = replace(
        run.slam,
        tracker=replace(run.slam.tracker, frames=tuple(replace(record, tracked=False) for record in run.slam.frames)),
    )
    page = _page(run, tmp_path, nowhere, truth=None)
    assert "No frame has a pose." in page
    assert "The map seen from" not in page


def test_every_adjustment_is_recorded_once(run: RecordedRun) -> None:
    """One record a keyframe from the second on, energies falling; oracle: the state's keyframes and their frames."""
    records = run.recorder.records
    assert [record.frame for record in records] == [keyframe.frame for keyframe in run.slam.keyframes[1:]]
    for record in records:
        assert 0 < record.rms["points"] < 3.0
        assert record.counts["points"] > 50
        assert record.units["points"] == "px"
        assert set(record.rms) == set(record.counts) <= {"points", "lines", "depth", "relative_poses"}
        assert record.energy[1] <= record.energy[0]
        assert 1 <= record.iterations <= MAX_ITERATIONS


def test_errors_against_a_truth_without_metres_are_no_centimetres(run: RecordedRun, tmp_path: Path) -> None:
    """The page of a run beside poses of COLMAP, and its line in the terminal. Oracle: the report's own number."""
    sequence_truth = run.sequence.ground_truth()
    report = evaluate_trajectory(frame_trajectory(run.slam), sequence_truth)
    verdict = Verdict("good")
    given = {"settings": {}, "seconds": {"all": 2.0}, "report": report, "simulated": True}
    own, metric = (summarise(run.slam, verdict, truth_in_metres=metres, **given) for metres in (False, True))
    error = report.sim3.statistics.rmse
    text = re.sub(r"<script.*?</script>", "", _page(run, tmp_path, summary=own), flags=re.DOTALL)
    assert f"{error:.4g}" in text
    assert " cm" not in text
    assert "[cm]" not in text
    assert "ATE, SE(3)" not in text
    assert "ATE, Sim(3) [unit of the ground truth]" in text
    assert "ATE, SE(3) [cm]" in _page(run, tmp_path, summary=metric)
    assert errors_line(own["truth"], free=False).startswith(
        f"ATE {error:.4g} after Sim(3) alignment, in the unit of the ground truth"
    )
    assert errors_line(metric["truth"], free=False).endswith(f"SE(3), {100 * error:.2f} cm after Sim(3) alignment")


def test_the_page_is_whole_and_needs_nothing_else(run: RecordedRun, tmp_path: Path) -> None:
    """Elements close, no address leads out of the file, identifiers are unique, and every part is there."""
    view = lambda: view_html(map_scene(run.cloud, frame_trajectory(run.slam), [], run.slam.intrinsics.tolist()))
    text = _page(run, tmp_path, warnings=("frame 3 is torn & skipped",), **({"view": view} if has_viewer() else {}))
    checker = CheckedPage(text)
    assert checker.wrong == []
    assert checker.open == []
    assert all(link.startswith("#") for link in checker.links)
    assert len(checker.ids) == len(set(checker.ids))
    assert "@import" not in text
    assert ("<script" in text) == has_viewer()
    for part in (
        "Map in 3D",
        "Trajectory",
        "Residuals over time",
        "Map",
        "Depth and confidence",
        "Time by stage",
        "Settings",
    ):
        assert f"<h2>{part}</h2>" in text, part
    assert "a &lt;room&gt;" in text
    assert "frame 3 is torn &amp; skipped" in text
    assert "simulated, so all numbers here are" in text
    assert f"{FRAMES} / {FRAMES}" in text
    assert len(re.findall(r"data:image/jpeg", text)) == 2 + 3 * min(4, len(run.slam.keyframes))


def test_the_verdict_is_the_first_thing_on_the_page(run: RecordedRun, tmp_path: Path) -> None:
    """Level, reasons and segments stand before the title; a doubtful unit gives no length in metres."""
    found = [
        Finding("steps", "degraded", "frames 2 to 3: torn", 2, 3),
        Finding("depth range", "degraded", "<unit>", scale=True),
    ]
    verdict = conclude(found, [record.frame for record in run.slam.frames], [0.1 * k for k in range(FRAMES)], True)
    text = _page(run, tmp_path, verdict=verdict)
    for words in ("Degraded:", "frames 2 to 3: torn", "&lt;unit&gt;", 'title="frames 2 to 3'):
        assert 0 < text.index(words) < text.index("<h1>"), words
    assert "path length" not in text
    assert "path length" in _page(run, tmp_path)


def test_the_page_without_depth_and_without_windows(run: RecordedRun, tmp_path: Path) -> None:
    """A run without depth, map, truth or window has a page that says so."""
    without = [replace(k.images, depth=np.full_like(k.depth, np.nan)) for k in run.slam.keyframes]
    blank = [replace(k, images=images) for k, images in zip(run.slam.keyframes, without, strict=True)]
    slam = replace(run.slam, map=replace(run.slam.map, keyframes=tuple(blank), metric=False))
    empty = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    text = _page(run, tmp_path, slam, cloud=empty, windows=(), truth=None)
    told = summarise(slam, Verdict("good"), settings={}, seconds={}, recorded=True)["scale"]
    assert told == "free (no metric depth): lengths are in the unit of the recorded poses"
    for words in ("No window was adjusted", "The sequence has no depth", "too few points", "lengths have no unit"):
        assert words in text, words


def test_a_cube_is_where_it_should_be() -> None:
    """Seen from above, points right of the path appear at its right; nearer points hide those behind. Oracle: the
    places the points were put.
    """
    poses = np.tile(np.eye(4), (21, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 4, 21)  # along x, looking along z, world y down
    path = Trajectory(np.arange(21) / 10.0, poses)
    grid = np.linspace(0, 4, 160)
    floor = np.stack([*np.meshgrid(grid, [1.0], grid[:80])], -1).reshape(-1, 3)
    red = np.array([[2.0, 0.9, 1.0]]) + np.random.default_rng(0).uniform(-0.2, 0.2, (4000, 3)) * [1, 0, 1]
    points = np.concatenate([red, floor])
    colours = np.concatenate([np.full((len(red), 3), (255, 0, 0)), np.full((len(floor), 3), (0, 255, 0))])
    image = map_view.from_above(PointCloud(points, colours.astype(np.uint8)), path, 300)
    rows, columns = np.nonzero((image == (255, 0, 0)).all(-1))
    assert abs(columns.mean() - 150) < 6, "the cube is half way along the path"
    path_rows = np.nonzero((image == map_view._PATH).all(-1))[0]
    assert rows.mean() < path_rows.mean() - 20, "what the cameras look at is beyond the path, to its left"
    assert (image == (0, 255, 0)).all(-1).sum() > 20 * len(rows)
    inside = map_view.walk_in(PointCloud(points, colours.astype(np.uint8)), path, 300)
    assert abs(np.nonzero((inside == (255, 0, 0)).all(-1))[1].mean() - 150) < 4


def test_a_map_that_lies_overhead_is_drawn() -> None:
    """False depth can put every point above the headroom over the path; they are drawn then, not left out."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 1, 5)
    overhead = np.random.default_rng(1).uniform((-1, -9, 1), (2, -8, 3), (500, 3))  # world y down
    cloud = PointCloud(overhead, np.full((500, 3), (255, 0, 0), np.uint8))
    image = map_view.from_above(cloud, Trajectory(np.arange(5) / 10.0, poses), 300)
    assert (image == (255, 0, 0)).all(-1).any()
