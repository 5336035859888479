"""Degrade sections of clips at random, and count right results, reported failures and unreported wrong results.

    .venv/bin/python benchmarks/random_degradations.py ../shared/data/* --seeds 0 8 [--jobs 2] [--out runs/random]

A seed is a section of one clip (40 to 90 frames from anywhere), undisturbed with and without depth, and six times with
two or three random changes of random strength. `benchmarks/stress.py` has a fixed list of changes, which was used to
develop the checks; here they are unlimited. A seed always gives the same cases: `--seeds 5 6` runs seed 5 again.

The words of the table are those of `benchmarks/stress.py`; a case is compared with the same undisturbed section.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from camera_errors import compressed, in_bands_of_light
from recordings import write
from stress import ORDER, Case, add_run_options, excused, judge, row, run_case

import vggtgeo as vg
from vggtgeo.datasets.frame import Frame
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.simulation.degradations import (
    Recording,
    with_depths,
    with_images,
    without_depth,
)

Rng = np.random.Generator
Change = Callable[[Recording], Recording]


@dataclass(frozen=True)
class Piece:
    """A section of a clip."""

    clip: Path
    first: int
    count: int

    @property
    def name(self) -> str:
        """Return the name for the table."""
        return f"{self.clip.name} {self.first}-{self.first + self.count - 1}"


def main() -> None:
    """Run the seeds, and print a row for each case and a count of the words."""
    options = _options()
    options.out.mkdir(parents=True, exist_ok=True)
    clips = [path for path in options.clips if path.is_dir()]
    counts: Counter[str] = Counter()
    for seed in range(*options.seeds):
        cases = list(_cases(seed, clips))
        with ThreadPoolExecutor(options.jobs) as pool:
            outcomes = list(pool.map(lambda case: run_case(case, options), cases))
        bases = {outcome.name.endswith("rgb"): outcome for outcome in outcomes[:2]}
        for outcome in outcomes:
            word = judge(outcome, excused(bases["rgb" in outcome.name.split("+")]))
            counts[word] += outcome not in outcomes[:2]
            print(row(outcome, word), flush=True)
    print(", ".join(f"{counts[word]} {word}" for word in ORDER if counts[word]))


def _cases(seed: int, clips: list[Path]) -> Iterator[Case]:
    """Yield the undisturbed section with and without depth, and six degraded ones."""
    rng = np.random.default_rng(seed)
    clip = clips[seed % len(clips)]
    count, length = int(rng.integers(40, 91)), len(vg.read(clip))
    piece = Piece(clip, int(rng.integers(0, max(length - count, 1))), min(count, length))
    yield _case(seed, piece, {"base": lambda recording: recording})
    yield _case(seed, piece, {"base": lambda recording: recording, "rgb": partial(without_depth, rng=rng)})
    for _ in range(6):
        names = rng.choice(sorted(DRAWN), size=int(rng.integers(2, 4)), replace=False)
        changes = {}
        for name in sorted(names, key=list(DRAWN).index):
            words, change = DRAWN[name](rng)
            changes[f"{name}{words}"] = change
        if rng.random() < 0.4:
            changes = {name: change for name, change in changes.items() if not name.startswith("depth")}
            changes["rgb"] = partial(without_depth, rng=rng)
        yield _case(seed, piece, changes)


def _case(seed: int, piece: Piece, changes: dict[str, Change]) -> Case:
    def make(work: Path) -> tuple[Path, Path]:
        recording = _read(piece)
        for change in changes.values():
            recording = change(recording)
        folder, truth = work / "frames", work / "truth.txt"
        write(recording, folder, truth)
        if not recording.camera.known:
            (folder / "calibration.txt").unlink()
        return folder, truth

    return Case(f"{seed} {piece.name}", "+".join(changes), make)


def _read(piece: Piece) -> Recording:
    clip = vg.read(piece.clip)
    truth = clip.ground_truth()
    if truth is None:
        raise SystemExit(f"`clips` must have a ground truth, got {piece.clip}")
    frames = list(clip.frames(piece.first, piece.first + piece.count))
    times = np.array([frame.timestamp for frame in frames])
    seen = truth.select((truth.timestamps > times[0] - 1.0) & (truth.timestamps < times[-1] + 1.0))
    return Recording([replace(frame, index=number) for number, frame in enumerate(frames)], clip.camera, seen)


# ------------------------------------------------------------------------------------------------- what is drawn
Drawn = tuple[str, Change]
Image = np.ndarray


def _on_images(words: str, change: Callable[[Image, int], Image]) -> Drawn:
    whole = lambda image, number: np.clip(change(image, number), 0, 255).astype(np.uint8)
    return words, lambda recording: with_images(recording, whole)


def _on_depths(words: str, change: Callable[[Image, int], Image]) -> Drawn:
    return words, lambda recording: with_depths(recording, change)


def _on_camera(words: str, change: Callable[[tuple[float, ...]], tuple[float, ...]]) -> Drawn:
    def of(recording: Recording) -> Recording:
        fx, fy, cx, cy = change(recording.camera.intrinsics)
        return replace(recording, camera=replace(recording.camera, intrinsics=(fx, fy, cx, cy)))

    return words, of


def jpeg(rng: Rng) -> Drawn:
    """Compress again."""
    quality = int(rng.integers(8, 96))
    return _on_images(f"{quality}", lambda image, number: compressed(image, quality))


def gamma(rng: Rng) -> Drawn:
    """Apply another tone curve."""
    power = float(rng.uniform(0.4, 2.5))
    return _on_images(f"{power:.1f}", lambda image, number: 255 * (image / 255.0) ** power)


def exposure(rng: Rng) -> Drawn:
    """Change the brightness periodically, within 10 to 40 frames."""
    share, period = float(rng.uniform(0.2, 0.6)), float(rng.uniform(10, 40))
    swing = lambda number: 1 + share * np.sin(2 * np.pi * number / period)
    return _on_images(f"{share:.1f},{period:.0f}", lambda image, number: image * swing(number))


def flicker(rng: Rng) -> Drawn:
    """Add bands of light that move through the image, as under LED lamps."""
    share, period, speed = float(rng.uniform(0.1, 0.4)), float(rng.uniform(60, 400)), float(rng.uniform(10, 90))
    banded = partial(in_bands_of_light, share=share, period=period, speed=speed)
    return _on_images(f"{share:.1f},{period:.0f},{speed:.0f}", banded)


def vignette(rng: Rng) -> Drawn:
    """Darken the corners."""
    share = float(rng.uniform(0.3, 0.8))

    def change(image: Image, number: int) -> Image:
        height, width = image.shape[:2]
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        return image * (1 - share * (x**2 + y**2) / 2)[..., None]

    return _on_images(f"{share:.1f}", change)


def noise(rng: Rng) -> Drawn:
    """Add the noise of a sensor in little light."""
    sigma, seed = float(rng.uniform(4, 25)), int(rng.integers(1 << 30))
    fresh = lambda image, number: np.random.default_rng([seed, number]).normal(0, sigma, image.shape)
    return _on_images(f"{sigma:.0f}", lambda image, number: image + fresh(image, number))


def blur(rng: Rng) -> Drawn:
    """Blur some sequences of images along the rows."""
    size, period, burst = int(rng.integers(7, 32)), int(rng.integers(8, 30)), int(rng.integers(2, 7))
    kernel = np.full((1, size), 1.0 / size)
    smeared = lambda image, number: cv2.filter2D(image, -1, kernel) if number % period < burst else image
    return _on_images(f"{size},{period},{burst}", smeared)


def defocus(rng: Rng) -> Drawn:
    """Defocus all images."""
    sigma = float(rng.uniform(0.8, 3.0))
    return _on_images(f"{sigma:.1f}", lambda image, number: cv2.GaussianBlur(image, (0, 0), sigma))


def cast(rng: Rng) -> Drawn:
    """Add a colour cast that drifts, as of a white balance."""
    gains = rng.uniform(0.7, 1.3, (2, 3))
    share = lambda number: min(number / 40.0, 1.0)
    between = lambda number: gains[0] * (1 - share(number)) + gains[1] * share(number)
    return _on_images("", lambda image, number: image * between(number))


def contrast(rng: Rng) -> Drawn:
    """Reduce the contrast."""
    share = float(rng.uniform(0.08, 0.5))
    return _on_images(f"{share:.2f}", lambda image, number: 128 + (image - 128.0) * share)


def logo(rng: Rng) -> Drawn:
    """Put a mark in a corner."""
    left, top = bool(rng.integers(2)), bool(rng.integers(2))

    def change(image: Image, number: int) -> Image:
        height, width = image.shape[:2]
        corner = (round((0.03 if left else 0.7) * width), round((0.1 if top else 0.95) * height))
        painted = np.ascontiguousarray(image)
        cv2.putText(painted, "NEWS 24", corner, cv2.FONT_HERSHEY_DUPLEX, width / 500, (255, 255, 255), 2)
        return painted

    return _on_images("", change)


def blink(rng: Rng) -> Drawn:
    """Make single images black or white."""
    period, level = int(rng.integers(7, 20)), int(rng.choice([0, 255]))
    gone = lambda image, number: np.full_like(image, level) if number % period == period - 1 else image
    return _on_images(f"{period},{level}", gone)


def drop(rng: Rng) -> Drawn:
    """Leave out some frames."""
    share, seed = float(rng.uniform(0.1, 0.5)), int(rng.integers(1 << 30))

    def change(recording: Recording) -> Recording:
        keep = np.random.default_rng(seed).random(len(recording.frames)) >= share
        return replace(recording, frames=_numbered([f for f, k in zip(recording.frames, keep, strict=True) if k]))

    return f"{share:.1f}", change


def backwards(rng: Rng) -> Drawn:
    """Reverse the order of the frames."""

    def change(recording: Recording) -> Recording:
        end = recording.frames[-1].timestamp + recording.frames[0].timestamp
        frames = [replace(frame, timestamp=end - frame.timestamp) for frame in recording.frames[::-1]]
        truth = Trajectory(end - recording.truth.timestamps[::-1], recording.truth.poses[::-1])
        return replace(recording, frames=_numbered(frames), truth=truth)

    return "", change


def repeats(rng: Rng) -> Drawn:
    """Repeat every n-th frame, as a conversion of the frame rate does."""
    period = int(rng.integers(2, 7))

    def change(recording: Recording) -> Recording:
        frames = list(recording.frames)
        for number in range(period, len(frames), period):
            frames[number] = replace(frames[number - 1], timestamp=frames[number].timestamp)
        times = np.array([frame.timestamp for frame in frames])
        shown = np.arange(len(frames))
        shown[period::period] -= 1
        of_time = np.array([frame.timestamp for frame in recording.frames])[shown]
        nearest = np.abs(recording.truth.timestamps[None] - of_time[:, None]).argmin(1)
        return replace(recording, frames=_numbered(frames), truth=Trajectory(times, recording.truth.poses[nearest]))

    return f"{period}", change


def resize(rng: Rng) -> Drawn:
    """Resize, with the camera changed to match; some presets of video sites scale width and height differently."""
    across = float(rng.uniform(0.25, 1.3))
    up = across if rng.random() < 0.6 else across * float(rng.uniform(0.75, 1.3))

    def change(recording: Recording) -> Recording:
        camera = recording.camera
        camera = camera.resized(round(across * camera.width), round(up * camera.height))
        size = camera.width, camera.height
        seen = with_images(recording, lambda image, number: cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        far = with_depths(seen, lambda depth, number: cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST))
        return replace(far, camera=camera)

    return f"{across:.2f},{up:.2f}", change


def depth_noise(rng: Rng) -> Drawn:
    """Add noise that grows with the square of depth."""
    sigma, seed = float(rng.uniform(0.005, 0.03)), int(rng.integers(1 << 30))
    fresh = lambda depth, number: np.random.default_rng([seed, number]).normal(0, 1, depth.shape) * sigma * depth**2
    return _on_depths(f"{sigma:.3f}", lambda depth, number: np.maximum(depth + fresh(depth, number), 0.01))


def depth_far(rng: Rng) -> Drawn:
    """Remove depth beyond the sensor's range."""
    reach = float(rng.uniform(1.5, 4.0))
    return _on_depths(f"{reach:.1f}", lambda depth, number: np.where(depth < reach, depth, np.nan))


