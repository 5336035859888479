"""Templates and the style sheet of all pages."""

from importlib.resources import files

import jinja2


def template(package: str, name: str) -> jinja2.Template:
    """Load a page's template, a file of `package`, with autoescaping."""
    text = (files(package) / name).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(text)


def style() -> str:
    """Return the style sheet of all pages: light and dark mode, desktop and phone."""
    return (files("vggtgeo.report") / "style.css").read_text(encoding="utf-8")
