"""The pipeline's settings: checked by group when they are made, and within reach of files and flags."""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jaxtyping
import pytest
import tomli_w
import typer
from reported import pattern, raises
from typer.testing import CliRunner

import vggtgeo as vg
from vggtgeo.cli.main import make_app
from vggtgeo.cli.settings_file import pipeline_settings
from vggtgeo.slam.settings.table import GROUPS, changed, names, parsed, tables_of, updated

WRONG = {
    "keyframes.min_inliers": (0, 2.5, True, "many"),
    "keyframes.keyframe_distance": (0.0, -1.0, float("nan"), float("inf"), "far"),
    "keyframes.keyframe_angle": (0.0, 4.0),
    "keyframes.localise_only": (1,),
    "line.use_lines": (1, "yes"),
    "line.line_weight": (-0.1,),
    "line.manhattan": (0,),
    "depth_terms.depth_weight": (-2.0,),
    "depth_terms.depth_trust": ("omega", 1),
    "depth_terms.surface_points": (-1.0,),
    "weights.confidence": ("on", 1.0),
    "camera.max_pixels": (-1, 1.5),
    "camera.static_overlay": (1,),
    "camera.refine_intrinsics": ("sometimes", True),
    "window.size": (2, 10.0),
    "window.point_slots": (0,),
    "window.line_slots": (0,),
    "window.kernel": (2.0, "cauchy 0", "cauchy 1 2 3", "welsch", ""),
    "refinement.global_adjustment": ("no",),
    "refinement.rolling_shutter": ("yes",),
}
OTHER = {bool: lambda value: not value, int: lambda value: 2 * value + 2, float: lambda value: 0.5 * value}
WORDS = {
    "depth_terms.depth_trust": "saliency",
    "weights.confidence": "paper",
    "window.kernel": "huber 1.25",
    "camera.refine_intrinsics": "never",
}


def _other(name: str) -> Any:
    """A value that is possible and is not the default."""
    group, field = name.split(".")
    default = tables_of(vg.SlamSettings())[group][field]
    return WORDS[name] if name in WORDS else OTHER[type(default)](default)


@pytest.fixture(autouse=True)
def as_a_user() -> Iterator[None]:
    """Without the tests' own checks of types, which would refuse a wrong value before the settings see it."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def test_every_setting_is_tested() -> None:
    """The table above has a line for each setting; oracle: the declaration."""
    assert set(WRONG) == set(names())


@pytest.mark.parametrize("name", names())
def test_a_wrong_value_is_refused_with_its_name(name: str) -> None:
    """The error names group and field, what was found, and what it must be."""
    group, field = name.split(".")
    for value in WRONG[name]:
        with pytest.raises(vg.InputError) as raised:
            updated(vg.SlamSettings(), {group: {field: value}})
        assert re.fullmatch(f"`{name}` must be .*, got {re.escape(repr(value))}", str(raised.value))


@pytest.mark.parametrize("group", GROUPS)
def test_a_group_in_its_place(group: str) -> None:
    """A group is named as its attribute is, and nothing else takes its place; oracle: the declaration."""
    assert getattr(vg.SlamSettings(), group).group == group
    with raises(group, 8):
        vg.SlamSettings(**{group: 8})


@pytest.mark.parametrize("name", names())
def test_a_file_and_a_flag_reach_every_setting(name: str) -> None:
    """What TOML and `--set` say arrives, and comes out as it went in; oracle: the value itself."""
    group, field = name.split(".")
    value = _other(name)
    table = tomllib.loads(tomli_w.dumps({group: {field: value}}))
    text = value if isinstance(value, str) else json.dumps(value)
    for tables in (table, parsed(f"{name}={text}"), parsed(f" {name} = {text} ")):
        settings = updated(vg.SlamSettings(), tables)
        assert changed(settings) == {group: {field: value}}
        assert changed(updated(vg.SlamSettings(), changed(settings))) == changed(settings)


def test_no_group_has_the_name_of_a_flag() -> None:
    """A table of a settings file and a flag can stand side by side; oracle: the parameters of the commands."""
    commands = typer.main.get_command(make_app()).commands
    for name in ("run", "demo"):
        flags = {option.lstrip("-") for p in commands[name].params for option in (*p.opts, *p.secondary_opts)}
        assert flags & set(GROUPS) == set()


@pytest.mark.parametrize(
    ("assignment", "named"),
    [
        ("tracking.min_inliers=20", ("tracking.min_inliers", "keyframes.min_inliers")),
        ("min_inliers=20", ("min_inliers", "keyframes.min_inliers")),
        ("window.window=4", ("window.window", "window.size")),
        ("window.size", ("window.size", "group.field=value")),
        ("window.size=four", ("window.size", "'four'")),
        ("window.kernel=tukey 3", ("window.kernel", "tukey 3")),
    ],
)
def test_a_wrong_assignment_ends_the_program_before_it_runs(
    tmp_path: Path, assignment: str, named: tuple[str, ...]
) -> None:
    """`--set` with what is not possible is an error that names it, and exit code 2, and no folder is made."""
    out = tmp_path / "out"
    done = CliRunner().invoke(make_app(), ["demo", "--frames", "3", "-o", str(out), "--quiet", "--set", assignment])
    assert done.exit_code == 2
    assert re.search(pattern(*named), done.stderr)
    assert not out.exists()


@pytest.mark.parametrize(
    ("table", "given", "assignments", "expected"),
    [
        ({}, False, (), False),  # a switch of the file or by default
        ({"line": {"use_lines": True}}, False, (), True),  # a table says more than a switch of the same file
        ({"line": {"use_lines": True}}, True, (), False),  # a switch that is given wins over the file
        ({"line": {"use_lines": True}}, True, ("line.use_lines=true",), True),  # `--set` wins over all
        ({}, False, ("line.use_lines=false", "line.use_lines=true"), True),  # the last wins
    ],
)
def test_who_wins(table: dict, given: bool, assignments: tuple[str, ...], expected: bool) -> None:
    """The order: switch of a file, table of a file, switch of the command line, `--set`."""
    in_use = SimpleNamespace(tables=table, on_command_line=lambda name: given)
    settings = pipeline_settings(in_use, assignments, {"lines": {"line": {"use_lines": False}}})
    assert settings == dataclasses.replace(
        vg.SlamSettings(), window=settings.window, line=vg.settings.LineSettings(use_lines=expected)
    )
