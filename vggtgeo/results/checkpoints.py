"""Write checkpoints of a run, and resume a killed run from one, with bit-identical results.

A checkpoint has the SLAM state, the state of the callbacks, warnings, times, and the identity of the run (settings,
input, versions). A thread writes it while the run continues, since a state is immutable. The file is replaced
atomically. The interval grows so that all checkpoints take at most `SHARE` of the run's processor time.
"""

from __future__ import annotations

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

from vggtgeo.compilation.process_settings import in_double_precision
from vggtgeo.datasets.frame import Frame
from vggtgeo.io.argument_checks import check_real, path_of
from vggtgeo.io.errors import InputError, InputWarning, LeftOutWarning
from vggtgeo.io.persistence import Format, by_name
from vggtgeo.models.onnx.bounds import Refusals
from vggtgeo.results.output_checks import CHECKPOINT_SECONDS
from vggtgeo.results.summary import versions
from vggtgeo.slam.callback import WindowRecord
from vggtgeo.slam.settings.slam_settings import Roles, SlamSettings
from vggtgeo.slam.state import Slam
from vggtgeo.slam.state_file import STATE_CLASSES, VERSION, checked_state
from vggtgeo.slam.verdict.corner_recorder import FrameCorners

SHARE = 0.025
"""Maximum share of a run's time for checkpoints."""
_EXCERPT = 110
"""Maximum characters of a setting in an error."""


@dataclass(frozen=True)
class Checkpoints:
    """File and interval of a run's checkpoints, and whether the run resumes from an existing one.

    Fields:
        path: file of the checkpoint.
        resume: resume from the file; if it does not exist, the run starts at its first frame.
        every: minimum seconds between checkpoints; the interval is longer if they are large. 0: after each frame.

    Example:
        >>> from pathlib import Path
        >>> import vggtgeo as vg
        >>> kept = vg.settings.Checkpoints(Path("night.npz"), resume=True)  # for `vg.RunOptions(checkpoints=kept)`
        >>> kept.every  # seconds
        10.0

    """

    path: Path
    resume: bool = False
    every: float = CHECKPOINT_SECONDS

    def __post_init__(self) -> None:
        path_of("path", self.path)
        check_real("every", self.every)
        if not 0 <= self.every < math.inf:
            raise InputError(f"`every` must be at least 0 seconds and finite, got {self.every:g}")


Notice = tuple[str, int | None]
"""A warning about the input: its text, and the number of frames left out; None for other warnings."""


def notice_of(warning: Warning | str) -> Notice:
    """Return the notice of a warning."""
    return str(warning), warning.frames if isinstance(warning, LeftOutWarning) else None


@dataclass(frozen=True, eq=False)
class RunSoFar:
    """A run between two frames, as a checkpoint stores it.

    callbacks: state of each callback by class name. refused: counts of `Refusals` by role. seconds: time by stage, s.
    tracking: time since the first frame, s. whole: time since the start of the run, s.
    """

    slam: Slam
    callbacks: Mapping[str, Any]
    notices: tuple[Notice, ...]
    refused: Mapping[str, tuple[int, ...]]
    seconds: Mapping[str, float]
    tracking: float
    whole: float

    def merge_warnings(self, collected: Iterable[Warning | str]) -> list[Warning | str]:
        """Return the checkpoint's warnings, then those of `collected` that are not the same on reading frames again."""
        known = Counter(self.notices)
        new: list[Warning | str] = []
        for warning in collected:
            if known[notice_of(warning)] > 0:
                known[notice_of(warning)] -= 1
            else:
                new.append(warning)
        before = (
            InputWarning(text) if frames is None else LeftOutWarning(text, frames) for text, frames in self.notices
        )
        return [*before, *new]

    def restore_refusals(self, refusals: Mapping[str, Refusals]) -> None:
        """Add the checkpoint's counts to `refusals`."""
        for role, counts in self.refused.items():
            vars(refusals[role]).update(vars(Refusals(*counts)))


CHECKPOINT_CLASSES = (*STATE_CLASSES, RunSoFar, FrameCorners, WindowRecord)
CHECKPOINT = Format("checkpoint", VERSION, by_name(CHECKPOINT_CLASSES))


def run_identity(
    settings: SlamSettings, roles: Roles, source: Mapping[str, Any], networks: Mapping[str, str], **more: Any
) -> dict[str, str]:
    """Return all that the result of a run depends on, as text by name; a resumed run must have the same identity.

    source: `Source.identity`. networks: digest of each network file. more: further values.
    """
    by_stage = {
        f"{group}.{name}": value for group, values in vars(settings).items() for name, value in vars(values).items()
    }
    values = {**versions(), **source, **by_stage, **vars(roles), **networks, **more}
    # The default `repr` of an object contains its address, which differs between processes.
    return {name: re.sub(r" at 0x[0-9a-f]+", "", repr(value)) for name, value in values.items()}


