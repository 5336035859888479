"""Where the poses of a prior come from, and that they are no truth of the same run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recorded_run import SETTINGS

from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.results.reconstruction import reconstruct
from vggtgeo.results.run_options import RunOptions
from vggtgeo.results.source import Source, open_source, with_pose_prior
from vggtgeo.simulation import simulate


@pytest.fixture(scope="module")
def source() -> Source:
    return open_source(simulate("room", 3, size=(160, 120)), None, SETTINGS)


def test_recorded_poses_are_prior_or_truth(source: Source) -> None:
    """Those that the reader knows become the prior, and the run has no truth; without a prior they stay the truth."""
    same, nothing = with_pose_prior(source, None)
    assert same is source
    assert nothing is None
    hidden, recorded = with_pose_prior(source, "recorded")
    assert hidden.truth is None
    assert recorded is not None
    assert source.truth is not None
    np.testing.assert_array_equal(recorded.trajectory.poses, source.truth.poses)


def test_poses_of_a_file_leave_the_truth(source: Source, tmp_path: Path) -> None:
    """A file of poses is read as a trajectory is, and the truth of the sequence stays."""
    assert source.truth is not None
    file = tmp_path / "odometry.txt"
    source.truth.save_tum(file)
    same, recorded = with_pose_prior(source, file)
    assert same.truth is source.truth
    assert recorded is not None
    np.testing.assert_allclose(recorded.trajectory.poses, source.truth.poses, atol=1e-6)


@pytest.mark.usefixtures("uncompiled")
def test_a_run_says_what_became_of_the_prior() -> None:
    """Two frames compare no motion: the prior is not used, and the summary and a note say so; there is no truth."""
    sequence = simulate("room", 2, size=(160, 120))
    summary = reconstruct(sequence, settings=SETTINGS, pose_prior="recorded", options=RunOptions(dense="none")).summary
    assert summary["pose_prior"] == {"used": False, "unit": None, "compared": 0, "evidence": 0.0}
    assert "truth" not in summary
    other = Trajectory(np.array([100.0, 101.0]), np.tile(np.eye(4), (2, 1, 1)))
    summary = reconstruct(sequence, settings=SETTINGS, pose_prior=other, options=RunOptions(dense="none")).summary
    assert not summary["pose_prior"]["used"]
    assert "truth" in summary or summary["frames"] < 3
