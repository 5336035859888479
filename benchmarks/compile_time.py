"""Measure how long the README's window and a chain of five windows take to compile, in processor seconds.

    .venv/bin/python benchmarks/compile_time.py [--cache FOLDER]

Of the window, the value, the gradient by the matches' weights, and the Hessian product are compiled. The chain is the
gradient of the last pose by the first window's weights, through five windows that are solved, marginalised and slid in
a `scan`. Each runs in a separate process. Without `--cache` everything is compiled; with it a second call shows what a
cache saves. Processor seconds count all threads: on two idle cores the wall time is about two thirds of them.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

import vggtgeo as vg

KEYFRAMES, WINDOWS = 4, 5
NAMES = ("value", "gradient", "Hessian product", "gradient of five windows")
HEADER = "| of | trace and lower, s | compile, s | lines of StableHLO |\n|---|---|---|---|"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cache", help="folder of JAX's compilation cache")
    parser.add_argument("--one", choices=NAMES, help="measure only this, in this process")
    options = parser.parse_args()
    if options.one:
        print(measured(options.one, options.cache))
        return
    print(HEADER)
    for name in NAMES:
        command = [sys.executable, __file__, "--one", name, *(["--cache", options.cache] if options.cache else [])]
        print(subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip(), flush=True)


def measured(name: str, cache: str | None) -> str:
    """Return a row of the table."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", cache is not None)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    function, weight = _chain() if name == NAMES[-1] else _window(name)
    begun = time.process_time()
    lowered = jax.jit(function).lower(weight)
    traced = time.process_time()
    lowered.compile()
    compiled = time.process_time()
    lines = len(lowered.as_text().splitlines())
    return f"| {name} | {traced - begun:.1f} | {compiled - traced:.1f} | {lines} |"


def _window(name: str) -> tuple[Callable[[jax.Array], jax.Array], jax.Array]:
    """Return a function of the matches' weights of the README's window, and the weights."""
    window = vg.simulate_window()
    seen = window.observations
    problem, initial, _ = vg.pack(
        seen, window.start, vg.cameras.Intrinsics(window.intrinsics, fixed=True), seen.depth_mean
    )

    def loss(weight: jax.Array) -> jax.Array:
        state = vg.solve(problem.with_term(problem.terms["points"].reweighted(weight)), initial).state
        return jnp.sum((state.poses.inverse().translation() - window.centres) ** 2)

    gradient = jax.grad(loss)
    functions = {
        "value": loss,
        "gradient": gradient,
        "Hessian product": lambda weight: jax.jvp(gradient, (weight,), (jnp.ones_like(weight),))[1],
    }
    return functions[name], problem.terms["points"].weight


def _chain() -> tuple[Callable[[jax.Array], jax.Array], jax.Array]:
    """Return the gradient through windows as large as the README's, where the oldest keyframe is marginalised after
    each.
    """
    long = vg.simulate_window(KEYFRAMES + WINDOWS - 1)
    parts, camera = [], vg.cameras.Intrinsics(long.intrinsics, fixed=True)
    for first in range(WINDOWS):
        inside = range(first, first + KEYFRAMES)
        seen = long.observations.within(inside)
        parts.append((seen, long.start[list(inside)], camera, seen.depth_mean))
    windows = vg.batches.pack_batch(parts, terms=[vg.empty_prior(KEYFRAMES)])[:2]
    first, start = jax.tree.map(lambda leaf: leaf[0], windows)
    # The last window is slid into the first one again, so that the body is compiled once; its result is not used.
    following = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, 0), windows)

    def loss(weight: jax.Array) -> jax.Array:
        def step(window: tuple[vg.Problem, vg.State], coming: tuple[vg.Problem, vg.State]):
            state = vg.solve(*window).state
            return vg.slide(window[0], state, *coming), state.poses.inverse().translation()[-1]

        reweighted = first.with_term(first.terms["points"].reweighted(weight))
        newest = jax.lax.scan(step, (reweighted, start), following)[1]
        return jnp.sum((newest[-1] - long.centres[-1]) ** 2)

    return jax.grad(loss), first.terms["points"].weight


if __name__ == "__main__":
    main()
