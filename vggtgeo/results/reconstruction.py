"""Run the whole system on a sequence with `reconstruct`, which the command line uses, too."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

from vggtgeo.compilation.process_settings import in_double_precision, program_settings
from vggtgeo.datasets import Sequence
from vggtgeo.datasets.frame import check_range
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.argument_checks import check_kind, check_plain, check_whole
from vggtgeo.io.errors import InputError, InputWarning, collected_warnings, warn
from vggtgeo.io.process import Interruption, interruption, return_freed_memory
from vggtgeo.mapping.dense import check_dense, check_mode, dense_map
from vggtgeo.report import RunRecord
from vggtgeo.results.checkpoints import Checkpoints, digest_of_map, load_checkpoint, run_identity
from vggtgeo.results.result import Result
from vggtgeo.results.source import (
    PosePrior,
    Source,
    StaticOverlaySearch,
    open_source,
    reduction_summary,
    with_pose_prior,
)
from vggtgeo.results.summary import compare_with_truth, summarise
from vggtgeo.results.tracking_loop import RunCallbacks, TrackingLoop
from vggtgeo.slam.callback import Callback, WindowRecorder
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.global_map.compile_ahead import CompileAhead
from vggtgeo.slam.known_map import entered
from vggtgeo.slam.perception.recorded_poses import RecordedPoses
from vggtgeo.slam.pose_prior import prior_summary
from vggtgeo.slam.run import check_run_arguments, default_roles, finish
from vggtgeo.slam.self_calibration import CALIBRATION_FRAMES, MAX_PASSES, self_calibrate
from vggtgeo.slam.settings.presets import Perception
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.settings.table import changed
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.corner_recorder import CornerRecorder
from vggtgeo.slam.verdict.findings import Verdict
from vggtgeo.slam.verdict.judge import check_input, check_refusals, judge_or_report


@dataclass(frozen=True)
class RunOptions:
    """Options of `vggtgeo.reconstruct` other than the settings of the pipeline.

    Fields:
        start: first frame.
        end: frame to stop before; None: after the last.
        stride: take every n-th frame.
        seed: of the random samples of robust estimators; runs with equal seeds have equal results.
        dense: source of the dense depth: auto, mvs, sensor, network or none (`vggtgeo/mapping/dense.py`).
        title: of the report; None: the name of the sequence.
        facts: additional entries of the summary.
        warned: earlier warnings about the input, for the verdict and the report.
        checkpoints: file and interval of checkpoints, and whether to resume from an existing one.

    Raises:
        InputError: a value is invalid.

    Example:
        >>> import vggtgeo as vg
        >>> vg.RunOptions(end=100, dense="none").stride
        1
        >>> vg.RunOptions(start=5, end=5)
        Traceback (most recent call last):
            ...
        vggtgeo.io.errors.InputError: `end` must be above `start`, got start 5 and end 5

    """

    start: int = 0
    end: int | None = None
    stride: int = 1
    seed: int = 0
    dense: str = "auto"
    title: str | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    warned: Iterable[Warning | str] = ()
    checkpoints: Checkpoints | None = None

    def __post_init__(self) -> None:
        check_range(*self.selection)
        check_whole("seed", self.seed)
        check_mode(self.dense)
        check_kind("title", self.title, str | None, "a text")
        check_plain("facts", self.facts)
        if isinstance(self.warned, str) or not isinstance(self.warned, Iterable):
            check_kind("warned", self.warned, (), "a list of warnings or texts")
        check_kind("checkpoints", self.checkpoints, Checkpoints | None, "`vggtgeo.settings.Checkpoints`, or None")

    @property
    def selection(self) -> tuple[int, int | None, int]:
        """Return start, end and stride."""
        return self.start, self.end, self.stride


@in_double_precision
def reconstruct(
    frames: str | os.PathLike[str] | Sequence | Iterable[Any],
    roles: Roles | Perception | None = None,
    settings: SlamSettings | None = None,
    *,
    camera: Camera | None = None,
    known_map: Slam | None = None,
    pose_prior: PosePrior = None,
    callbacks: Iterable[Callback] = (),
    options: RunOptions | None = None,
) -> Result:
    """Track all frames, map them, adjust the whole map, and return the result with its verdict.

    Ctrl-C (in a notebook: the stop button) ends the run with the result of the frames so far, and the summary's
    `interrupted` is true. A second Ctrl-C ends it at once, without a result.

    Compiled programs are cached in the user's cache folder, or in JAX's `jax_compilation_cache_dir` if that is set. The
    first call, which compiles, takes half a minute longer. `JAX_ENABLE_COMPILATION_CACHE=0` disables the cache.

    Python's warnings belong to the process: if several threads run at once, each result has the input warnings of all.

    Args:
        frames: a folder or a video file, a sequence (`vggtgeo.read`, `vggtgeo.simulate`), or an iterable of `Frame`,
            of images uint8 [H, W, 3] RGB, or of pairs of image and depth (float [H, W], metres, NaN = unknown).
        roles: perception objects, or those of `vggtgeo.perception`; by default the classical ones, without depth if
            the frames have none.
        settings: of the pipeline.
        camera: of the frames; overrides the calibration of the folder. By default a guess for an iterable.
        known_map: map of `vggtgeo.load_map` to localise in and extend; with the setting `keyframes.localise_only` it
            is not changed.
        pose_prior: poses to use as a motion prior, camera -> world: "recorded" for the poses of the recording (which is
            then without ground truth), a file of poses, or a `Trajectory`. Poses of another recording are detected and
            not used.
        callbacks: called with every frame.
        options: selection of frames, dense map, report, and checkpoints.

    Raises:
        InputError: an argument is invalid, no frame is usable, or the checkpoint belongs to another run.

    Example:
        >>> import vggtgeo as vg
        >>> settings = vg.SlamSettings(window=vg.settings.WindowSettings(size=3, point_slots=16, line_slots=12))
        >>> vg.reconstruct(vg.simulate("room", 2, size=(160, 120)), settings=settings).summary["frames"]
        2

    """
    clock, began = Clock(), time.perf_counter()
    check_run_arguments(roles.roles if isinstance(roles, Perception) else roles, settings, camera, known_map)
    check_kind("callbacks", callbacks, Iterable, "a list of `vggtgeo.Callback`")
    check_kind("options", options, RunOptions | None, "`vggtgeo.RunOptions`, or None")
    settings, options = settings or SlamSettings(), options or RunOptions()
    selection = options.selection
    with program_settings(), interruption() as stop, collected_warnings() as collected:
        with stop.at_once():  # without waiting for a frame, which a live camera may never deliver
            source, recorded = with_pose_prior(open_source(frames, camera, settings), pose_prior)
        source.check(*selection)
        perception = _perception(roles, source.has_depth, options.seed, recorded)
        check_dense(options.dense, perception.roles.metric, perception.roles.depth)
        first = _first_state(known_map, source, settings, perception.roles)
        identity = run_identity(
            *(settings, perception.roles, source.identity(selection)),
            {name: session.digest for name, session in perception.networks.items()},
            dense=options.dense,
            seed=options.seed,
            known_map=None if first is None else digest_of_map(first),
        )
        before = load_checkpoint(source.resumable(options.checkpoints), identity)
        # Corners for the verdict are undistorted here, or later by the lens of a known map.
        corner_camera = source.camera if first is None or first.camera.lens is None else source.camera.pinhole
        windows, corners, overlay = WindowRecorder(), CornerRecorder(corner_camera), StaticOverlaySearch()
        hooks = RunCallbacks((windows, corners, overlay, CompileAhead(settings), *callbacks), clock)
        with clock.measure("compile"), stop.at_once():
            hooks.warm_up(settings, perception.roles, source.camera)
        if settings.camera.static_overlay and source.repeatable(selection):
            with stop.at_once():
                perception = _mask_overlay(perception, source, selection, hooks, overlay, corners)
        if first is None and before is None:
            first = _calibrate(source, selection, perception, settings, hooks, stop)
        loop = TrackingLoop(source, selection, perception, settings, hooks, stop, collected, began, before, first)
        with loop.checkpoint_writer(options.checkpoints, identity) as writer:
            slam, interrupted, rate = loop.track(writer)
            hooks.compiled()
            hooks.each("on_adjust", slam)
            if not interrupted:
                slam, interrupted = _finish(slam, perception.roles, settings, hooks, stop)
        run = {"frames_per_second": round(rate, 2), "interrupted": interrupted}
        facts = {**perception.facts(), **options.facts, **run, **_facts_of_input(source, slam, perception, overlay)}
        return _conclude(slam, loop, options, facts, (windows, corners, overlay))


def _facts_of_input(
    source: Source, slam: Slam, perception: Perception, overlay: StaticOverlaySearch
) -> Mapping[str, Any]:
    """Return the entries of the summary about reduced images, recorded poses, and a static overlay."""
    return {
        **reduction_summary(source, slam),
        **prior_summary(slam, perception.roles),
        **({} if overlay.found is None else {"static_overlay": round(overlay.found.share, 4)}),
    }


def _conclude(
    slam: Slam,
    loop: TrackingLoop,
    options: RunOptions,
    facts: Mapping[str, Any],
    recorders: tuple[WindowRecorder, CornerRecorder, StaticOverlaySearch],
) -> Result:
    """Build the dense map and, in a parallel thread, the verdict; then the summary."""
    source, hooks, before, (windows, corners, overlay) = loop.source, loop.hooks, loop.before, recorders
    clock, report = hooks.clock, compare_with_truth(slam, source.truth)
    earlier = 0.0 if before is None else before.whole
    warned = (*options.warned, *(loop.collected if before is None else before.merge_warnings(loop.collected)))

    @in_double_precision
    def judge() -> Verdict:
        with clock.measure("verdict (own thread)"):
            of_images = check_refusals(loop.perception.refusals) + overlay.findings()
            return judge_or_report(slam, corners.frames, check_input(warned, len(slam.frames)) + of_images)

    hooks.each("on_stage", "dense map and verdict")
    return_freed_memory()
    with ThreadPoolExecutor(1, thread_name_prefix="verdict") as pool:
        judging = pool.submit(judge)
        with clock.measure("dense map"):
            built = dense_map(slam, options.dense)
        hooks.each("on_finish", slam, built.cloud)
        verdict = judging.result()
    summary = {
        **summarise(
            slam,
            verdict,
            settings=changed(loop.settings),
            seconds={**clock.seconds, "all": time.perf_counter() - loop.began + earlier},
            report=report,
            truth_in_metres=source.truth_in_metres,
            recorded=facts.get("pose_prior", {}).get("used", False),
            map_points=len(built.cloud),
            dense=options.dense,
        ),
        **facts,
    }
    notices = (*([facts["meaningless"]] if "meaningless" in facts else []), *map(str, warned))
    valid = (slam.camera.lens or source.camera).undistorter().valid
    title = options.title or source.name
    record = RunRecord(slam, built, tuple(windows.records), source.truth, notices, title, valid)
    return Result.assemble(record, verdict, summary)


def _first_state(known: Slam | None, source: Source, settings: SlamSettings, roles: Roles) -> Slam | None:
    """Return the state before the first frame of a run in a known map; None without a map.

    Raises InputError if a needed map is missing, or the map has another camera or matcher.
    """
    if known is not None:
        if source.has_depth and not known.metric:
            warn(
                "`known_map` has an unknown scale (it was made without depth), so the metric depth of these frames is "
                "not used; start a new map for a metric one"
            )
        return entered(known, source.camera, roles.points)
    if settings.keyframes.localise_only:
        raise InputError("`known_map` (`--map FILE`) must be given with `keyframes.localise_only`, got None")
    return None


def _calibrate(
    source: Source,
    selection: tuple[int, int | None, int],
    perception: Perception,
    settings: SlamSettings,
    hooks: RunCallbacks,
    stop: Interruption,
) -> Slam | None:
    """Self-calibrate an unknown camera on the first frames; return the state before the first frame, or None.

    Warnings are ignored and counts of refusals restored, since the run on the same frames reports them.
    """
    start, _, stride = selection
    count = min(source.count(*selection) or 0, CALIBRATION_FRAMES)
    if source.camera.known or not count or not settings.refinement.global_adjustment:
        return None
    end = start + count * stride
    refused = {role: replace(counts) for role, counts in perception.refusals.items()}

    shown = 0

    def progress(passes: int, frame: int | None) -> None:
        nonlocal shown
        name = f"camera calibration, pass {passes}"
        if frame is None:
            hooks.each("on_stage", f"{name}: adjusting")
        else:
            if shown != passes:
                hooks.each("on_stage", f"{name} of at most {MAX_PASSES}")
            shown = passes
            hooks.each("on_stage_frame", (frame - start) // stride + 1, count)

    with hooks.clock.measure("self-calibration"), stop.at_once(), warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        frames = lambda every: source.frames.frames(start, end, stride * every)
        found = self_calibrate(frames, count, source.camera, perception.roles, settings, progress)
    for role, counts in refused.items():
        vars(perception.refusals[role]).update(vars(counts))
    return found


def _mask_overlay(
    perception: Perception,
    source: Source,
    selection: tuple[int, int | None, int],
    hooks: RunCallbacks,
    overlay: StaticOverlaySearch,
    corners: CornerRecorder,
) -> Perception:
    """Search for a static overlay; mask it in perception and in the corners for the verdict."""
    hooks.each("on_stage", "searching for a static overlay in the images")
    with hooks.clock.measure("static overlay"):
        overlay.search(source, selection)
    if overlay.found is None:
        return perception
    corners.leave_out(overlay.found.mask)
    return replace(perception, roles=replace(perception.roles, static_overlay=overlay.found))


def _perception(
    roles: Roles | Perception | None, has_depth: bool, seed: int, recorded: RecordedPoses | None
) -> Perception:
    found = roles if isinstance(roles, Perception) else Perception(roles or default_roles(has_depth), {})
    found = found if recorded is None else replace(found, roles=replace(found.roles, recorded=recorded))
    return replace(found, roles=found.roles.seeded(seed)) if seed else found


def _finish(
    slam: Slam, roles: Roles, settings: SlamSettings, hooks: RunCallbacks, stop: Interruption
) -> tuple[Slam, bool]:
    """Run the last adjustment; return the state, and whether Ctrl-C ended it."""
    hooks.each("on_stage", "last adjustment")
    return_freed_memory()
    try:
        with stop.at_once():
            return finish(slam, roles, settings, hooks.clock), False
    except KeyboardInterrupt:
        hooks.each("on_message", "interrupted: keeping the result without the last adjustment")
        return slam, True
