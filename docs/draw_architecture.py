"""Draw `architecture.svg`: what each part does, the way of a frame through them, and who imports whom.

Run `python docs/draw_architecture.py` after a change; the picture is committed.
"""

from dataclasses import dataclass
from html import escape
from pathlib import Path

WIDTH, HEIGHT = 1000, 566
INK, SOFT, LINE = "#1f2933", "#52606d", "#66788a"
FONT = "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', Arial, sans-serif"


@dataclass(frozen=True)
class Room:
    """The colours of one of the three import packages."""

    fill: str
    edge: str


PIPELINE, ROLES, SOLVER = Room("#eef4fb", "#4a7fb5"), Room("#eef8f0", "#4f9a63"), Room("#fdf4e7", "#c98a2e")


def text(x: float, y: float, words: str, size: int = 12, colour: str = SOFT, weight: int = 400) -> str:
    """Words centred at x."""
    style = f'font-size="{size}" font-weight="{weight}" fill="{colour}" text-anchor="middle"'
    return f'<text x="{x:g}" y="{y:g}" {style}>{escape(words)}</text>'


def note(x: float, y: float, words: str) -> str:
    """Words that start at x."""
    return f'<text x="{x:g}" y="{y:g}" font-size="12" fill="{SOFT}">{escape(words)}</text>'


def frame(room: Room, x: float, y: float, width: float, height: float, inner: bool = True) -> str:
    fill, radius = ("#fff", 7) if inner else (room.fill, 12)
    size = f'x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="{radius}"'
    return f'<rect {size} fill="{fill}" stroke="{room.edge}"/>'


def area(room: Room, x: float, y: float, width: float, height: float, name: str, role: str) -> str:
    """A package: its name and what it is for."""
    title = f'<tspan font-size="16" font-weight="700" fill="{room.edge}">{name}</tspan>'
    words = f'<text x="{x + 16}" y="{y + 27}" font-size="12" fill="{SOFT}">{title}<tspan dx="10">{role}</tspan></text>'
    return frame(room, x, y, width, height, inner=False) + words


def box(room: Room, x: float, y: float, width: float, title: str, *lines: str) -> str:
    """A part: its name, and one or two lines about it."""
    rows = [text(x + width / 2, y + 41 + 16 * row, line) for row, line in enumerate(lines)]
    heading = text(x + width / 2, y + 22, title, 13, INK, 600)
    return "".join([frame(room, x, y, width, 34 + 16 * len(lines)), heading, *rows])


def arrow(path: str, imports: bool = False) -> str:
    style = ' stroke-dasharray="5 4"' if imports else ""
    return f'<path d="{path}" fill="none" stroke="{LINE}" stroke-width="1.6"{style} marker-end="url(#head)"/>'


def pipeline() -> list[str]:
    width, gap, upper, lower, middle = 164, 27, 64, 194, 83
    column = [36 + (width + gap) * k for k in range(5)]
    window = column[3]
    down = f"M{window + 40} {upper + 66} C{window + 40} {upper + 108} {column[2] + 82} {upper + 86}"
    up = f"M{column[4] + 82} {lower} C{column[4] + 82} {upper + 86} {window + 124} {upper + 108}"
    return [
        area(PIPELINE, 20, 20, 960, 260, "vggtgeo", "geometry, the problem, the pipeline, data, evaluation"),
        box(
            PIPELINE, column[0], upper, width, "datasets, simulation", "7-Scenes, TUM, images,", "video, rendered rooms"
        ),
        box(PIPELINE, column[1], upper, width, "track", "a pose for every frame", "from matched points"),
        box(PIPELINE, column[2], upper, width, "keyframe?", "0.15 m, 5 degrees, or", "fewer than 50 inliers"),
        box(PIPELINE, column[3], upper, width, "window", "10 keyframes, edges of", "matched points, lines"),
        box(PIPELINE, column[4], upper, width, "outputs", "trajectory, map,", "dense depth, summary"),
        *(arrow(f"M{x + width} {upper + 33} h{gap - 1}") for x in column[:4]),
        box(PIPELINE, column[0], lower, width, "cli", "demo, run, solve,", "evaluate, simulate"),
        box(PIPELINE, column[1], lower, width, "evaluation", "ATE, RPE, depth,", "point clouds"),
        box(PIPELINE, column[2], lower, width, "problem", "padded arrays; residuals", "of one observation"),
        box(PIPELINE, column[3], lower, width, "solve", "bundle adjustment,", "differentiable"),
        box(PIPELINE, column[4], lower, width, "marginalise", "what leaves becomes", "a square-root prior"),
        *(arrow(f"M{x + width} {lower + 33} h{gap - 1}") for x in column[2:4]),
        arrow(f"{down} {column[2] + 82} {lower - 1}"),
        arrow(f"{up} {window + 124} {upper + 67}"),
        text(window + middle, lower - 23, "one immutable state,"),
        text(window + middle, lower - 8, "folded over the frames"),
    ]


def roles() -> list[str]:
    names = ("initial geometry", "point matches", "line segments", "metric depth", "dense confidence")
    x, top, step, width = 36, 338, 107, 99
    boxes = [
        frame(ROLES, x + step * k, top + 44, width, 50)
        + text(x + step * k + width / 2, top + 65, name.split()[0], 13, INK, 600)
        + text(x + step * k + width / 2, top + 82, name.split()[1], 13, INK, 600)
        for k, name in enumerate(names)
    ]
    return [
        area(ROLES, 20, top, 559, 158, "vggtgeo.models", "five perception roles: numpy in, numpy out"),
        *boxes,
        text(299.5, top + 120, "each a protocol, with classical and simulated implementations"),
        text(299.5, top + 141, "numpy, scipy, OpenCV, ONNX Runtime", 12, ROLES.edge, 600),
    ]


def solver() -> list[str]:
    top = 338
    return [
        area(SOLVER, 599, top, 381, 158, "vggtgeo.solvers", "knows nothing of cameras"),
        box(SOLVER, 615, top + 44, 184, "Levenberg-Marquardt", "robust kernels"),
        box(SOLVER, 811, top + 44, 153, "arrow system", "Schur complement"),
        text(789.5, top + 120, "structured nonlinear least squares"),
        text(789.5, top + 141, "JAX, Equinox, Lineax, Optimistix", 12, SOLVER.edge, 600),
    ]


def draw() -> str:
    """The whole picture."""
    head = f'<path d="M0 0 L8 4 L0 8 z" fill="{LINE}"/>'
    size = 'viewBox="0 0 8 8" refX="7" refY="4" markerWidth="6" markerHeight="6" orient="auto"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="{FONT}">',
        f'<defs><marker id="head" {size}>{head}</marker></defs>',
        f'<rect width="{WIDTH}" height="{HEIGHT}" rx="14" fill="#fff"/>',
        *pipeline(),
        *roles(),
        *solver(),
        arrow("M299 280 V337", imports=True),
        note(311, 313, "asks a role, gets typed arrays"),
        arrow("M691 280 V337", imports=True),
        note(703, 313, "energy, linearisation, retraction"),
        arrow("M36 531 h44"),
        note(90, 535, "the way of a frame"),
        arrow("M230 531 h44", imports=True),
        note(284, 535, "imports; the two lower packages import neither each other nor anything above them"),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("architecture.svg").write_text(draw(), encoding="utf-8")
