"""Count lines, numbers and functions of the source, and its comments.

    .venv/bin/python benchmarks/code_size.py [--numbers]

Source are `vggtgeo`, `solvers` and `models`. Numbers are those of `vggtgeo/slam` without its verdict, named and inline,
in computations: not indices, widths of formats, and small or round ones (`COMMON`). `--numbers` lists them.
"""

from __future__ import annotations

import argparse
import ast
import statistics
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COMMON = {-1, 0, 0.5, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 16, 60, 100, 180, 255, 1000, 1e-3}
MAX_PARAMETERS, MAX_LINES = 7, 70


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--numbers", action="store_true", help="list the numbers of `vggtgeo/slam`")
    options = parser.parse_args()
    files = [path for name in ("vggtgeo", "solvers", "models") for path in sorted((ROOT / name).rglob("*.py"))]
    lines = sum(map(_lines, files))
    functions = [node for path in files for node in ast.walk(_tree(path)) if isinstance(node, ast.FunctionDef)]
    sizes = [(node.end_lineno or 0) - node.lineno + 1 for node in functions]
    comments = sum(token.type == tokenize.COMMENT for path in files for token in _tokens(path))
    numbers = [found for path in files if _of_slam(path) for found in _numbers(path)]
    print(f"source: {lines} lines in {len(files)} files, tests: {sum(map(_lines, (ROOT / 'tests').rglob('*.py')))}")
    print(f"comments: {100 * comments / lines:.1f} % of the lines")
    long, wide = sum(size > MAX_LINES for size in sizes), sum(_parameters(node) > MAX_PARAMETERS for node in functions)
    print(f"functions: median {statistics.median(sizes):g} lines; {long} longer than {MAX_LINES} lines")
    print(f"functions with more than {MAX_PARAMETERS} parameters: {wide}")
    print(f"numbers in `vggtgeo/slam`: {len(numbers)}")
    if options.numbers:
        print("\n".join(numbers))


def _lines(path: Path) -> int:
    return len(path.read_text().splitlines())


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def _tokens(path: Path) -> Iterator[tokenize.TokenInfo]:
    with path.open("rb") as file:
        yield from tokenize.tokenize(file.readline)


def _parameters(node: ast.FunctionDef) -> int:
    """Return the number of parameters, `self` and `cls` excluded."""
    names = [each.arg for each in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def _of_slam(path: Path) -> bool:
    return path.is_relative_to(ROOT / "vggtgeo" / "slam") and "verdict" not in path.parts


def _numbers(path: Path) -> list[str]:
    """Return the numbers of a file as `path:line: number`."""
    tree = _tree(path)
    aside = [node.slice for node in ast.walk(tree) if isinstance(node, ast.Subscript)]
    aside += [n.format_spec for n in ast.walk(tree) if isinstance(n, ast.FormattedValue) and n.format_spec]
    left_out = {id(inner) for node in aside for inner in ast.walk(node)}
    return [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.value}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and type(node.value) in (int, float)
        if id(node) not in left_out and node.value not in COMMON
    ]


if __name__ == "__main__":
    main()
