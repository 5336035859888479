"""The code blocks of the documents run as they stand."""

import re
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT

BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGES = [
    *("README.md", "docs/start/solve.md", "docs/start/gradients.md"),
    *("docs/guides/own-residuals.md", "docs/guides/extend.md"),
]

SLIDING = "vg.slide("
"""In a block whose gradient through several windows takes half of a page's time; test_sliding.py checks such a one."""


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES)
def test_the_blocks_of_a_page_run_in_order(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pasted one after the other into an empty folder's session, no block raises. Oracle: Python, and their asserts."""
    run(page, tmp_path, monkeypatch, without=SLIDING)


@pytest.mark.slow
def test_the_blocks_that_slide_run_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same of the only page with such a block, with it. Oracle: Python."""
    assert [page for page in PAGES if any(SLIDING in block for block in BLOCK.findall((ROOT / page).read_text()))] == [
        "docs/start/gradients.md"
    ]
    run("docs/start/gradients.md", tmp_path, monkeypatch)


def run(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, without: str | None = None) -> None:
    """The blocks of a page, but for those that hold a text."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / page).read_text()
    session: dict[str, Any] = {"__name__": "__main__"}
    assert BLOCK.search(text)
    for found in BLOCK.finditer(text):
        if without is not None and without in found[1]:
            continue
        line = text.count("\n", 0, found.start(1))
        exec(compile("\n" * line + found[1], page, "exec"), session)
