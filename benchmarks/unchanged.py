"""Check that a change of the code keeps all results: compare runs, solves and files with those from before the change.

    .venv/bin/python benchmarks/unchanged.py --keep runs/before.npz    # before the change
    .venv/bin/python benchmarks/unchanged.py runs/before.npz           # after it: exit code 1 where anything differs

Runs the first `--frames` frames of the four clips of `../shared/data`, with and without depth (skipped where they are
absent), two rendered rooms, a run that stops and resumes, an export to COLMAP's files, and one window: its solution,
gradient, covariances and marginalisation. Each number must be the same within `--tolerance` (relative to the largest of
its array), on the machine that kept them; another machine rounds differently.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import vggtgeo as vg
from vggtgeo.datasets import without_depth
from vggtgeo.export import export
from vggtgeo.slam.state import Slam

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
CLIPS = ("corridor-office", "building-walk", "icl-office", "redkitchen")
SCENES = ("room", "office")

Numbers = dict[str, np.ndarray]


def main() -> None:
    """Compute all results, then keep or compare them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kept", nargs="?", type=Path, help="numbers from before the change")
    parser.add_argument("--keep", type=Path, help="write the numbers here")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--only", default="", help="only parts whose names contain this")
    parser.add_argument("--tolerance", type=float, default=1e-9)
    options = parser.parse_args()
    if (options.kept is None) == (options.keep is None):
        parser.error("give either the file to compare with or `--keep FILE`")
    jax.config.update("jax_enable_x64", True)
    chosen = [(name, part) for name, part in _parts(options.frames) if options.only in name]
    before = {} if options.kept is None else dict(np.load(options.kept))
    computed: Numbers = {}
    different = 0
    for name, part in chosen:
        now = {f"{name}/{key}": np.asarray(value) for key, value in part().items()}
        computed |= now
        if options.kept is not None:
            expected = {key: value for key, value in before.items() if key.startswith(f"{name}/")}
            lines = list(_differences(expected, now, options.tolerance))
            different += len(lines)
            print(f"{name}: {'unchanged' if not lines else ''}", *lines, sep="\n  ", flush=True)
        else:
            print(f"{name}: {len(now)} arrays", flush=True)
    if options.keep is not None:
        options.keep.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(options.keep, **computed)
    raise SystemExit(1 if different else 0)


def _parts(frames: int) -> Iterator[tuple[str, Callable[[], Numbers]]]:
    for clip in CLIPS:
        if (DATA / clip).is_dir():
            yield f"{clip}, depth", lambda clip=clip: _run(vg.open_sequence(DATA / clip), frames)
            yield f"{clip}, images", lambda clip=clip: _run(without_depth(vg.open_sequence(DATA / clip)), frames)
    for scene in SCENES:
        yield f"{scene}, simulated", lambda scene=scene: _run(vg.simulate(scene, 40, size=(320, 240)), frames)
    yield "resume", _resumed
    yield "export", _exported
    yield "window", _window


def _run(sequence: vg.datasets.Sequence, frames: int) -> Numbers:
    result = vg.reconstruct(sequence, options=vg.RunOptions(end=frames, dense="none"))
    return {
        "frames": result.trajectory.timestamps,
        "poses": result.trajectory.poses,
        "keyframes": result.keyframes.timestamps,
        "points": result.cloud.points,
        "intrinsics": np.array(result.intrinsics),
    }


def _resumed() -> Numbers:
    sequence = vg.simulate("room", 24, size=(160, 120))
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "kept.npz"
        with contextlib.suppress(_Stop):
            vg.reconstruct(
                sequence,
                callbacks=[_StopAt(12)],
                options=vg.RunOptions(dense="none", checkpoints=vg.settings.Checkpoints(kept, every=0)),
            )
        whole = vg.reconstruct(
            sequence, options=vg.RunOptions(dense="none", checkpoints=vg.settings.Checkpoints(kept, resume=True))
        )
    return {"poses": whole.trajectory.poses, "points": whole.cloud.points}


class _Stop(Exception):
    """Stop a run in the middle."""


@dataclass
class _StopAt(vg.Callback):
    frame: int

    def on_frame(self, slam: Slam, frame: vg.data.Frame) -> None:
        if frame.index == self.frame:
            raise _Stop


def _exported() -> Numbers:
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        vg.reconstruct(vg.simulate("room", 12, size=(160, 120)), options=vg.RunOptions(dense="none")).save(run)
        export(run, "colmap", Path(folder) / "colmap")
        files = sorted((Path(folder) / "colmap").rglob("*.bin"))
        return {file.name: np.frombuffer(file.read_bytes(), np.uint8) for file in files}


def _window() -> Numbers:
    window = vg.simulate_window()
    seen = window.observations
    problem, initial, _ = vg.pack(
        seen,
        window.start,
        vg.cameras.Intrinsics(window.intrinsics, fixed=True),
        seen.depth_mean,
        terms=[vg.empty_prior(4)],
    )

    def error(weight: jax.Array) -> jax.Array:
        state = vg.solve(problem.with_term(problem.terms["points"].reweighted(weight)), initial).state
        return jnp.sum((state.poses.inverse().translation() - window.centres) ** 2)

    solution = jax.jit(vg.solve)(problem, initial)
    known = vg.covariances(problem, solution.state)
    prior = vg.marginalise(problem, solution.state, 0)
    return {
        "poses": solution.state.poses.wxyz_xyz,
        "inverse depths": solution.state.inverse_depth,
        "energy": solution.energy,
        "gradient": jax.jit(jax.grad(error))(problem.terms["points"].weight),
        "covariances": known.poses,
        "prior": prior.root.T @ prior.root,
    }


def _differences(before: Numbers, now: Numbers, tolerance: float) -> Iterator[str]:
    """Return a line for each array that is missing, new, of another shape, or different."""
    for key in sorted(before.keys() | now.keys()):
        if key not in before or key not in now:
            yield f"{key}: only {'before' if key in before else 'now'}"
            continue
        old, new = before[key], now[key]
        if old.shape != new.shape:
            yield f"{key}: shape {old.shape} before, {new.shape} now"
        elif not np.array_equal(old, new, equal_nan=True):
            worst = np.nanmax(np.abs(np.asarray(new, np.float64) - old)) / max(np.nanmax(np.abs(old)), 1e-300)
            if not worst <= tolerance:
                yield f"{key}: {worst:.1e} of its largest number"


if __name__ == "__main__":
    main()
