"""`--settings FILE.toml`: what it accepts and refuses, who wins, and that what a run writes gives the run again."""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.testing import CliRunner

from vggtgeo.cli.main import make_app
from vggtgeo.cli.options import JsonOption
from vggtgeo.cli.settings_file import SettingsOption
from vggtgeo.results.files import write_settings

DEFAULTS = {"path": "clip", "count": 3, "scale": None, "rgb-only": False, "lines": True, "mode": "fast", "json": False}


def seen_by_the_command(*arguments: str) -> dict[str, Any]:
    """The effective settings of a small command with one parameter of each kind, called with `arguments`."""
    found: dict[str, Any] = {}

    def command(
        path: Annotated[Path, typer.Argument()],
        settings: SettingsOption = None,
        count: int = 3,
        scale: Annotated[float | None, typer.Option()] = None,
        rgb_only: Annotated[bool, typer.Option("--rgb-only/--no-rgb-only")] = False,
        lines: Annotated[bool, typer.Option("--lines/--no-lines")] = True,
        mode: Annotated[Literal["fast", "slow"], typer.Option("-m", "--mode")] = "fast",
        as_json: JsonOption = False,
    ) -> None:
        assert settings is not None
        found.update(settings.values())

    app = typer.Typer(add_completion=False)
    app.command()(command)
    result = CliRunner().invoke(app, list(arguments))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return found


def file_with(folder: Path, text: str) -> str:
    (folder / "s.toml").write_text(text)
    return str(folder / "s.toml")


def test_a_file_says_what_flags_say(tmp_path: Path) -> None:
    # Proves that a file equals the flags. Oracle: the same command called with flags.
    text = 'path = "clip"\ncount = 7\nscale = 2\nrgb-only = true\nmode = "slow"\njson = true\n'
    flags = ("--count", "7", "--scale", "2", "--rgb-only", "--no-lines", "--mode", "slow", "--json")
    by_flags = seen_by_the_command("clip", *flags)
    for negation in ("lines = false\n", "no-lines = true\n"):
        assert seen_by_the_command("--settings", file_with(tmp_path, text + negation)) == by_flags
    expected = {"path": "clip", "count": 7, "scale": 2.0, "rgb-only": True, "lines": False, "mode": "slow"}
    assert by_flags == {**expected, "json": True}
    path = file_with(tmp_path, "")
    Path(path).write_text(f"{text}lines = false\n", encoding="utf-16", newline="\r\n")  # as PowerShell has it
    assert seen_by_the_command("--settings", path) == by_flags


def test_a_flag_wins_over_the_file(tmp_path: Path) -> None:
    # Proves the order flag, file, default, wherever the flag stands, and that each switch of a file can be turned over
    # by a flag, either way. Oracle: the defaults.
    path = file_with(tmp_path, 'count = 7\nmode = "slow"\n')
    expected = {**DEFAULTS, "count": 9, "mode": "slow"}
    assert seen_by_the_command("clip", "--settings", path, "--count", "9") == expected
    assert seen_by_the_command("--count", "9", "clip", "--settings", path) == expected
    path = file_with(tmp_path, "rgb-only = true\nlines = false\njson = true\n")
    assert seen_by_the_command("clip", "--settings", path, "--no-rgb-only", "--lines", "--no-json") == DEFAULTS
    path = file_with(tmp_path, "no-lines = true\n")
    assert seen_by_the_command("clip", "--lines", "--settings", path) == DEFAULTS


def test_every_switch_has_its_opposite() -> None:
    # Proves that no command has a switch that cannot be taken back. Oracle: the parameters of the command itself.
    for name, command in typer.main.get_command(make_app()).commands.items():
        for each in getattr(command, "commands", {name: command}).values():
            switches = [p for p in each.params if getattr(p, "is_flag", False) and p.name != "help"]
            assert [p.name for p in switches if not p.secondary_opts] == [], name


def test_what_is_written_gives_the_same_again(tmp_path: Path) -> None:
    # Proves the round trip, and that what is not set is left out.
    settings = {**DEFAULTS, "count": 5}
    write_settings(tmp_path / "out.toml", settings)
    assert seen_by_the_command("--settings", str(tmp_path / "out.toml")) == settings
    assert "scale" not in tomllib.loads((tmp_path / "out.toml").read_text())