@in_double_precision
def load_checkpoint(asked: Checkpoints | None, identity: Mapping[str, str]) -> RunSoFar | None:
    """Return the run to resume; None if `asked` does not resume, or the file does not exist.

    Raises:
        InputError: the file is damaged, or its run has another identity.

    """
    if asked is None or not asked.resume or not asked.path.is_file():
        return None
    saved = CHECKPOINT.facts(asked.path)["identity"]
    differing = [name for name in {**saved, **identity} if saved.get(name) != identity.get(name)]
    if differing:  # report the shortest: the seed, for example, is also a part of every role that samples
        name = min(differing, key=lambda one: len(saved.get(one, "")) + len(identity.get(one, "")))
        before, now = _excerpt(saved.get(name)), _excerpt(identity.get(name))
        raise InputError(
            f"`{name}` must be {before}, as in the run in `{asked.path}`, got {now}: use the same, or start again with "
            "`--no-resume`"
        )
    found: RunSoFar = CHECKPOINT.read(asked.path)[0]
    checked_state(asked.path, found.slam)
    return found


def _excerpt(value: str | None) -> str:
    return "unset" if value is None else value if len(value) <= _EXCERPT else f"{value[:_EXCERPT]}..."


def frame_count_text(path: Path) -> str:
    """Return the number of frames in a checkpoint, as text."""
    count = CHECKPOINT.facts(path)["frames"]
    return f"{count} frame{'s' * (count != 1)}"


def check_same_frame(asked: Checkpoints, frame: Frame | None) -> None:
    """Raise InputError unless `frame` is the last one of the checkpoint."""
    saved = CHECKPOINT.facts(asked.path)
    if frame is None or saved["digest"] != digest_of(frame):
        raise InputError(
            f"frame {saved['last']} differs from that of the run in `{asked.path}`: use the same input, or start again "
            "with `--no-resume`"
        )


def digest_of(frame: Frame) -> str:
    """Return the SHA-256 of a frame's time, image and depth."""
    digest = hashlib.sha256(repr((frame.index, float(frame.timestamp), frame.image.shape)).encode())
    for image in (frame.image, frame.depth):
        if image is not None:
            digest.update(np.ascontiguousarray(image).data)
    return digest.hexdigest()


def digest_of_map(known: Slam) -> str:
    """Return the SHA-256 of the poses and the key points of a map."""
    digest = hashlib.sha256(repr(len(known.map.pairs)).encode())
    for keyframe in known.keyframes:
        digest.update(keyframe.pose.tobytes())
        digest.update(np.ascontiguousarray(keyframe.features.pixels).data)
    return digest.hexdigest()


@dataclass(eq=False)
class CheckpointWriter:
    """Writes the checkpoints of one run. gather: returns the run so far. message: shows a text to the user."""

    asked: Checkpoints
    identity: Mapping[str, str]
    gather: Callable[[Slam], RunSoFar]
    message: Callable[[str], None]
    _pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, thread_name_prefix="checkpoint"))
    _writing: Future[float] | None = None
    _written: bool = False
    _next: float = 0.0

    def __post_init__(self) -> None:
        self._next = time.monotonic() + self.asked.every

    def on_frame(self, slam: Slam, frame: Frame) -> None:
        """Start to write a checkpoint after a frame, if the interval has passed."""
        if self._writing is not None and (self._writing.done() or self.asked.every == 0):
            self._wait()
        if self._writing is None and time.monotonic() >= self._next:
            self._begin(slam, frame)

    def on_end(self, slam: Slam, frame: Frame | None) -> None:
        """Write a checkpoint after the last frame, unless the run was too short for any checkpoint."""
        self._wait()
        if self._written and frame is not None:
            self._begin(slam, frame)

    def close(self) -> None:
        """Wait until the last file is written."""
        self._wait()
        self._pool.shutdown()

    def _begin(self, slam: Slam, frame: Frame) -> None:
        self._writing = self._pool.submit(self._write, self.gather(slam), frame)

    def _write(self, so_far: RunSoFar, frame: Frame) -> float:
        """Write the file, after waiting for a window that is being adjusted; return the processor time, s."""
        began = time.thread_time()
        count = len(so_far.slam.frames)
        facts = {"identity": self.identity, "frames": count, "last": frame.index, "digest": digest_of(frame)}
        CHECKPOINT.write(self.asked.path, so_far, facts)
        return time.thread_time() - began

    def _wait(self) -> None:
        """Wait for the file, and schedule the next; after an error the run continues without checkpoints."""
        if self._writing is None:
            return
        writing, self._writing = self._writing, None
        try:
            took = writing.result()
            self._written, self._next = True, time.monotonic()
            self._next += max(self.asked.every, took / SHARE) if self.asked.every else 0.0
        except (OSError, TypeError, ValueError) as error:
            self._written, self._next = False, math.inf
            self.message(
                f"the checkpoint `{self.asked.path}` cannot be written, so this run cannot be resumed: {error}"
            )
