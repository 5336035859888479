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


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES)
def test_the_blocks_of_a_page_run_in_order(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pasted one after the other into an empty folder's session, no block raises. Oracle: Python, and their asserts."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / page).read_text()
    session: dict[str, Any] = {"__name__": "__main__"}
    assert BLOCK.search(text)
    for found in BLOCK.finditer(text):
        line = text.count("\n", 0, found.start(1))
        exec(compile("\n" * line + found[1], page, "exec"), session)
