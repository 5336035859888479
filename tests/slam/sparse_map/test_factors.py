"""What factors say of a motion's length where the unit of the map is free."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vggtgeo.geometry import lie, rigid
from vggtgeo.geometry.rigid import exponential
from vggtgeo.slam.sparse_map.factors import FREE_LENGTH, MeasuredRelativePose


def _factor(seed: int) -> MeasuredRelativePose:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
    pose[:3, 3] = rng.normal(0, 1, 3)
    root = rng.normal(0, 1, (6, 12))
    return MeasuredRelativePose(3, 5, pose, 1e4 * root @ root.T)


@pytest.mark.parametrize("seed", range(5))
def test_a_motion_of_free_length_gives_way_to_another_unit_alone(seed: int) -> None:
    """Oracle: a motion longer by a factor costs what `FREE_LENGTH` says of that factor, where it cost hundreds of
    times as much; a step across costs as before.
    """
    factor = _factor(seed)
    free = factor.of_free_length()
    assert (free.first, free.second) == (factor.first, factor.second)
    assert np.array_equal(free.pose, factor.pose)

    def cost(motion: MeasuredRelativePose, other: np.ndarray) -> float:
        off = lie.steps(motion.pose[None], other[None])[0]
        return float(off @ motion.information @ off)

    longer = factor.pose.copy()
    longer[:3, 3] *= 1.1
    assert cost(free, longer) == pytest.approx((0.1 / FREE_LENGTH) ** 2, rel=0.01)
    assert cost(factor, longer) > 100 * cost(free, longer)
    # What is, by this information, independent of the length (conjugate to it) costs as before.
    length = np.append(factor.pose[:3, 3], np.zeros(3))
    rng = np.random.default_rng(seed)
    across = rng.normal(0, 1, 6)
    across -= length * (length @ factor.information @ across) / (length @ factor.information @ length)
    turned = rigid.orthonormal(exponential(1e-3 * across) @ factor.pose)
    assert cost(free, turned) == pytest.approx(cost(factor, turned), rel=1e-6)
