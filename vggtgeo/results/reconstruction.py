"""A whole run in one call: frames in, a `Result` out. The command line calls the same function."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vggtgeo.datasets import Sequence
from vggtgeo.evaluation import TrajectoryReport
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputError, InputWarning
from vggtgeo.io.given import check_kind, check_plain, check_whole
from vggtgeo.io.interruption import Interruption, interruption
from vggtgeo.io.process_settings import program_settings
from vggtgeo.io.warned import collected_warnings
from vggtgeo.mapping.dense import check_dense, dense_map
from vggtgeo.models.onnx.bounds import Refusals
from vggtgeo.results.checkpoints import Checkpoints, digest_of_map, identity, resumed
from vggtgeo.results.result import Result, RunRecord
from vggtgeo.results.run_callbacks import RunCallbacks
from vggtgeo.results.source import Source, as_read, opened
from vggtgeo.results.still_search import StillSearch
from vggtgeo.results.summary import OWN, compare, summarise
from vggtgeo.results.tracking_loop import Tracked, TrackingLoop
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.first_pass import begin_with_found_camera
from vggtgeo.slam.global_map.compile_ahead import CompileAhead
from vggtgeo.slam.known_map import entered
from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.run import check_run_arguments, default_roles, finish
from vggtgeo.slam.settings.presets import Perception
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.settings.table import changed
from vggtgeo.slam.state import Slam
from vggtgeo.slam.trust.evidence import EvidenceRecorder
from vggtgeo.slam.trust.finding import Verdict
from vggtgeo.slam.trust.input import check_input, check_refusals
from vggtgeo.slam.trust.judge import judged_or_told
from vggtgeo.slam.window_recorder import WindowRecord, WindowRecorder

FREE_MAP = (
    "`known_map` was made without depth, so that its lengths have no unit: the depth of these frames, in metres, is "
    "not used; begin a new map to have it in metres"
)


@in_double_precision
def reconstruct(
    frames: str | os.PathLike[str] | Sequence | Iterable[Any],
    roles: Roles | Perception | None = None,
    settings: SlamSettings | None = None,
    *,
    camera: Camera | None = None,
    start: int = 0,
    end: int | None = None,
    stride: int = 1,
    seed: int = 0,
    dense: str = "auto",
    title: str | None = None,
    callbacks: Iterable[Callback] = (),
    facts: Mapping[str, Any] | None = None,
    warned: Iterable[Warning | str] = (),
    checkpoints: Checkpoints | None = None,
    known_map: Slam | None = None,
) -> Result:
    """Track and map every frame, adjust the whole map, judge the result.

    Ctrl-C (in a notebook: the stop button) ends the run early with the result of the frames so far, whose `summary`
    says `interrupted`: after the frame at hand, while none comes, or in place of the last adjustment. A second one
    ends it at once.

    Compiled code is kept in the user's cache folder, as by the program: the first call takes half a minute longer than
    those of later processes. A folder that JAX was given (`jax_compilation_cache_dir`) is taken in its place, and with
    JAX's `JAX_ENABLE_COMPILATION_CACHE=0` nothing is kept.

    Of runs in several threads of one process each counts the warnings about the input of all of them, as Python shows
    warnings for the process: give each a process where that matters.

    Args:
        frames: a folder or a video file, a sequence (`vggtgeo.read`, `vggtgeo.simulate`), or any iterable of `Frame`,
            of images uint8 [H, W, 3] RGB, or of pairs of an image and depth (float [H, W], metres, NaN = none).
        roles: perception objects, or those of `vggtgeo.perception`; by default the classical ones, without depth where
            the frames have none.
        settings: of the pipeline.
        camera: of the frames, in place of what their folder says; by default a guess for an iterable.
        start: first frame.
        end: frame to stop before.
        stride: take every n-th frame.
        seed: of the samples that robust estimators draw; a run is repeatable for each.
        dense: whose depth the map is made of: auto, mvs, sensor, network or none (`vggtgeo/mapping/dense.py`).
        title: of the report; by default the name of the sequence.
        callbacks: called with every frame.
        facts: what the summary shall say besides.
        warned: warnings about the input that came before, for the verdict and the report.
        checkpoints: where the state of the run is kept while it goes on, and whether it goes on from the one there.
        known_map: what `vggtgeo.load_map` gave: the frames are placed in this map, and extend it, or, with the setting
            `keyframes.localise_only`, leave it as it is.

    Raises:
        InputError: the frames cannot be read, none of them can be used, or the run to go on with is of something else.

    Example:
        >>> import vggtgeo as vg
        >>> settings = vg.SlamSettings(window=vg.settings.WindowSettings(size=3, point_slots=16, line_slots=12))
        >>> vg.reconstruct(vg.simulate("room", 2, size=(160, 120)), settings=settings).summary["frames"]
        2

    """
    clock, began = Clock(), time.perf_counter()
    _check_arguments(roles, settings, camera, known_map, callbacks, facts, warned, checkpoints, title, seed)
    settings = settings or SlamSettings()
    with program_settings(), interruption() as stop, collected_warnings() as collected:
        with stop.at_once():  # a camera may give no frame
            source = opened(frames, camera, settings)
        source.check(start, end, stride)
        perception = _perception(roles, source.has_depth, seed)
        check_dense(dense, perception.roles.metric, perception.roles.depth)
        selection = (start, end, stride)
        first = _first_state(known_map, source, settings, perception.roles)
        wanted = identity(
            *(settings, perception.roles, source.known(selection)),
            {name: session.digest for name, session in perception.networks.items()},
            dense=dense,
            seed=seed,
            known_map=None if first is None else digest_of_map(first),
        )
        before = resumed(source.resumable(checkpoints), wanted)
        # The verdict takes the lens of a known map out of these corners, as it does with one that this run finds.
        seen_by = source.camera if first is None or first.camera.lens is None else source.camera.pinhole
        windows, evidence, still = WindowRecorder(), EvidenceRecorder(seen_by), StillSearch()
        hooks = RunCallbacks((windows, evidence, still, CompileAhead(settings), *callbacks), clock)
        with clock.measure("compile"), stop.at_once():
            hooks.warm_up(settings, perception.roles, source.camera)
        perception = _without_still_parts(perception, source, selection, settings, hooks, (still, evidence), stop)
        if first is None and before is None:
            first = _first_pass(source, selection, perception, settings, hooks, stop)
        loop = TrackingLoop(source, selection, perception, settings, hooks, stop, collected, began, before, first)
        with loop.keeping(checkpoints, wanted) as keeper:
            tracked = loop.track(keeper)
            slam, interrupted = _adjust(tracked, perception.roles, settings, hooks, stop)
        began -= 0.0 if before is None else before.whole
        report = compare(slam, source.truth)
        known = {
            **perception.facts(),
            **(facts or {}),
            "frames_per_second": round(tracked.frames_per_second, 2),
            "interrupted": interrupted,
            **as_read(source, slam),
            **({} if still.found is None else {"still_parts": round(still.found.share, 4)}),
        }
        notices = (*warned, *(collected if before is None else before.unsaid(collected)))
        ending = _Ending(
            slam,
            source,
            report,
            notices,
            perception.refusals,
            title or source.name,
            known,
            clock,
            began,
            dense,
            (slam.camera.lens or source.camera).undistorter().valid,
        )
        return _concluded(ending, settings, hooks, windows.records, (still, evidence))


def _check_arguments(
    roles: Any,
    settings: Any,
    camera: Any,
    known_map: Any,
    callbacks: Any,
    facts: Any,
    warned: Any,
    checkpoints: Any,
    title: Any,
    seed: Any,
) -> None:
    """What is no argument of `reconstruct` is refused before the first frame, not where it is used: at the end, say."""
    check_run_arguments(roles.roles if isinstance(roles, Perception) else roles, settings, camera, known_map)
    check_kind("callbacks", callbacks, Iterable, "a list of `vggtgeo.Callback`")
    check_kind("checkpoints", checkpoints, Checkpoints | None, "`vggtgeo.Checkpoints`, or None")
    check_kind("title", title, str | None, "a text")
    check_plain("facts", {} if facts is None else facts)
    wrong = [key for key in facts or {} if not isinstance(key, str) or key in OWN]
    if wrong:
        raise InputError(
            f"`facts` has {wrong[0]!r:.60}; its names must be texts, and none that every summary has: "
            f"{', '.join(sorted(OWN))}"
        )
    if isinstance(warned, str) or not isinstance(warned, Iterable):
        check_kind("warned", warned, (), "a list of warnings or texts")
    check_whole("seed", seed)


@dataclass(frozen=True, eq=False)
class _Ending:
    """A run after its last adjustment: what it is judged and described by."""

    slam: Slam
    source: Source
    report: TrajectoryReport | None
    warned: tuple[Warning | str, ...]
    refusals: Mapping[str, Refusals]
    title: str
    facts: Mapping[str, Any]
    clock: Clock
    began: float
    dense: str
    seen: np.ndarray | None


def _concluded(
    run: _Ending,
    settings: SlamSettings,
    hooks: RunCallbacks,
    windows: Iterable[WindowRecord],
    witnesses: tuple[StillSearch, EvidenceRecorder],
) -> Result:
    """The map, the verdict, the summary."""
    slam, clock = run.slam, run.clock
    still, evidence = witnesses

    @in_double_precision
    def judged() -> Verdict:
        with clock.measure("verdict (own thread)"):
            of_input = check_input(run.warned, len(slam.frames)) + check_refusals(run.refusals) + still.findings()
            return judged_or_told(slam, evidence.frames, of_input)

    hooks.each("on_stage", "dense map and verdict")
    with ThreadPoolExecutor(1, thread_name_prefix="verdict") as pool:
        judging = pool.submit(judged)
        with clock.measure("dense map"):
            built = dense_map(slam, run.dense)
        hooks.each("on_finish", slam, built.cloud)
        verdict = judging.result()
    summary = {
        **summarise(
            slam,
            verdict,
            settings=changed(settings),
            seconds={**clock.seconds, "all": time.perf_counter() - run.began},
            report=run.report,
            truth_in_metres=run.source.truth_in_metres,
            map_points=len(built.cloud),
            dense=run.dense,
        ),
        **run.facts,
    }
    notices = (*([run.facts["meaningless"]] if "meaningless" in run.facts else []), *map(str, run.warned))
    return Result.assemble(
        RunRecord(slam, built, tuple(windows), run.source.truth, notices, run.title, run.seen), verdict, summary
    )


def _first_state(known: Slam | None, source: Source, settings: SlamSettings, roles: Roles) -> Slam | None:
    """Before the first frame, in a map that is known; InputError for one of another camera or matcher, or where one is
    needed.
    """
    if known is not None:
        if source.has_depth and not known.metric:
            warnings.warn(FREE_MAP, InputWarning, stacklevel=4)
        return entered(known, source.camera, roles.points)
    if settings.keyframes.localise_only:
        raise InputError("`keyframes.localise_only` needs a map to place frames in: give `known_map` (`--map FILE`)")
    return None


def _first_pass(
    source: Source,
    selection: tuple[int, int | None, int],
    perception: Perception,
    settings: SlamSettings,
    hooks: RunCallbacks,
    stop: Interruption,
) -> Slam | None:
    """The state before the first frame, where nobody gave the camera and a first pass over the frames finds it. What it
    warns of and refuses is told when the run itself comes to it.
    """
    start, _, stride = selection
    count = source.count(*selection)
    most = settings.camera.first_pass
    if source.camera.known or not count or not most or not settings.refinement.global_adjustment:
        return None
    end = start + min(count, most) * stride
    hooks.each("on_stage", f"finding the camera in the first {min(count, most)} frames")
    refused = {role: replace(counts) for role, counts in perception.refusals.items()}
    with hooks.clock.measure("first pass"), stop.at_once(), warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        frames = lambda: source.frames.frames(start, end, stride)
        found = begin_with_found_camera(frames, source.camera, perception.roles, settings)
    for role, counts in refused.items():
        vars(perception.refusals[role]).update(vars(counts))
    return found


def _without_still_parts(
    perception: Perception,
    source: Source,
    selection: tuple[int, int | None, int],
    settings: SlamSettings,
    hooks: RunCallbacks,
    witnesses: tuple[StillSearch, EvidenceRecorder],
    stop: Interruption,
) -> Perception:
    """Roles, and the verdict's witness, that look for nothing where the picture moves with the camera."""
    search, evidence = witnesses
    if not (settings.camera.still_parts and source.comes_again(selection)):
        return perception
    hooks.each("on_stage", "looking for what stays in its place in the picture")
    with hooks.clock.measure("still parts"), stop.at_once():
        search.look(source, selection)
    if search.found is None:
        return perception
    evidence.leave_out(search.found.mask)
    return replace(perception, roles=replace(perception.roles, still_parts=search.found))


def _perception(roles: Roles | Perception | None, has_depth: bool, seed: int) -> Perception:
    found = roles if isinstance(roles, Perception) else Perception(roles or default_roles(has_depth), {})
    return replace(found, roles=found.roles.seeded(seed)) if seed else found


def _adjust(
    tracked: Tracked, roles: Roles, settings: SlamSettings, hooks: RunCallbacks, stop: Interruption
) -> tuple[Slam, bool]:
    """The state after the last adjustment, and whether Ctrl-C ended the run; after Ctrl-C there is none."""
    hooks.each("on_adjust", tracked.slam)
    if tracked.interrupted:
        return tracked.slam, True
    hooks.each("on_stage", "last adjustment")
    try:
        with stop.at_once():
            return finish(tracked.slam, roles, settings, hooks.clock), False
    except KeyboardInterrupt:
        hooks.each("on_message", "interrupted: keeping what there is, without the last adjustment")
        return tracked.slam, True
