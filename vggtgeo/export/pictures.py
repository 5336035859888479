"""The pictures of a run, for the formats that want them."""

from __future__ import annotations

from pathlib import Path

from vggtgeo.datasets.image_checks import image_header
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.results.scene import MASK, Scene


def picture_mask(scene: Scene, source: Path) -> bytes | None:
    """The PNG of the pixels that come from the images, white; None where all do. InputError for one of another size."""
    file = source / MASK
    if not file.is_file():
        return None
    content = file.read_bytes()
    _check(content, file, scene, source)
    return content


def copy_pictures(scene: Scene, source: Path, target: Path) -> None:
    """`images/` of the run in `source`, below `target`; InputError for one that is missing, or of another size."""
    (target / "images").mkdir(parents=True, exist_ok=True)
    for view in range(len(scene.frames)):
        file = source / "images" / scene.image_name(view)
        if not file.is_file():
            raise InputError(f"`{file}` is not there; run again, with `-o {source}`")
        content = file.read_bytes()
        _check(content, file, scene, source)
        with atomic_open(target / "images" / file.name, "wb") as handle:
            handle.write(content)


def _check(content: bytes, file: Path, scene: Scene, source: Path) -> None:
    try:
        header = image_header(content, file)
    except InputError as error:
        raise InputError(f"{error}; run again, with `-o {source}`") from None
    if (header.width, header.height) != scene.size:
        raise InputError(
            f"`{file}` is {header.width} x {header.height} pixels; it must be {scene.size[0]} x {scene.size[1]}: run "
            f"again, with `-o {source}`"
        )
