"""A lens that zooms or is changed, a depth camera whose unit changes: what they cost, and whether they are told.

    D=../shared/data
    .venv/bin/python benchmarks/sensor_drift.py $D/building-walk $D/corridor-office $D/redkitchen $D/icl-office

The first 40 frames of each clip, with depth and without: as they are; enlarged steadily, by 1.3 in the end, depth with
them; enlarged at once, by 1.7 from the middle on; with depth that is longer and longer, by 1.4 in the end. ATE after
SE(3) with depth, after Sim(3) without. Oracle: what was done.
"""

from __future__ import annotations

from degraded_clips import degraded_clips, input_of, judged, options_of

CHANGES = ("base", "zooming", "changed_lens", "growing_depth")


def main() -> None:
    """Print a row for each clip, with depth and without, and each change."""
    options = options_of(__doc__)
    print("| clip | input | change | cm | verdict | reasons |\n" + "|---" * 6 + "|")
    for folder in options.clips:
        for name, sequence in degraded_clips(folder, options.frames, CHANGES):
            if name == "growing_depth" and not sequence.has_depth:
                continue
            result, error = judged(sequence)
            reasons = "; ".join(result.verdict.reasons)
            row = (sequence.name, input_of(sequence), name, f"{100 * error:.1f}", result.verdict.level, reasons)
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
