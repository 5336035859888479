"""The pictures of a run, for the formats that want them."""

from __future__ import annotations

from pathlib import Path

from vggtgeo.datasets.image_defects import declared_size, defect
from vggtgeo.io.errors import InputError
from vggtgeo.io.files import atomic_open
from vggtgeo.results.scene import MASK, Scene


def picture_mask(scene: Scene, source: Path) -> bytes | None:
    """The PNG of the pixels that come from the images, white; None where all do. InputError for one of another size."""
    file = source / MASK
    if not file.is_file():
        return None
    content = file.read_bytes()
    if declared_size(content) != scene.size:
        raise InputError(f"`{file}` is no picture of {scene.size[0]} x {scene.size[1]} pixels; run again")
    return content


def copy_pictures(scene: Scene, source: Path, target: Path) -> None:
    """`images/` of the run in `source`, below `target`; InputError for one that is missing, or of another size."""
    (target / "images").mkdir(parents=True, exist_ok=True)
    for view in range(len(scene.frames)):
        file = source / "images" / scene.image_name(view)
        if not file.is_file():
            raise InputError(f"`{file}` is not there; run again, with `-o {source}`")
        content = file.read_bytes()
        width, height = declared_size(content)
        if content and (wrong := defect(content)):
            raise InputError(f"`{file}` {wrong}; run again, with `-o {source}`")
        if (width, height) != scene.size:
            raise InputError(
                f"`{file}` is no picture of {scene.size[0]} x {scene.size[1]} pixels (found {width} x {height}); run "
                f"again, with `-o {source}`"
            )
        with atomic_open(target / "images" / file.name, "wb") as handle:
            handle.write(content)
