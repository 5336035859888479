"""Figures of the report: SVG with the colours of the page's style sheet, and images as data URIs."""

from __future__ import annotations

import base64
import io
import re
import zlib
from collections.abc import Sequence

import cv2
import matplotlib as mpl
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from vggtgeo.figures.plots import (
    BLUE,
    GREEN,
    GRID,
    INK,
    ORANGE,
    RULE,
    NotebookFigure,
    line_colour,
    style,
)
from vggtgeo.slam.callback import WindowRecord

COLOURS = {
    BLUE: "var(--blue)",
    ORANGE: "var(--orange)",
    GREEN: "var(--green)",
    INK: "var(--ink)",
    RULE: "var(--rule)",
    GRID: "var(--grid)",
}
"""Colours of the figures, and the variables of the style sheet that replace them."""
_LABELS = {
    "points": "points",
    "lines": "lines",
    "depth": "measured depth",
    "relative_poses": "motion between keyframes",
    "baselines": "distance between keyframes",
    "rotations": "rotation between keyframes",
    "surfaces": "alignment of depth images",
}
"""Names of terms in the report; terms of users keep their own."""
_UNITS = {"px": "pixels", "sigma": "standard deviations"}
_WIDTH = 4.6
"""Inches: legible without scaling on a desktop and on a phone."""


def residuals_svg(records: Sequence[WindowRecord]) -> str:
    """Return the RMS residuals of all terms over time, one panel per unit."""
    figure = NotebookFigure(figsize=(_WIDTH, 3.4), layout="constrained")
    units = {name: unit for record in records for name, unit in record.units.items()}
    kinds = list(dict.fromkeys(units.values())) or ["px"]
    rows = dict(zip(kinds, figure.subplots(len(kinds), 1, sharex=True, squeeze=False)[:, 0], strict=True))
    time = np.array([record.timestamp for record in records]) - records[0].timestamp
    for number, (name, unit) in enumerate(units.items()):
        values = np.array([record.rms.get(name, np.nan) for record in records])
        rows[unit].plot(
            time, values, color=line_colour(number), lw=1.4, marker=".", ms=3, label=_LABELS.get(name, name)
        )
    for unit, axes in rows.items():
        axes.set_ylabel(_UNITS.get(unit, unit))
        axes.set_ylim(bottom=0)
        style(axes)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=9, labelcolor=INK, ncols=2)
    rows[kinds[-1]].set_xlabel("time [s]")
    return svg(figure)


def jpeg(image: UInt8[np.ndarray, "h w 3"], width: int, quality: int) -> bytes:
    """Return an RGB image as a JPEG, at most `width` pixels wide."""
    scale = min(1.0, width / image.shape[1])
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def picture(image: UInt8[np.ndarray, "h w 3"], width: int) -> str:
    """Return an RGB image as the data URI of a JPEG, at most `width` pixels wide."""
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg(image, width, 82)).decode()}"


def depth_colours(depth: Float[np.ndarray, "h w"], low: float, high: float) -> UInt8[np.ndarray, "h w 3"]:
    """Colour depth from `low` (bright) to `high` (dark) metres; unknown depth is grey."""
    share = np.clip((high - np.nan_to_num(depth, nan=high)) / max(high - low, 1e-6), 0.0, 1.0)
    image = shades(share)
    image[~np.isfinite(depth)] = 128
    return image


def shades(share: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Colour numbers from 0 (dark) to 1 (bright)."""
    return np.asarray(255 * mpl.colormaps["viridis"](share)[..., :3], np.uint8)


def svg(figure: Figure) -> str:
    """Return the `<svg>` element: transparent, with text elements and the page's colours; deterministic."""
    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "vggtgeo"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font: \1px inherit; font-size: \1px; font-family: inherit", text)
    for colour, variable in COLOURS.items():
        text = text.replace(colour, variable)
    return _unique_ids(text)


def _unique_ids(svg: str) -> str:
    """Prefix the identifiers, so that two figures in one page do not share any."""
    prefix = f"f{zlib.crc32(svg.encode())}-"
    svg = re.sub(r'\bid="', f'id="{prefix}', svg)
    return re.sub(r'(url\(#|href="#)', rf"\1{prefix}", svg)
