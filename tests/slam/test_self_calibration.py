"""Self-calibration: an unknown camera is estimated on calibration frames, and the run begins with it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from recorded_run import FRAMES, ROLES, SETTINGS, recorded_run, walk
from vggtgeo.models.onnx.bounds import Refusals

import vggtgeo as vg
import vggtgeo.results.reconstruction as reconstruction
from vggtgeo.datasets.frame import Frame
from vggtgeo.datasets.views import SequenceView
from vggtgeo.geometry.camera import Camera
from vggtgeo.io.errors import InputWarning
from vggtgeo.slam import self_calibration
from vggtgeo.slam.clock import Clock
from vggtgeo.slam.local_mapping import camera_prior
from vggtgeo.slam.pipeline import begin
from vggtgeo.slam.settings.presets import Perception
from vggtgeo.slam.state import Slam
from vggtgeo.slam.verdict.claim import Claim

GUESS = Camera.guess(320, 240)
FEW = vg.RunOptions(end=3, dense="none")
NO_FRAMES = lambda stride: iter(())  # what the fakes below do not look at
LENS = Camera((280.0, 280.0, 158.0, 121.0), 320, 240, (-0.1, 0.01, 0.0, 0.0), known=False)


def found(**camera: Any) -> Slam:
    """What the last adjustment of self-calibration gives: the recorded run's map, with a camera of its own."""
    slam = recorded_run().slam
    keyframes = (slam.keyframes * self_calibration.MIN_KEYFRAMES)[: self_calibration.MIN_KEYFRAMES]
    estimate = replace(slam.camera, intrinsics=np.array(LENS.intrinsics), **camera)
    return replace(slam, map=replace(slam.map, keyframes=keyframes), camera=estimate)


def begun(monkeypatch: pytest.MonkeyPatch, end: Slam) -> Slam | None:
    """The state that self-calibration gives whose last adjustment ends with `end`."""
    monkeypatch.setattr(self_calibration, "run_frames", lambda *_: iter([end.with_camera(lens=None)]))
    monkeypatch.setattr(self_calibration, "finish", lambda *_, **__: end)
    return self_calibration.self_calibrate(NO_FRAMES, 10, GUESS, ROLES, SETTINGS)


def test_the_state_before_the_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that camera and lens are handed on, with a word for the user, and nothing else of the pass.
    slam = begun(monkeypatch, found(lens=LENS))
    assert slam.camera.self_calibrated
    assert slam.camera.lens == LENS
    assert slam.intrinsics.tolist() == slam.camera.given.tolist() == list(LENS.intrinsics)
    for focal in (280.0, 5000.0):
        far = slam.with_camera(given=np.array([focal, focal, 158.0, 121.0]))
        assert not far.camera.calibrated, "the last adjustment estimates it once more"
    assert (slam.frames, slam.keyframes, slam.map.factors) == ((), (), ())
    assert "280.0 px (images of 320 x 240), lens distortion k1 -0.100" in slam.notes[0]
    plain = begun(monkeypatch, found())
    assert plain.camera.lens is None
    assert plain.notes[0].endswith("focal length 280.0 px (images of 320 x 240)")


def test_a_guess_is_held_until_there_are_three_keyframes() -> None:
    # Proves that a window of two keyframes leaves a camera that nobody gave where it is, that one of three does not
    # unless self-calibration found it, and that the verdict knows which of them it has. Oracle: the standard deviations
    # of the priors.
    slam = recorded_run().slam
    wide = slam.with_camera(sigma=np.full(4, 100.0), self_calibrated=False)
    for count, held in ((2, True), (3, False)):
        slam = wide.with_map(keyframes=wide.keyframes[:count])
        assert bool(camera_prior(slam).sigma[0] < 1.0) == held
        numbers = frozenset(range(count))
        pairs = tuple(pair for pair in wide.map.pairs if numbers.issuperset(pair.key))
        frames = tuple(replace(record, second=None) for record in wide.frames if record.reference < count)
        judged = slam.with_map(pairs=pairs, factors=(), roots=(0,)).with_tracker(frames=frames)
        assert Claim.of(judged).guessed == held
    assert camera_prior(wide.with_camera(self_calibrated=True)).sigma[0] < 1.0


