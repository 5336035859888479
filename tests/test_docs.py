"""The documents agree with the repository."""

import re
import runpy
from pathlib import Path

import pytest
from conftest import ROOT

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_named_files_exist(page: Path) -> None:
    # Proves that no document points to a file that is gone. Oracle: the files.
    text = page.read_text()
    links = {page.parent / link for link in re.findall(r"\]\(([^):#]+)\)", text)}
    named = {ROOT / name for name in re.findall(r"`((?:vggtgeo|solvers|models|docs|tests)/[\w./]*)`", text)}
    assert {path for path in links | named if not path.exists()} == set()


def test_make_targets_in_the_documents_exist() -> None:
    # Proves that each `make target` in a document can be called. Oracle: the Makefile.
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    called = {
        name for page in PAGES for name in re.findall(r"^(?:\| )?`?make ([a-z-]+)", page.read_text(), re.MULTILINE)
    }
    assert called
    assert called <= targets


def test_the_committed_picture_is_the_drawn_one() -> None:
    # Proves that the picture was redrawn after its script changed. Oracle: the script.
    draw = runpy.run_path(str(ROOT / "docs" / "draw_architecture.py"))["draw"]
    assert (ROOT / "docs" / "architecture.svg").read_text() == draw()
