"""Rows of a small table of two recordings, two settings and three seeds, and another system beside them, for
tests of what is made of them.
"""

EXTERNAL = '\n[[external]]\nname = "other"\ntitle = "Other-SLAM"\nfiles = "other/{sequence}.txt"\n'
"""Of a suite: the trajectories of another system."""


def row(sequence: str, setting: str, seed: int, cm: float | None, **more: object) -> dict:
    """A row of the table."""
    known = {"status": "ok", "verdict": "good", "frames": 10, "tracked": 9, "protocol": "every-frame", "metric": True}
    errors = {} if cm is None else {"ate_se3_m": cm / 100, "ate_sim3_m": cm / 200, "scale": 1.0}
    return {"suite": "tiny", "sequence": sequence, "setting": setting, "seed": seed, **known, **errors, **more}


ROWS = [
    *(row("walk", "full", seed, cm) for seed, cm in enumerate((2.0, 4.0, 3.0))),
    *(row("walk", "bare", seed, cm) for seed, cm in enumerate((5.0, 9.0, 7.0))),
    *(row("hall", "full", seed, cm) for seed, cm in enumerate((8.0, 8.5, 9.0))),
    *(row("hall", "bare", seed, cm) for seed, cm in enumerate((7.0, 8.0, 7.5))),
]