def test_frames_are_tracked_again_until_the_camera_settles(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that a camera far from the one that frames were tracked with is tried on them, at most three times in all,
    # and that one pass is enough where it is near. Oracle: the cameras that the passes are told to find.
    tracked: list[float] = []

    def run(_: Any, camera: Camera, __: Any, ___: Any, ____: Clock, before: Slam | None) -> Any:
        tracked.append(camera.intrinsics[0] if before is None else before.intrinsics[0])
        slam = found()
        return iter([slam.with_camera(intrinsics=tracked[-1] * np.array([1.0, 1.0, 0.5, 0.4]))])

    def end(slam: Slam, *_: Any, rounds: int, uncertainty: bool) -> Slam:
        assert (rounds, uncertainty) == (1, False), "nothing of the pass but its camera is used"
        return slam.with_camera(intrinsics=np.array([answers[len(tracked) - 1]] * 2 + [160.0, 120.0]))

    monkeypatch.setattr(self_calibration, "run_frames", run)
    monkeypatch.setattr(self_calibration, "finish", end)
    guess = GUESS.intrinsics[0]
    for answers, cameras in (([1.01 * guess], [guess]), ([400.0, 300.0, 280.0], [guess, 400.0, 300.0])):
        tracked.clear()
        slam = self_calibration.self_calibrate(NO_FRAMES, 10, GUESS, ROLES, SETTINGS)
        assert tracked == pytest.approx(cameras)
        assert slam.intrinsics[0] == pytest.approx(answers[len(cameras) - 1])
    assert "3 passes" in slam.notes[0]


def test_few_of_the_calibration_frames_are_tracked(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that the first pass tracks every third of 150 frames, the next its keyframes; and all where these are not
    # enough. Oracle: the indices of the frames that each pass is given.
    frame = recorded_run().frames[0]
    read = lambda stride: (replace(frame, index=index) for index in range(0, 150, stride))
    keyframes, passes = {0, 30, 60, 147}, []
    focal = [GUESS.intrinsics[0]]

    def run(frames: Iterable[Frame], *_: Any) -> Any:
        passes.append([frame.index for frame in frames])
        slam = found().with_camera(intrinsics=np.array([focal[-1]] * 2 + [160.0, 120.0]))
        numbers = [*sorted(keyframes), *(len(slam.keyframes) - len(keyframes)) * [0]]
        own = tuple(replace(one, frame=number) for one, number in zip(slam.keyframes, numbers, strict=True))
        return iter([slam.with_map(keyframes=own if determined(passes) else own[:2])])

    def end(slam: Slam, *_: Any, **__: Any) -> Slam:
        focal.append(1.1 * focal[-1] if len(focal) == 1 else focal[-1])
        return slam.with_camera(intrinsics=np.array([focal[-1]] * 2 + [160.0, 120.0]))

    monkeypatch.setattr(self_calibration, "run_frames", run)
    monkeypatch.setattr(self_calibration, "finish", end)
    determined = lambda _: True
    assert self_calibration.self_calibrate(read, 150, GUESS, ROLES, SETTINGS) is not None
    assert passes == [list(range(0, 150, 3)), sorted(keyframes)]
    passes.clear()
    determined = lambda passes: len(passes) > 1
    assert self_calibration.self_calibrate(read, 150, GUESS, ROLES, SETTINGS) is not None
    assert passes == [list(range(0, 150, 3)), list(range(150))]


def test_a_pass_that_tells_no_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that a map of few keyframes, without depth fewer than ten, with it fewer than three, frames that were lost,
    # and a focal length that is none give no camera.
    whole = found()
    for metric, least in ((False, 10), (True, 3)):
        of = lambda count, metric=metric: whole.with_map(metric=metric, keyframes=whole.keyframes[:count])
        assert begun(monkeypatch, of(least)) is not None
        assert begun(monkeypatch, of(least - 1)) is None
    lost = tuple(replace(record, tracked=row > 5) for row, record in enumerate(whole.frames))
    assert begun(monkeypatch, whole.with_tracker(frames=lost)) is None
    assert begun(monkeypatch, whole.with_camera(intrinsics=np.array([1e6, 1e6, 160.0, 120.0]))) is None


class _Passes:
    """Stands for self-calibration: counts the frames of each call, and gives a camera."""

    def __init__(self, camera: Camera | None = LENS) -> None:
        self.counts: list[int] = []
        self._camera = camera

    def __call__(
        self, frames: Callable[[int], Iterable[Frame]], count: int, camera: Camera, roles: Any, *_: Any
    ) -> Slam | None:
        self.counts.append(len(list(frames(1))))
        assert self.counts[-1] == count
        assert len(list(frames(2))) == -(-count // 2)
        if self._camera is None:
            return None
        own = np.array(self._camera.intrinsics)
        slam = begin(camera, roles)
        return slam.with_camera(intrinsics=own, given=own, self_calibrated=True)


ADJUSTED = replace(SETTINGS, camera=vg.SlamSettings().camera, refinement=vg.SlamSettings().refinement)
"""Settings of the recorded run with a last adjustment, which no test of this file comes to."""


def run(monkeypatch: pytest.MonkeyPatch, passes: _Passes, frames: Any = None, **given: Any) -> vg.Result:
    """A run without a last adjustment, whose self-calibration is `passes`."""
    monkeypatch.setattr(reconstruction, "self_calibrate", passes)
    monkeypatch.setattr(reconstruction, "finish", lambda slam, *_: slam)
    monkeypatch.setattr(reconstruction, "CompileAhead", lambda _: vg.Callback())
    given = {"roles": ROLES, "settings": ADJUSTED, "options": vg.RunOptions(dense="none"), **given}
    return vg.reconstruct(SequenceView(walk(), GUESS, has_depth=True) if frames is None else frames, **given)


@pytest.mark.long
def test_a_guessed_camera_is_sought_first(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that the run begins with what self-calibration found, over at most `CALIBRATION_FRAMES` of the selected
    # frames, and with the guess where that finds none.
    passes = _Passes()
    result = run(monkeypatch, passes)
    assert result.intrinsics == pytest.approx(np.array(LENS.intrinsics), abs=0.1)
    assert "self-calibration" in result.summary["seconds_by_stage"]
    monkeypatch.setattr(reconstruction, "CALIBRATION_FRAMES", 2)
    run(monkeypatch, passes, options=vg.RunOptions(start=1, stride=3, dense="none"))
    assert passes.counts == [FRAMES, 2]
    assert run(monkeypatch, _Passes(None), options=FEW).record.slam.camera.given.tolist() == list(GUESS.intrinsics)


def test_no_self_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that a known camera and frames that come once need none.
    passes = _Passes()
    run(monkeypatch, passes, walk(), options=FEW)
    run(monkeypatch, passes, iter(recorded_run().frames[:3]))
    assert passes.counts == []


def test_warnings_of_calibration_frames_count_once(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that warnings about the input and answers that were refused count once, though frames are read twice.
    class Warns(SequenceView):
        def frames(self, start: int = 0, end: int | None = None, stride: int = 1) -> Any:
            reconstruction.warnings.warn("frame 1 is odd", InputWarning, stacklevel=2)
            return super().frames(start, end, stride)

    counts = Refusals(asked=1)

    class Refused(_Passes):
        def __call__(self, *given: Any) -> Slam | None:
            counts.note(5, 5, left=False)
            return super().__call__(*given)

    roles = Perception(ROLES, {}, {"depth": counts})
    with pytest.warns(InputWarning, match="odd") as told:
        result = run(monkeypatch, Refused(), Warns(walk(), GUESS, has_depth=True), roles=roles, options=FEW)
    assert [str(warning.message) for warning in told].count("frame 1 is odd") == 1
    assert result.record.warnings.count("frame 1 is odd") == 1
    assert counts == Refusals(asked=1)
