"""Examples of docstrings as code blocks on the site: `Example:` is followed by prompts, which are no text."""

from __future__ import annotations

import re
import textwrap
from typing import Any

import griffe

_EXAMPLE = re.compile(
    r"^(?P<indent> *)Example(?P<about>[^\n:]*:[^\n]*)\n(?P<code>(?:(?P=indent) +\S.*\n?|\n)+)", re.MULTILINE
)


class FencedExamples(griffe.Extension):
    """Puts the prompts of each example into a block of their own."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Changes the docstring before it is parsed."""
        if obj.docstring is not None:
            obj.docstring.value = _EXAMPLE.sub(_fenced, obj.docstring.value)


def _fenced(found: re.Match[str]) -> str:
    about = found["about"].strip().removeprefix(":").strip()
    code = textwrap.dedent(found["code"]).strip("\n")
    return f"**Example** {about}".rstrip() + f"\n\n```pycon\n{code}\n```\n"
