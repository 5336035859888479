"""The loop over the frames of a run: tracked one by one, kept as checkpoints, ended after a whole frame by Ctrl-C."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple, dataclass

from vggtgeo.datasets import Frame
from vggtgeo.io.errors import InputError
from vggtgeo.io.interruption import Interruption
from vggtgeo.results.checkpoints import Checkpoints, Keeper, Notice, RunSoFar, check_same_frame
from vggtgeo.results.frames_in_hand import FramesInHand, read_only
from vggtgeo.results.run_callbacks import RunCallbacks
from vggtgeo.results.source import Source
from vggtgeo.slam.pending_window import settled
from vggtgeo.slam.run import run_frames
from vggtgeo.slam.settings.presets import Perception
from vggtgeo.slam.settings.slam_settings import SlamSettings
from vggtgeo.slam.state import Slam


@dataclass(frozen=True, eq=False)
class Tracked:
    """The state after the last frame that was tracked."""

    slam: Slam
    interrupted: bool
    frames_per_second: float


@dataclass(frozen=True, eq=False)
class TrackingLoop:
    """The loop over frames. collected: warnings so far. began: of the run, s. before: the run that this one goes on.
    first: the state before the first frame, where there is a map.
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
    def keeping(self, asked: Checkpoints | None, wanted: Mapping[str, str]) -> Iterator[Keeper | None]:
        """What keeps the state, where it is asked for and could be gone on with; its last file is whole at the end."""
        if asked is None or self.source.count(*self.selection) is None:
            yield None
            return
        first = time.perf_counter()
        keeper = Keeper(asked, wanted, lambda slam: self._so_far(slam, first), self._tell)
        try:
            yield keeper
        finally:
            keeper.close()

    def track(self, keeper: Keeper | None) -> Tracked:
        """Ctrl-C ends it after a whole frame, or while none comes, an input error of the sequence without a result."""
        known = self.first if self.before is None else self.before.slam
        slam, frame, interrupted = known, None, False
        self.hooks.each("on_begin", self.source.name, self.source.count(*self.selection))
        began = time.perf_counter()
        try:
            before, rest = self._frames(keeper)
            frames = FramesInHand(rest)
            roles, clock = self.perception.roles, self.hooks.clock
            run = run_frames(
                frames, self.source.camera, roles, self.settings, clock, known, before, waiting=self.stop.at_once
            )
            for slam in run:
                frame = read_only(frames.take(slam.frames[-1]))
                self.hooks.each("on_frame", slam, frame)
                if keeper is not None:
                    keeper.on_frame(slam, frame)
                if self.stop.asked:
                    break
        except KeyboardInterrupt:
            interrupted = True
        interrupted = interrupted or self.stop.asked
        if slam is None or not slam.frames:
            if interrupted:
                raise KeyboardInterrupt
            raise InputError(f"`{self.source.name}` gave no frame that could be used; nothing was written")
        if interrupted:
            self._tell("interrupted: keeping what there is")
        elif keeper is not None:
            keeper.on_end(slam, frame)
        slam = settled(slam)
        earlier = 0.0 if self.before is None else self.before.tracking
        return Tracked(slam, interrupted, len(slam.frames) / (earlier + time.perf_counter() - began))

    def _frames(self, keeper: Keeper | None) -> tuple[list[Frame], Iterator[Frame]]:
        """The last two frames that were tracked, if any, of which one is looked at, and what is left of the
        selection.
        """
        start, end, stride = self.selection
        if self.before is None or keeper is None:
            return [], iter(self.source.frames.frames(start, end, stride))
        tracked = [record.frame for record in self.before.slam.frames[-2:]]
        frames = iter(self.source.frames.frames(tracked[0], end, stride))
        before = []
        for frame in frames:
            if frame.index in tracked:
                before.append(frame)
            if frame.index >= tracked[-1]:
                break
        check_same_frame(keeper.asked, before[-1] if before else None)
        self.before.restore_refusals(self.perception.refusals)
        for stage, seconds in self.before.seconds.items():
            self.hooks.clock.seconds[stage] += seconds
        self.hooks.resume(self.before)
        return before, frames

    def _so_far(self, slam: Slam, first: float) -> RunSoFar:
        now, before = time.perf_counter(), self.before
        said = self.collected if before is None else before.unsaid(self.collected)
        return RunSoFar(
            slam,
            self.hooks.so_far(),
            tuple(map(Notice.of, said)),
            {role: astuple(counts) for role, counts in self.perception.refusals.items()},
            dict(self.hooks.clock.seconds),
            now - first + (0.0 if before is None else before.tracking),
            now - self.began + (0.0 if before is None else before.whole),
        )

    def _tell(self, text: str) -> None:
        self.hooks.each("on_message", text)
