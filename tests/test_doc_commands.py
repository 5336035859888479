"""Every command that a document states can still be called: its options, suites and settings are there."""

import argparse
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest
import typer
from conftest import ROOT

from vggtgeo.benchmark.suite import load_suite, restrict, shipped
from vggtgeo.cli.main import make_app

PAGES = sorted({ROOT / "README.md", *(ROOT / "docs").rglob("*.md")})
OURS = re.compile(r"(?:\S+/)?(?:vggtgeo (?!as )(?=[a-z])|python (?:benchmarks|docs)/)")
UNFINISHED = re.compile(r"\.\.\.|[\[\]|]|--\S+,|FILE\.toml|GROUP\.FIELD")
"""In prose: `vggtgeo run ...`, optional parts, a list of options, a word in the place of a file or a setting."""
NAMED = ("MissingParameter", "Exit")
"""What the parser raises where prose names a command with one of its options and without its arguments, or `--help`."""


def _commands(page: Path) -> Iterator[list[str]]:
    """The words of each command of ours, of shell blocks and of `code`."""
    text = page.read_text(encoding="utf-8")
    blocks = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL))
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    lines = blocks.replace("\\\n", " ").splitlines()
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose)]
    for line in lines + spans:
        found = OURS.search(line)
        if found and not UNFINISHED.search(line):
            words = shlex.split(line[found.start() :], comments=True)
            if len(words) > 2:  # else it is a name: of a script, which has its commands at its head, or of a command
                yield words


COMMANDS = sorted({(page.name, *words) for page in PAGES for words in _commands(page)})


class _Parsed(Exception):
    pass


def _parse(command: Any, name: str, words: list[str]) -> None:
    with command.make_context(name, list(words)) as context:
        if hasattr(command, "resolve_command"):
            rest = [*context._protected_args, *context.args]
            name, inner, rest = command.resolve_command(context, rest)
            _parse(inner, name, rest)
        elif name == "bench" and context.params["suite"] in shipped():
            given = (context.params[key] for key in ("sequences", "settings"))
            chosen = [None if one is None else tuple(one.split(",")) for one in given]
            restrict(load_suite(Path(context.params["suite"])), *chosen, None, None, None)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: " ".join(words)[:80])
def test_a_command_of_a_document_parses(command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    # Proves that no document states an option, a suite, a setting or a script that is gone. Oracle: the parsers.
    _, *words = command
    if not words[0].endswith("python"):
        try:
            _parse(typer.main.get_command(make_app()), "vggtgeo", words[1:])
        except Exception as error:
            if type(error).__name__ not in NAMED:
                raise
        return
    _, program, *words = words
    parse_args = argparse.ArgumentParser.parse_args

    def parse_only(self: argparse.ArgumentParser, *given: Any) -> NoReturn:
        parse_args(self, *given)
        raise _Parsed

    script = ROOT / program
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    monkeypatch.setattr(sys, "argv", [str(script), *words])
    monkeypatch.syspath_prepend(str(script.parent))
    with pytest.raises(_Parsed):
        runpy.run_path(str(script), run_name="__main__")
