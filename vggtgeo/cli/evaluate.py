"""`vggtgeo evaluate`: errors of an estimated trajectory."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from vggtgeo.cli.options import EXIT_FAILED, JsonOption
from vggtgeo.io.errors import collected_warnings, one_line, warn

if TYPE_CHECKING:
    from collections.abc import Callable

    from vggtgeo.evaluation import TrajectoryReport

MAX_TIME_DIFFERENCE = 0.01
"""Seconds, as in `vggtgeo.evaluation.association`; repeated here so that `--help` need not import it."""


def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="EST", help="Trajectory (TUM, KITTI), or a run's folder.")],
    truth: Annotated[Path, typer.Argument(metavar="GT", help="Trajectory (TUM, KITTI, EuRoC), or a dataset folder.")],
    max_dt: Annotated[float, typer.Option(min=0, help="Maximum seconds between matched poses.")] = MAX_TIME_DIFFERENCE,
    delta: Annotated[float, typer.Option(min=0, help="Distance of the two poses of an RPE pair; see --unit.")] = 1.0,
    unit: Annotated[
        Literal["poses", "seconds", "metres"],
        typer.Option(help="Unit of --delta: poses, seconds, or metres of true path."),
    ] = "poses",
    all_pairs: Annotated[
        bool, typer.Option(help="Use all overlapping pairs for RPE, not only consecutive ones.")
    ] = False,
    vertical: Annotated[
        Literal["x", "y", "z"], typer.Option(help="Axis of GT that points up or down, for the yaw-only alignment.")
    ] = "z",
    time_offset: Annotated[float, typer.Option(help="Seconds to add to the times of GT, if its clock is late.")] = 0.0,
    estimate_offset: Annotated[
        bool, typer.Option(help="Also print the errors after removing the estimated offsets of clock and body.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Print ATE after SE(3) and Sim(3) alignment, and RPE, of EST against GT, and constant offsets between the two.

    Exit code 3: the errors are meaningless, since the two are of different sequences, or the estimate failed.
    """
    from vggtgeo.evaluation import comparability, estimate_offsets, evaluate_trajectory, shifted
    from vggtgeo.evaluation.alignment import AXES
    from vggtgeo.results.reading import load_estimate, load_scale, load_truth

    with collected_warnings() as warned:
        true, metres = load_truth(truth)
        found, scale = load_estimate(estimate, true), load_scale(estimate)
        if time_offset:
            true = shifted(found, true, time_offset)
        rules = max_dt, delta, all_pairs, unit, AXES[vertical]
        report = evaluate_trajectory(found, true, *rules)
        metric = metres is not False and scale is not None and scale.startswith("metric")
        verdict = comparability(found, true, max_dt, metric)
        offsets = estimate_offsets(found, true, max_dt)
        explained = [offsets.message] if offsets is not None and offsets.explains else []
        for text in (*verdict.reasons, *verdict.doubts, *explained):
            warn(text)
        corrected, final_verdict = None, verdict
        if estimate_offset and offsets is not None:
            true = offsets.removed(found, true)
            corrected = evaluate_trajectory(found, true, *rules)
            final_verdict = comparability(found, true, max_dt, metric)
    if as_json:
        known: dict[str, Any] = {"truth_in_metres": metres, **({} if scale is None else {"estimate_scale": scale})}
        known["offsets"] = None if offsets is None else offsets.to_dict()
        if corrected is not None:
            known["without_offsets"] = {**corrected.to_dict(), "comparable": not final_verdict.reasons}
        notices = {"warnings": [*report.warnings, *map(str, warned)], "comparable": not verdict.reasons}
        typer.echo(json.dumps({**report.to_dict(), **known, **notices}, indent=2))
    else:
        print_report(report, scale, metres)
        typer.echo(f"constant offsets: {'too few poses match to estimate them' if offsets is None else offsets}")
        if corrected is not None and offsets is not None:
            typer.echo(f"without {', '.join(offsets.significant) or 'offsets (none is significant)'}:")
            print_report(corrected, scale, metres)
    if final_verdict.reasons:
        typer.echo("NOT COMPARABLE: these errors are meaningless, see the warnings", err=True)
        raise typer.Exit(EXIT_FAILED)


def print_report(report: TrajectoryReport, scale: str | None = None, metres: bool | None = True) -> None:
    """Print a table of the errors.

    scale: of the estimate, as in its summary; for "free ..." only errors after Sim(3) alignment are printed. metres:
    whether the ground truth is in metres; if unknown (None), lengths are printed without a unit.
    """
    import numpy as np
    from rich.console import Console
    from rich.table import Column, Table

    from vggtgeo.evaluation import ErrorStatistics

    console = Console()
    console.print(
        f"{report.matched} poses matched, of {report.estimated} estimated and {report.true} true; "
        f"{100 * report.coverage:.0f} % of the ground truth's duration covered; scale of the Sim(3) alignment "
        f"{report.sim3.alignment.scale:.4f}; RPE over {report.relative.interval}",
        soft_wrap=True,
    )
    if scale is not None:
        console.print(f"scale of the estimate: {scale}", soft_wrap=True)
    if not metres:
        unit = "unknown" if metres is None else "not the metre"
        console.print(f"lengths are in the unit of GT, which is {unit}", soft_wrap=True)
    # In a narrow terminal wrap numbers instead of truncating them: 4.4413e-17 is not "4.44…".
    table = Table(*(Column(name, overflow="fold") for name in ("", "RMSE", "mean", "median", "max")))
    length: Callable[[float], str] = (lambda value: f"{100 * value:.3f} cm") if metres else "{:.5g}".format
    rows = {
        "ATE, SE(3)": report.se3.statistics,
        "ATE, Sim(3)": report.sim3.statistics,
        "ATE, yaw only": report.yaw.statistics,
        "ATE, not aligned": report.unaligned.statistics,
        "RPE translation": report.relative.translation_statistics,
        "RPE translation, Sim(3)": report.relative_sim3.translation_statistics,
        "RPE rotation": ErrorStatistics.of(np.degrees(report.relative.rotation)),
    }
    for name, errors in rows.items():
        if scale is not None and scale.startswith("free") and name in _METRIC_ONLY:
            continue
        shown = "{:.3f} deg".format if name == "RPE rotation" else length
        values = (errors.rmse, errors.mean, errors.median, errors.maximum)
        table.add_row(name, *(shown(value) if value == value else "-" for value in values))
    console.print(table)
    for warning in report.warnings:
        console.print(f"warning: {one_line(warning)}", soft_wrap=True, markup=False, highlight=False)


_METRIC_ONLY = ("ATE, SE(3)", "ATE, yaw only", "ATE, not aligned", "RPE translation")
