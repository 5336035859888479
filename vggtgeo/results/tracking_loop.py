"""Loop over the frames of a run: track each, call the callbacks, write checkpoints, stop after a whole frame."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import astuple, dataclass, field
from typing import Any

from vggtgeo.datasets import Frame
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.argument_checks import check_kind
from vggtgeo.io.errors import InputError
from vggtgeo.io.process import Interruption
from vggtgeo.results.checkpoints import Checkpoints, CheckpointWriter, RunSoFar, check_same_frame, notice_of
from vggtgeo.results.source import Source
from vggtgeo.slam.callback import Callback
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.local_mapping import merge_pending_window
from vggtgeo.slam.perception.rgbd_alignment import compile_alignment
from vggtgeo.slam.run import run_frames
from vggtgeo.slam.settings.presets import Perception
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.tracking.tracking_state import FramePose
from vggtgeo.slam.window.sliding_window import warm_up


class PendingFrames:
    """Frames that a thread has read and the loop has not yet tracked, so that callbacks get each frame as read.

    A lock is not needed: `deque.append` and `popleft` are atomic.
    """

    def __init__(self, frames: Iterable[Frame]) -> None:
        self._frames = frames
        self._read: deque[Frame] = deque()

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._frames:
            self._read.append(frame)
            yield frame

    def take(self, record: FramePose) -> Frame:
        """Return the frame of a record; drop the frames before it, which tracking left out."""
        while True:
            frame = self._read.popleft()
            if (frame.index, frame.timestamp) == (record.frame, record.timestamp):
                return frame


@dataclass(frozen=True, eq=False)
class TrackingLoop:
    """The loop over the frames of a run.

    collected: warnings so far. began: start of the run, s. before: the run that this one resumes. first: the state
    before the first frame, None for an empty map.
    """

    source: Source
    selection: tuple[int, int | None, int]
    perception: Perception
    settings: SlamSettings
    hooks: RunCallbacks
    stop: Interruption
    collected: list[Warning | str]
    began: float
    before: RunSoFar | None
    first: Slam | None

    @contextmanager
    def checkpoint_writer(
        self, asked: Checkpoints | None, identity: Mapping[str, str]
    ) -> Iterator[CheckpointWriter | None]:
        """Yield a writer of checkpoints, and at the end wait for its last file.

        It is None if checkpoints are not requested, or the frames are a stream.
        """
        if asked is None or self.source.count(*self.selection) is None:
            yield None
            return
        first = time.perf_counter()
        writer = CheckpointWriter(asked, identity, lambda slam: self._so_far(slam, first), self._message)
        try:
            yield writer
        finally:
            writer.close()

    def track(self, writer: CheckpointWriter | None) -> tuple[Slam, bool, float]:
        """Track all frames; return the state after the last one, whether Ctrl-C ended the loop, and frames per second.

        Ctrl-C ends the loop after the current frame, or at once if the loop waits for a frame.
        """
        known = self.first if self.before is None else self.before.slam
        slam, frame, interrupted = known, None, False
        self.hooks.each("on_begin", self.source.name, self.source.count(*self.selection))
        began = time.perf_counter()
        try:
            before, rest = self._frames(writer)
            frames = PendingFrames(rest)
            roles, clock = self.perception.roles, self.hooks.clock
            run = run_frames(
                frames, self.source.camera, roles, self.settings, clock, known, before, waiting=self.stop.at_once
            )
            for slam in run:
                frame = frames.take(slam.frames[-1])
                self.hooks.each("on_frame", slam, frame)
                if writer is not None:
                    writer.on_frame(slam, frame)
                if self.stop.asked:
                    break
        except KeyboardInterrupt:
            interrupted = True
        interrupted = interrupted or self.stop.asked
        if slam is None or not slam.frames:
            if interrupted:
                raise KeyboardInterrupt
            raise InputError(f"`{self.source.name}` must have at least one valid frame, got none; nothing was written")
        if interrupted:
            self._message("interrupted: keeping the frames so far")
        elif writer is not None:
            writer.on_end(slam, frame)
        slam = merge_pending_window(slam)
        earlier = 0.0 if self.before is None else self.before.tracking
        return slam, interrupted, len(slam.frames) / (earlier + time.perf_counter() - began)

    def _frames(self, writer: CheckpointWriter | None) -> tuple[list[Frame], Iterator[Frame]]:
        """Return the last two frames of the resumed run, if any, and the remaining frames."""
        start, end, stride = self.selection
        if self.before is None or writer is None:
            return [], iter(self.source.frames.frames(start, end, stride))
        tracked = [record.frame for record in self.before.slam.frames[-2:]]
        frames = iter(self.source.frames.frames(tracked[0], end, stride))
        before = []
        for frame in frames:
            if frame.index in tracked:
                before.append(frame)
            if frame.index >= tracked[-1]:
                break
        check_same_frame(writer.asked, before[-1] if before else None)
        self.before.restore_refusals(self.perception.refusals)
        for stage, seconds in self.before.seconds.items():
            self.hooks.clock.seconds[stage] += seconds
        self.hooks.resume(self.before)
        return before, frames

    def _so_far(self, slam: Slam, first: float) -> RunSoFar:
        now, before = time.perf_counter(), self.before
        notices = self.collected if before is None else before.merge_warnings(self.collected)
        return RunSoFar(
            slam,
            self.hooks.so_far(),
            tuple(map(notice_of, notices)),
            {role: astuple(counts) for role, counts in self.perception.refusals.items()},
            dict(self.hooks.clock.seconds),
            now - first + (0.0 if before is None else before.tracking),
            now - self.began + (0.0 if before is None else before.whole),
        )

    def _message(self, text: str) -> None:
        self.hooks.each("on_message", text)


@dataclass(frozen=True, eq=False)
class RunCallbacks:
    """All callbacks of a run; their time is measured as a separate stage."""

    members: tuple[Callback, ...]
    clock: Clock
    compiling: list[Future[None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        for member in self.members:
            check_kind("callbacks", member, Callback, "instances of `vggtgeo.Callback`")

    def warm_up(self, settings: SlamSettings, roles: Roles, camera: Camera) -> None:
        """Compile the RGB-D alignment and, in a thread, the adjustment of windows and the programs of callbacks.

        The first frames are tracked meanwhile. A window waits if its program is not ready.
        """
        self.each("on_stage", "compiling")

        def compile_windows() -> None:
            compiled = warm_up(settings, roles.metric)
            for member in self.members:
                member.on_warm_up(*compiled)

        pool = ThreadPoolExecutor(1, thread_name_prefix="compile")
        self.compiling.append(pool.submit(compile_windows))
        pool.shutdown(wait=False)
        if roles.alignment is not None and roles.metric:
            compile_alignment(camera)

    def compiled(self) -> None:
        """Wait until `warm_up` has compiled all, and raise its error if there is one."""
        with self.clock.measure("compile"):
            while self.compiling:
                self.compiling.pop().result()

    def so_far(self) -> dict[str, Any]:
        """Return the state of each callback that has one, by class name, for a checkpoint."""
        found = {type(member).__name__: member.so_far() for member in self.members}
        return {name: value for name, value in found.items() if value is not None}

    def resume(self, before: RunSoFar) -> None:
        """Restore each callback from a checkpoint."""
        for member in self.members:
            member.on_resume(before.callbacks.get(type(member).__name__), before.slam)

    def each(self, hook: str, *arguments: Any) -> None:
        """Call a hook of every callback."""
        with self.clock.measure("record and draw"):
            for member in self.members:
                getattr(member, hook)(*arguments)
