"""`CITATION.cff` is a citation file of version 1.2.0, and says what the package says of itself."""

import re
import tomllib
from typing import Any

import pytest
import yaml
from conftest import ROOT


@pytest.fixture(scope="module")
def citation() -> dict[str, Any]:
    return yaml.safe_load((ROOT / "CITATION.cff").read_text())


def test_it_agrees_with_the_package(citation: dict[str, Any]) -> None:
    """Version, licence, keywords and the paper's DOI are those of the package. Oracle: pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (paper,) = citation["references"]
    assert citation["version"] == project["version"]
    assert citation["license"] == project["license"]
    assert citation["keywords"] == project["keywords"]
    assert project["urls"]["Paper"] == f"https://doi.org/{paper['doi']}"


def test_the_readme_cites_the_same_paper(citation: dict[str, Any]) -> None:
    """The README points to the file, and names the paper as the file does. Oracle: the file."""
    readme = (ROOT / "README.md").read_text()
    (paper,) = citation["references"]
    assert "](CITATION.cff)" in readme
    where = rf"{paper['year']}, {paper['volume']}\({paper['issue']}\), {paper['start']}"
    assert re.search(where, readme)
