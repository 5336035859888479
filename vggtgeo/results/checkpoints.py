"""What a run keeps of itself while it goes on, so that it goes on after a kill to the same bits: a state file with what
the callbacks have gathered, the warnings, the times, and what the run is of.

It is written in a thread of its own, as a state never changes, and takes its place in one step. The next one waits so
long that all of them take at most `SHARE` of the run: of the processor's time, which is what the thread takes from it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vggtgeo.datasets.frame import Frame
from vggtgeo.io.checkpoint_pace import EVERY, SHARE
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning
from vggtgeo.io.given import check_real, path_of
from vggtgeo.io.record_file import AGAIN, Layout
from vggtgeo.io.records import by_name
from vggtgeo.models.onnx.bounds import Refusals
from vggtgeo.results.output_checks import check_place
from vggtgeo.results.summary import versions
from vggtgeo.slam.precision import in_double_precision
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.state_file import STATE_CLASSES, VERSION, checked_state
from vggtgeo.slam.trust.evidence import EvidenceSoFar, FrameEvidence
from vggtgeo.slam.window_recorder import WindowRecord

_BEFORE, _SHOWN = 30, 110
"""Letters of a long setting that are shown, and those of them that lie before where it is another one."""


@dataclass(frozen=True)
class Checkpoints:
    """Where a run keeps its state, and whether it goes on from the one that is there.

    Fields:
        path: of the file.
        resume: go on from it; where there is none, the run begins at its first frame.
        every: seconds between two states, or more where they are large; 0: after each frame, whatever it takes.

    Example:
        >>> from pathlib import Path
        >>> import vggtgeo as vg
        >>> kept = vg.Checkpoints(Path("night.npz"), resume=True)  # give it to `vg.reconstruct(..., checkpoints=kept)`
        >>> kept.every  # seconds
        10.0

    """

    path: Path
    resume: bool = False
    every: float = EVERY

    def __post_init__(self) -> None:
        path_of("path", self.path)
        check_real("checkpoint-every", self.every, "seconds, at least 0")
        if not (math.isfinite(self.every) and self.every >= 0):
            raise InputError(f"`checkpoint-every` is {self.every:g}; it must be seconds, at least 0")


@dataclass(frozen=True)
class Notice:
    """A warning about the input. frames: that were left out, None of another kind."""

    text: str
    frames: int | None = None

    @classmethod
    def of(cls, warning: Warning | str) -> Notice:
        """Of a warning that was collected."""
        return cls(str(warning), warning.frames if isinstance(warning, LeftOutWarning) else None)

    def warning(self) -> Warning:
        """The warning again."""
        return InputWarning(self.text) if self.frames is None else LeftOutWarning(self.text, self.frames)


@dataclass(frozen=True, eq=False)
class RunSoFar:
    """A run between two frames. callbacks: what each gave, by the name of its class. refused: by role, the counts of
    `Refusals`. seconds: by stage; tracking, whole: since the first frame, and since the run began.
    """

    slam: Slam
    callbacks: Mapping[str, Any]
    notices: tuple[Notice, ...]
    refused: Mapping[str, tuple[int, ...]]
    seconds: Mapping[str, float]
    tracking: float
    whole: float

    def unsaid(self, collected: Iterable[Warning | str]) -> list[Warning | str]:
        """All warnings of the run, those of this part after those before: what is read again says the same again."""
        known = Counter(self.notices)
        fresh: list[Warning | str] = []
        for warning in collected:
            if known[Notice.of(warning)] > 0:
                known[Notice.of(warning)] -= 1
            else:
                fresh.append(warning)
        return [*(notice.warning() for notice in self.notices), *fresh]

    def restore_refusals(self, refusals: Mapping[str, Refusals]) -> None:
        """Counts on from those of before; InputError where they are of other networks, or no counts."""
        known = {role: len(dataclasses.fields(counts)) for role, counts in refusals.items()}
        found = {role: len(counts) for role, counts in self.refused.items()}
        strange = any(known.get(role) != count for role, count in found.items())
        if strange or min((value for counts in self.refused.values() for value in counts), default=0) < 0:
            raise InputError(
                f"the run that goes on kept {dict(self.refused)} of what networks refused; expected "
                f"counts of {', '.join(known) or 'none'}: begin anew with `--no-resume`"
            )
        for role, counts in self.refused.items():
            for entry, value in zip(dataclasses.fields(Refusals), counts, strict=True):
                setattr(refusals[role], entry.name, value)


KEPT_CLASSES = (*STATE_CLASSES, RunSoFar, Notice, EvidenceSoFar, FrameEvidence, WindowRecord)
CHECKPOINT = Layout("checkpoint", VERSION, by_name(KEPT_CLASSES))


def identity(
    settings: SlamSettings, roles: Roles, source: Mapping[str, Any], networks: Mapping[str, str], **more: Any
) -> dict[str, str]:
    """What a run is of, as texts by their names; a run goes on only where all are the same.

    source: what is known of the sequence. networks: digest of each file. more: what else the result depends on.
    """
    by_stage = {
        f"{group.name}.{entry.name}": getattr(getattr(settings, group.name), entry.name)
        for group in dataclasses.fields(settings)
        for entry in dataclasses.fields(getattr(settings, group.name))
    }
    played = {entry.name: getattr(roles, entry.name) for entry in dataclasses.fields(roles)}
    every = {**versions(), **source, **by_stage, **played, **networks, **more}
    # An object without a `repr` of its own tells its address, which is another in each process.
    return {name: re.sub(r" at 0x[0-9a-f]+", "", repr(value)) for name, value in every.items()}


@in_double_precision
def resumed(asked: Checkpoints | None, wanted: Mapping[str, str]) -> RunSoFar | None:
    """The run to go on with; None where nothing is asked, or there is none.

    Raises:
        InputError: the file is damaged, or of a run of something else; or the path is that of no file.

    """
    if asked is not None:
        check_place(asked.path)
    if asked is None or not asked.resume or not asked.path.is_file():
        return None
    known = _facts(asked.path)["identity"]
    others = [name for name in {**known, **wanted} if known.get(name) != wanted.get(name)]
    if others:  # the plainest: a seed is also in all that draws samples
        name = min(others, key=lambda one: len(known.get(one, "")) + len(wanted.get(one, "")))
        was, has = _where_they_differ(known.get(name), wanted.get(name))
        raise InputError(
            f"`{asked.path}` is of a run with `{name}` {was}, and this one has {has}: give the same, or begin anew "
            "with `--no-resume`"
        )
    try:
        found, _ = CHECKPOINT.read(asked.path)
        if not isinstance(found, RunSoFar) or not found.slam.frames:
            raise InputError(f"`{asked.path}` holds no run")
        checked_state(asked.path, found.slam)
        if not all(0 <= took < math.inf for took in (*found.seconds.values(), found.tracking, found.whole)):
            raise InputError(f"`{asked.path}` says that a part of the run took {dict(found.seconds)} s: {AGAIN}")
    except InputError as error:
        raise InputError(f"{error}; begin anew with `--no-resume`") from None
    return found


def _facts(path: Path) -> dict[str, Any]:
    """What the header says of a run, before its data are read."""
    try:
        found = CHECKPOINT.facts(path)
    except InputError as error:
        raise InputError(f"{error}; begin anew with `--no-resume`") from None
    kinds = {"identity": dict, "frames": int, "last": int, "digest": str}
    whole = found.keys() == kinds.keys() and all(type(found[name]) is kind for name, kind in kinds.items())
    if not whole or not all(type(value) is str for value in found["identity"].values()):
        raise InputError(f"`{path}` holds no run; begin anew with `--no-resume`")
    return found


def _where_they_differ(before: str | None, now: str | None) -> tuple[str, str]:
    """Both texts; of long ones the part where they first differ, so that it does not lie in what is cut away."""
    same = next((at for at, (a, b) in enumerate(zip(before or "", now or "", strict=False)) if a != b), 0)
    start = max(same - _BEFORE, 0)
    return _cut(before, start), _cut(now, start)


def _cut(value: str | None, start: int) -> str:
    if value is None or len(value) <= _SHOWN:
        return "nothing" if value is None else value
    return f"{'...' * (start > 0)}{value[start : start + _SHOWN]}{'...' * (start + _SHOWN < len(value))}"


def frames_kept(path: Path) -> str:
    """How far the run in a file had come, in words."""
    count = _facts(path)["frames"]
    return f"{count} frame{'s' * (count != 1)}"


def check_same_frame(asked: Checkpoints, frame: Frame | None) -> None:
    """InputError unless `frame` is the last one of the run that goes on."""
    known = _facts(asked.path)
    if frame is None or known["digest"] != digest_of(frame):
        raise InputError(
            f"frame {known['last']} is another one than when the run in `{asked.path}` was killed: give the same "
            "source, or begin anew with `--no-resume`"
        )


def digest_of(frame: Frame) -> str:
    """SHA-256 of time, image and depth."""
    digest = hashlib.sha256(repr((frame.index, float(frame.timestamp), frame.image.shape)).encode())
    for image in (frame.image, frame.depth):
        if image is not None:
            digest.update(np.ascontiguousarray(image).data)
    return digest.hexdigest()


def digest_of_map(known: Slam) -> str:
    """SHA-256 of the poses and the key points of a map."""
    digest = hashlib.sha256(repr(len(known.map.pairs)).encode())
    for keyframe in known.keyframes:
        digest.update(keyframe.pose.tobytes())
        digest.update(np.ascontiguousarray(keyframe.features.pixels).data)
    return digest.hexdigest()


@dataclass(eq=False)
class Keeper:
    """Keeps the state of one run. gather: what there is beside the state, asked between two frames. tell: says a
    sentence to the user.
    """

    asked: Checkpoints
    identity: Mapping[str, str]
    gather: Callable[[Slam], RunSoFar]
    tell: Callable[[str], None]
    _pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, thread_name_prefix="checkpoint"))
    _writing: Future[float] | None = None
    _next: float = 0.0
    _kept: int = 0
    _failed: bool = False

    def __post_init__(self) -> None:
        self._next = time.monotonic() + self.asked.every

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """Keeps the state after a frame, if it is time."""
        if self._writing is not None and (self._writing.done() or self.asked.every == 0):
            self._ended(self._writing)
        if self._writing is None and not self._failed and time.monotonic() >= self._next:
            self._begin(slam, frame)

    def on_end(self, slam: Slam, frame: Frame | None) -> None:
        """Keeps the state after the last frame, if the run took so long that it is worth it."""
        self._wait()
        if self._kept and frame is not None and not self._failed:
            self._begin(slam, frame)

    def close(self) -> None:
        """Waits until the last file is written."""
        self._wait()
        self._pool.shutdown()

    def _wait(self) -> None:
        if self._writing is not None:
            self._ended(self._writing)

    def _begin(self, slam: Slam, frame: Frame) -> None:
        so_far = self.gather(slam)
        self._writing = self._pool.submit(self._write, so_far, frame)

    def _write(self, so_far: RunSoFar, frame: Frame) -> float:
        """Writes the file, waiting for a window that is adjusted meanwhile; returns the processor's seconds it took."""
        began = time.thread_time()
        count = len(so_far.slam.frames)
        facts = {"identity": self.identity, "frames": count, "last": frame.index, "digest": digest_of(frame)}
        CHECKPOINT.write(self.asked.path, so_far, facts)
        return time.thread_time() - began

    def _ended(self, writing: Future[float]) -> None:
        """A run whose state cannot be kept goes on without."""
        self._writing = None
        try:
            took = writing.result()
        except (OSError, TypeError, ValueError) as error:
            self._failed = True
            self.tell(f"the state of the run cannot be kept, so that it could not be resumed: {error}")
            return
        self._kept += 1
        self._next = time.monotonic() + (max(self.asked.every, took / SHARE) if self.asked.every else 0.0)
