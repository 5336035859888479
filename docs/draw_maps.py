"""Draw `maps.webp`: the maps of two runs of one recording, with measured depth and of pictures alone, side by side.

vggtgeo run ../shared/data/redkitchen --end 60 -o runs/kitchen-depth
vggtgeo run ../shared/data/redkitchen --end 60 -o runs/kitchen-pictures --rgb-only
python docs/draw_maps.py runs/kitchen-depth runs/kitchen-pictures

Both maps are seen from one place behind the camera in the middle of the path; the second is brought to the first one's
place and unit by the paths (Sim(3)).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

import vggtgeo as vg
from vggtgeo.figures.map_view import BACKGROUND, walk_in

WIDTH, BAR = 560, 26
INK = (31, 41, 51)


def page(pictures: list[np.ndarray], words: list[str]) -> Image.Image:
    """Pictures of one size side by side, a line below each."""
    height, width, _ = pictures[0].shape
    whole = Image.new("RGB", (len(pictures) * (width + 6) - 6, height + BAR), BACKGROUND)
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 14)
    for number, (picture, line) in enumerate(zip(pictures, words, strict=True)):
        whole.paste(Image.fromarray(picture), (number * (width + 6), 0))
        ImageDraw.Draw(whole).text((number * (width + 6) + 8, height + 4), line, INK, font)
    return whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("measured", type=Path, help="folder of the run with depth")
    parser.add_argument("pictures", type=Path, help="folder of the run without")
    parser.add_argument("--quality", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("maps.webp"))
    given = parser.parse_args()
    measured, alone = vg.Result.load(given.measured), vg.Result.load(given.pictures)
    error = vg.evaluate(alone.trajectory, measured.trajectory).sim3
    placed = replace(alone.cloud, points=error.alignment.points(alone.cloud.points))
    views = [walk_in(cloud, measured.trajectory, WIDTH) for cloud in (measured.cloud, placed)]
    rows = np.flatnonzero(np.any([(view != BACKGROUND).any((1, 2)) for view in views], axis=0))
    views = [view[rows[0] : rows[-1] + 1] for view in views]
    words = [
        f"RGB-D: {len(measured.cloud):,} points",
        f"pictures alone: {len(placed):,} points, paths {100 * error.statistics.rmse:.1f} cm apart",
    ]
    page(views, words).save(given.out, quality=given.quality, method=6)
    print(f"{given.out}: {given.out.stat().st_size / 1e3:.0f} kB; {'; '.join(words)}")


if __name__ == "__main__":
    main()
