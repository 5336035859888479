"""Measure what the README's window compiles: value, gradient and Hessian product, in processor seconds.

    .venv/bin/python benchmarks/compile_time.py [--cache FOLDER]

Each runs in a process of its own. Without `--cache` everything is compiled; with it a second call shows what a cache
saves. Processor seconds count all threads: on two idle cores the wall time is about two thirds of them.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

import jax
import jax.numpy as jnp

import vggtgeo as vg

HEADER = "| of | trace and lower, s | compile, s | lines of StableHLO |\n|---|---|---|---|"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cache", help="folder of JAX's compilation cache")
    parser.add_argument("--one", choices=("value", "gradient", "Hessian product"), help="this one, in this process")
    options = parser.parse_args()
    if options.one:
        print(measured(options.one, options.cache))
        return
    print(HEADER)
    for name in ("value", "gradient", "Hessian product"):
        command = [sys.executable, __file__, "--one", name, *(["--cache", options.cache] if options.cache else [])]
        print(subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip(), flush=True)


def measured(name: str, cache: str | None) -> str:
    """A row of the table."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", cache is not None)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    window = vg.simulate_window()
    seen = window.observations
    problem, initial, _ = vg.pack(seen, window.start, window.intrinsics, seen.depth_mean, fixed_intrinsics=True)

    def loss(weight: jax.Array) -> jax.Array:
        state = vg.solve(problem.with_term(problem.points.reweighted(weight)), initial).state
        return jnp.sum((state.poses.inverse().translation() - window.centres) ** 2)

    gradient = jax.grad(loss)
    functions = {
        "value": loss,
        "gradient": gradient,
        "Hessian product": lambda weight: jax.jvp(gradient, (weight,), (jnp.ones_like(weight),))[1],
    }
    begun = time.process_time()
    lowered = jax.jit(functions[name]).lower(problem.points.weight)
    traced = time.process_time()
    lowered.compile()
    compiled = time.process_time()
    lines = len(lowered.as_text().splitlines())
    return f"| {name} | {traced - begun:.1f} | {compiled - traced:.1f} | {lines} |"


if __name__ == "__main__":
    main()
