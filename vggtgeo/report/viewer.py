"""Load the templates of all pages, and make the 3D view as self-contained HTML.

The view consists of the scene, the JavaScript of K3D-jupyter, which draws with WebGL, and `viewer.js`, which connects
both. K3D-jupyter (MIT) is an optional package whose wheel contains the JavaScript. Without it there is no 3D view.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.metadata import distribution
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import jinja2

from vggtgeo.io.errors import InputError, install_hint
from vggtgeo.io.files import write_text
from vggtgeo.report.map_scene import MapScene

INSTALL = install_hint("viewer")
_HEIGHT = 640
"""Height of the view in a notebook, pixels."""


def template(package: str, name: str) -> jinja2.Template:
    """Load a page's template, a file of `package`, with autoescaping."""
    text = (files(package) / name).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(text)


def style() -> str:
    """Return the style sheet of all pages: light and dark mode, desktop and phone."""
    return (files("vggtgeo.report") / "style.css").read_text(encoding="utf-8")


def has_viewer() -> bool:
    """Return whether K3D-jupyter is installed."""
    return find_spec("k3d") is not None


def check_viewer() -> None:
    """Raise InputError if K3D-jupyter is not installed."""
    if not has_viewer():
        raise InputError(f"the 3D view needs the package `k3d`, which is missing; {INSTALL}")


def view_html(scene: MapScene) -> str:
    """Return the HTML elements of the view, for a page with the style of `style`; raise InputError without K3D."""
    check_viewer()
    library, licences = _library()
    return template("vggtgeo.report", "viewer.html.j2").render(
        header=scene.json,
        block=base64.b64encode(scene.block).decode(),
        library=library,
        licences=licences,
        script=(files("vggtgeo.report") / "viewer.js").read_text(encoding="utf-8"),
        scene=scene.header,
    )


@dataclass(frozen=True)
class MapView:
    """A 3D view of a map, displayed by a notebook and saved by `save`. html: the whole page."""

    html: str

    @classmethod
    def of(cls, scene: MapScene, title: str) -> MapView:
        """Return the page of a scene."""
        return cls(template("vggtgeo.report", "view.html.j2").render(style=style(), title=title, view=view_html(scene)))

    def save(self, path: str | Path) -> None:
        """Write the page, one file that works without a network, atomically."""
        write_text(Path(path), self.html)

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{escape(self.html)}" style="width:100%;height:{_HEIGHT}px;border:0"></iframe>'

    def __repr__(self) -> str:
        return f"MapView({len(self.html) / 1e6:.1f} MB)"


@cache
def _library() -> tuple[str, str]:
    """Return K3D's JavaScript, compressed, and the licences that must be distributed with it (three.js and others).

    `k3d` is only located, not imported, since an import takes a second.
    """
    spec = find_spec("k3d")
    assert spec is not None
    assert spec.submodule_search_locations
    folder = Path(spec.submodule_search_locations[0]) / "static"
    texts = [text.read_text() for text in distribution("k3d").files or () if text.name == "LICENSE.txt"]
    licences = "\n".join([*texts, (folder / "standalone.js.LICENSE.txt").read_text()])
    return base64.b64encode(zlib.compress((folder / "standalone.js").read_bytes(), 9)).decode(), licences
