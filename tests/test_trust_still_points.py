"""What stands still and what moves on its own: neither may carry the poses.

The defect is planted into a healthy synthetic walk, which the check is silent about without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from trust_checks import found_by_parts
from witness import Walk

from vggtgeo.slam.trust.finding import Finding


def test_what_moves_with_the_camera_is_no_ground(healthy: Walk) -> None:
    """Poses that stand still, as a poster over a third of the image does, are told; the true poses are not."""
    changed = []
    for frame in healthy.evidence:
        kept = frame.pixels[:, 1] < 300
        y, x = np.mgrid[320:470:30, 20:620:30]
        poster = np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)
        ids = np.concatenate([frame.ids[kept], 10_000 + np.arange(len(poster), dtype=np.int32)])
        depth = np.concatenate([frame.depth[kept], np.full(len(poster), 0.45, np.float32)])
        changed.append(replace(frame, ids=ids, pixels=np.concatenate([frame.pixels[kept], poster]), depth=depth))
    standing = np.tile(healthy.estimate.poses[:1], (len(changed), 1, 1))
    assert {f.check for f in found_by_parts(healthy.with_poses(standing), changed)} >= {"still points"}
    assert "still points" not in {f.check for f in found_by_parts(healthy.estimate, changed)}


def test_a_large_thing_that_moves_on_its_own_is_told(healthy: Walk) -> None:
    """Half of the corners on something that crosses the picture make the poses doubtful; a tenth of them do not."""

    def crossing(share: float) -> list[Finding]:
        changed = []
        for row, frame in enumerate(healthy.evidence):
            count = int(share / (1 - share) * len(frame.ids))
            rng = np.random.default_rng(1)
            start = rng.uniform((0, 0), (300, 470), (count, 2))
            pixels = (start + (9.0 * (row % 20), 0)).astype(np.float32)
            ids = np.concatenate([frame.ids, 10_000 + 1000 * (row // 20) + np.arange(count, dtype=np.int32)])
            depth = np.concatenate([frame.depth, np.ones(count, np.float32)])
            changed.append(
                replace(frame, ids=ids.astype(np.int32), pixels=np.concatenate([frame.pixels, pixels]), depth=depth)
            )
        return found_by_parts(healthy.estimate, changed)

    assert "other motion" in {f.check for f in crossing(0.55)}
    assert crossing(0.1) == []