def depth_near(rng: Rng) -> Drawn:
    """Remove depth below the sensor's range."""
    least = float(rng.uniform(0.5, 2.0))
    return _on_depths(f"{least:.1f}", lambda depth, number: np.where(depth > least, depth, np.nan))


def depth_scale(rng: Rng) -> Drawn:
    """Scale the depth, as a slightly wrong unit does."""
    factor = float(rng.uniform(0.97, 1.03))
    return _on_depths(f"{factor:.3f}", lambda depth, number: depth * factor)


def depth_smooth(rng: Rng) -> Drawn:
    """Smooth depth over edges, as a phone does."""
    size = int(rng.integers(5, 25))

    def change(depth: Image, number: int) -> Image:
        known = np.isfinite(depth).astype(np.float32)
        sums = cv2.blur(np.where(known > 0, depth, 0).astype(np.float32), (size, size))
        return np.where(known > 0, sums / np.maximum(cv2.blur(known, (size, size)), 1e-6), np.nan)

    return _on_depths(f"{size}", change)


def depth_aside(rng: Rng) -> Drawn:
    """Shift depth against the images, as a wrong registration does."""
    pixels = int(rng.integers(1, 7))
    return _on_depths(f"{pixels}", lambda depth, number: np.roll(depth, pixels, 1))


