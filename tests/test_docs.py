"""The documents agree with the repository."""

import ast
import re
import runpy
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import ROOT
from public_names import PUBLIC

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


@pytest.fixture(scope="module")
def hooks() -> dict[str, Any]:
    """What the site does beside MkDocs."""
    return runpy.run_path(str(ROOT / "docs" / "site_hooks.py"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_named_files_exist(page: Path) -> None:
    # Proves that no document points to a file that is gone. Oracle: the files.
    text = page.read_text()
    links = {page.parent / link for link in re.findall(r"\]\(([^):#\s]+)(?:#[^)]*)?\)", text)}
    named = {ROOT / name for name in re.findall(r"`((?:vggtgeo|solvers|models|docs|tests)/[\w./]*)`", text)}
    assert {path for path in links | named if not path.exists()} == set()


def _words(text: str) -> int:
    """Words and numbers; the lines of a table are none."""
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def _sentences(text: str) -> list[int]:
    """Words of each sentence, without code blocks, equations, tables, headings, pictures. Code in it is one word."""
    text = re.sub(r"^ *```.*?^ *```$|\$\$.*?\$\$|<!--.*?-->", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^ *(:::|!\[|#|\||Code: |---).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"`[^`]*`|\$[^$]*\$", "x", text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    parts = re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )|(?<=[.!?:;])[\s)]", text)
    return [length for length in map(_words, parts) if length]


def test_all_pages_together_can_be_read() -> None:
    # Proves the bound of CONTRIBUTING.md on all pages. Oracle: their words, code included.
    words = {page.name: _words(page.read_text()) for page in (ROOT / "docs").rglob("*.md")}
    assert sum(words.values()) <= 20_000, words


def test_the_first_page_and_the_changes_are_short() -> None:
    # Proves at most 600 words of prose in README.md, and 60 lines in CHANGELOG.md. Oracle: the files.
    readme, changes = ((ROOT / name).read_text() for name in ("README.md", "CHANGELOG.md"))
    assert sum(_sentences(readme)) <= 600, sum(_sentences(readme))
    assert len(changes.splitlines()) <= 60


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_sentences_of_a_page_are_short(page: Path) -> None:
    # Proves that sentences have 25 words at most on average. Oracle: the page.
    lengths = _sentences(page.read_text())
    assert not lengths or sum(lengths) / len(lengths) <= 25, sum(lengths) / len(lengths)


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
    assert (ROOT / "docs" / "concepts" / "architecture.svg").read_text() == draw()


def test_the_site_has_every_page_once(hooks: dict[str, Any]) -> None:
    # Proves that no page is left out of the site's menu, or is there twice. Oracle: the files.
    def pages(entry: Any) -> list[str]:
        if isinstance(entry, str):
            return [entry]
        return [page for part in (entry.values() if isinstance(entry, dict) else entry) for page in pages(part)]

    listed = pages(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    there = [page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted([*there, *hooks["PAGES"].values()])


def test_code_beside_the_mathematics_exists(hooks: dict[str, Any]) -> None:
    # Proves that each function named beside an equation is there, and no such line is misspelt. Oracle: the sources.
    for page in PAGES:
        text = page.read_text()
        named = [hooks["source_of"](found["file"], found["name"]) for found in hooks["CODE"].finditer(text)]
        assert all("def " in code or "class " in code for code in named)
        assert len(named) == len(re.findall(r"^Code: ", text, re.MULTILINE)), page
    assert len(hooks["CODE"].findall((ROOT / "docs" / "concepts" / "mathematics.md").read_text())) > 30


def test_the_reference_has_every_public_name_once() -> None:
    # Proves that a new public name is in the reference. Oracle: the names themselves.
    text = "".join(page.read_text() for page in (ROOT / "docs" / "reference").glob("*.md"))
    listed = re.findall(r"^::: vggtgeo\.([\w.]+)$", text, re.MULTILINE)
    assert set(PUBLIC) <= set(listed)
    assert len(set(listed)) == len(listed)


def test_messages_of_the_troubleshooting_page_are_those_of_the_program() -> None:
    # Proves that whoever looks up a message finds it. Oracle: the texts in the sources; `...` stands for what varies.
    page = (ROOT / "docs" / "troubleshooting.md").read_text().splitlines()
    rows = [line.split(" | ")[0].removeprefix("| ") for line in page if re.match(r"\| (?!message|reason)", line)]
    texts = {
        text for folder in ("vggtgeo", "models") for file in (ROOT / folder).rglob("*.py") for text in _texts(file)
    }
    missing = [row for row in rows if not any(_holds(text, row) for text in texts)]
    assert len(rows) >= 25
    assert missing == []


def _texts(file: Path) -> list[str]:
    nodes = list(ast.walk(ast.parse(file.read_text())))
    plain = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    parts = [node.values for node in nodes if isinstance(node, ast.JoinedStr)]
    return plain + [
        "".join(str(getattr(part, "value", "")) if isinstance(part, ast.Constant) else "..." for part in one)
        for one in parts
    ]


def _holds(text: str, message: str) -> bool:
    for part in filter(None, map(str.strip, message.split("..."))):
        _, found, text = text.partition(part)
        if not found:
            return False
    return True


def test_checksums_of_the_weights_are_those_that_fetch_checks() -> None:
    # Proves that the page and the program speak of the same files. Oracle: the registry; the length of a SHA-256.
    from vggtgeo.models.onnx.registry import NETWORKS

    page = (ROOT / "docs" / "guides" / "networks.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("|") and "`model.onnx`" in line]
    published = [network.hub for network in NETWORKS.values() if network.hub]
    found = {re.findall(r"`([0-9a-f]{64})`", row)[0]: re.findall(r"\[([^\]]+)\]", row)[0] for row in rows}
    assert found == {hub.sha256: hub.repository for hub in published}
    for hub in published:
        assert hub.revision == "main" or any(hub.sha256 in row and hub.revision in row for row in rows)
    assert {len(digits) for digits in re.findall(r"`([0-9a-f]{30,})`", page)} <= {40, 64}
