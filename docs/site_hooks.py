"""What MkDocs does beside its own for the site (`make docs`).

- README.md, CONTRIBUTING.md and others at the root become pages, with their links changed to fit.
- A line of a page ``Code: [`FILE`](../FILE), `NAME` `` becomes the source of NAME as it stands in FILE, a line
  ``Table: [`FILE`](../FILE)`` the entries of a TOML file.
- MathJax comes from the package `sphinx-mathjax-offline`, and only pages with mathematics load it.
"""

from __future__ import annotations

import ast
import re
import textwrap
import tomllib
from importlib import metadata
from pathlib import Path
from posixpath import relpath
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changes.md",
    "CONTRIBUTING.md": "contributing.md",
    "LICENSE": "licence.md",
    "SECURITY.md": "security.md",
}
"""Files of the root that are pages, and their names on the site."""
CODE = re.compile(r"^Code: \[`(?P<file>[\w./]+)`\]\((?:\.\./)+(?P=file)\), `(?P<name>[\w.]+)`$", re.MULTILINE)
TABLE = re.compile(r"^Table: \[`(?P<file>[\w./]+\.toml)`\]\((?:\.\./)+(?P=file)\)$", re.MULTILINE)
LONGEST = 30
"""Lines of code that are shown open; more are folded."""
MATHJAX = "mathjax/tex-svg.js"
SETTINGS = """<script>window.MathJax = {tex: {inlineMath: [["\\\\(", "\\\\)"]], displayMath: [["\\\\[", "\\\\]"]]},
options: {ignoreHtmlClass: ".*", processHtmlClass: "arithmatex", enableMenu: false}};</script>"""
_LINK = re.compile(r"(?P<image>!?)\[(?P<label>(?:[^\[\]]|\[[^\]]*\])*)\]\((?P<target>[^):#\s]+)(?P<anchor>#[^)]*)?\)")


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages of the root, and MathJax."""
    from mkdocs.structure.files import File

    for name, page in PAGES.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        if name == "LICENSE":
            text = f"# Licence\n\n```text\n{text}```\n"
        files.append(File.generated(config, page, content=_with_links(text, ROOT, page)))
    files.append(File.generated(config, "CITATION.cff", abs_src_path=str(ROOT / "CITATION.cff")))
    files.append(File.generated(config, MATHJAX, abs_src_path=str(_mathjax())))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Quotes code, and changes links that leave the site."""
    source = page.file.src_uri
    markdown = CODE.sub(lambda found: _quoted(found["file"], found["name"]), markdown)
    markdown = TABLE.sub(lambda found: _table(found["file"]), markdown)
    return markdown if source in PAGES.values() else _with_links(markdown, (ROOT / "docs" / source).parent, source)


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Loads MathJax where there is mathematics."""
    if 'class="arithmatex"' not in html:
        return html
    where = relpath(MATHJAX, Path(page.file.src_uri).parent.as_posix())
    return f'{html}\n{SETTINGS}\n<script src="{where}" async></script>'


def source_of(file: str, name: str) -> str:
    """The lines of a function, method or class, by its dotted name, as they stand in the file."""
    text = (ROOT / file).read_text(encoding="utf-8")
    node: Any = ast.parse(text)
    for part in name.split("."):
        named = (child for child in ast.iter_child_nodes(node) if getattr(child, "name", None) == part)
        node = next(named, None)
        if node is None:
            raise ValueError(f"`{file}` has no `{name}`")
    first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
    return textwrap.dedent("\n".join(text.splitlines()[first - 1 : node.end_lineno]))


def _table(file: str) -> str:
    entries = tomllib.loads((ROOT / file).read_text(encoding="utf-8"))["entry"]
    columns = ("kind", "size", "licence", "layout", "note")
    rows = [
        f"[{entry['name']}]({entry['url']}) | " + " | ".join(entry[column] for column in columns) for entry in entries
    ]
    head = " | ".join(("name", *columns))
    return "\n".join(f"| {row} |" for row in (head, "|".join("---" for _ in range(6)), *rows)).replace(
        "| ---|", "|---|"
    )


def _quoted(file: str, name: str) -> str:
    code = source_of(file, name)
    block = f'```python title="{file}: {name}"\n{code}\n```'
    lines = code.count("\n") + 1
    if lines <= LONGEST:
        return block
    return f'??? example "{file}: {name}, {lines} lines"\n\n' + textwrap.indent(block, "    ")


def _with_links(text: str, folder: Path, page: str) -> str:
    """Links to files of the repository as links of the site; those to files that the site has not, as plain text."""

    def changed(found: re.Match[str]) -> str:
        target = (folder / found["target"]).resolve()
        if not target.is_relative_to(ROOT) or not target.exists():
            return found[0]  # MkDocs says what is wrong with it
        name = target.relative_to(ROOT).as_posix()
        if name in PAGES or name == "CITATION.cff":
            new = PAGES.get(name, name)
        elif name.startswith("docs/") and not name.endswith((".py", ".json")):
            new = name.removeprefix("docs/")
        else:
            return found["label"]
        where = relpath(new, Path(page).parent.as_posix())
        return f"{found['image']}[{found['label']}]({where}{found['anchor'] or ''})"

    return _LINK.sub(changed, text)


def _mathjax() -> Path:
    for file in metadata.files("sphinx-mathjax-offline") or ():
        if file.as_posix().endswith("static/mathjax/tex-svg.js"):
            return Path(str(file.locate()))
    raise FileNotFoundError("`sphinx-mathjax-offline` has no `tex-svg.js`; `pip install -e '.[docs]'` installs it")