def depth_seldom(rng: Rng) -> Drawn:
    """Keep the depth of every second to fifth image only."""
    period = int(rng.integers(2, 6))
    empty = lambda depth, number: depth if number % period == 0 else np.full_like(depth, np.nan)
    return _on_depths(f"{period}", empty)


def focal(rng: Rng) -> Drawn:
    """Give a slightly wrong focal length."""
    factor = float(rng.uniform(0.92, 1.08))
    return _on_camera(f"{factor:.2f}", lambda inner: (inner[0] * factor, inner[1] * factor, *inner[2:]))


def uncalibrated(rng: Rng) -> Drawn:
    """Leave out the calibration."""
    return "", lambda recording: replace(recording, camera=replace(recording.camera, known=False))


def _numbered(frames: list[Frame]) -> list[Frame]:
    return [replace(frame, index=number) for number, frame in enumerate(frames)]


DRAWN: dict[str, Callable[[Rng], Drawn]] = {
    change.__name__: change
    for change in (
        *(drop, backwards, repeats, resize, uncalibrated, focal),
        *(depth_noise, depth_far, depth_near, depth_scale, depth_smooth, depth_aside, depth_seldom),
        *(defocus, blur, gamma, exposure, flicker, vignette, cast, contrast, noise, logo, blink, jpeg),
    )
}
"""Changes, in the order in which they are applied."""


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="+")
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 4), metavar=("FIRST", "END"))
    add_run_options(parser, out="runs/random", timeout=400.0, dense="none")
    return parser.parse_args()


if __name__ == "__main__":
    main()
