"""What a program or a call of the library sets for its process, and takes back."""

from __future__ import annotations

import os
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache
from reported import raises
from threadpoolctl import threadpool_info, threadpool_limits

from vggtgeo.compilation import process_settings
from vggtgeo.compilation.jax_environment import jax_environment
from vggtgeo.compilation.process_settings import ENABLED, FOLDER, SHORTEST, program_settings


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The user's cache folder, empty, of a process in which nobody has told JAX of any."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = {name: getattr(jax.config, name) for name in (FOLDER, SHORTEST)}
    jax.config.update(FOLDER, None)
    jax.config.update(SHORTEST, 7.0)
    compilation_cache.reset_cache()
    yield tmp_path / "vggtgeo" / "jax"
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def compiled(factor: float) -> None:
    jax.jit(lambda x: factor * x)(jnp.ones(3)).block_until_ready()


def kept(folder: Path) -> int:
    """Programs in the folder."""
    return sum(path.name.endswith("-cache") for path in folder.iterdir())


def test_code_is_kept_inside_and_nothing_of_others(folder: Path) -> None:
    """Oracle: the files in the folder, before and after a program of another time, and JAX's own settings."""
    compiled(1.5)  # JAX has decided that there is no folder, as in a notebook that has computed before
    with program_settings():
        compiled(2.5)
        inside = kept(folder)
    assert inside > 0
    compiled(3.5)
    assert kept(folder) == inside
    assert (getattr(jax.config, FOLDER), getattr(jax.config, SHORTEST)) == (None, 7.0)


def test_what_the_user_has_set_for_jax_stays(folder: Path, tmp_path: Path) -> None:
    """A folder of the user's own is used, and with the cache switched off there is none."""
    own = tmp_path / "own"
    jax.config.update(FOLDER, str(own))
    with program_settings():
        assert (getattr(jax.config, FOLDER), getattr(jax.config, SHORTEST)) == (str(own), 7.0)
    jax.config.update(FOLDER, None)
    jax.config.update(ENABLED, False)
    try:
        with program_settings():
            assert getattr(jax.config, FOLDER) is None
    finally:
        jax.config.update(ENABLED, True)
    assert not any(folder.iterdir())


def blas_threads() -> set[int]:
    return {int(pool["num_threads"]) for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.mark.parametrize(("own", "expected"), [(None, {1}), ("2", {2})])
def test_matrix_products_take_one_thread(
    folder: Path, monkeypatch: pytest.MonkeyPatch, own: str | None, expected: set[int]
) -> None:
    """Unless the user's environment says otherwise; afterwards they take as many as before. Oracle: threadpoolctl."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if own is not None:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", own)
    with threadpool_limits(2, "blas"):
        with program_settings():
            assert blas_threads() == expected
        assert blas_threads() == {2}


def test_a_process_that_was_forked_from_one_that_computed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that a run in such a process is an error with what to do, where it waited for ever for threads that a fork
    # leaves behind. Oracle: a set that holds the number of another process, as a forked one finds it.
    monkeypatch.setattr(process_settings, "_processes", {os.getpid() + 1})
    with raises("forked", "spawn"), program_settings():
        pass
    monkeypatch.setattr(process_settings, "_processes", set())
    for _ in range(2):
        with program_settings():
            pass


@pytest.mark.parametrize(
    ("version", "is_set"), [("0.8.0", True), ("0.10.2", True), ("0.11.0", False), ("1.0.0", False)]
)
def test_the_flag_is_set_for_versions_that_know_it(monkeypatch: pytest.MonkeyPatch, version: str, is_set: bool) -> None:
    """Later versions of jaxlib end a process that sets the flag; oracle: the first version without it, 0.11."""
    monkeypatch.setattr(metadata, "version", lambda name: version)
    assert ("XLA_FLAGS" in jax_environment()) == is_set
