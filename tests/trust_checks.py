"""The checks of the verdict that need a step before them, each as one call."""

from __future__ import annotations

import numpy as np
from witness import SIZE

from vggtgeo.slam.trust.calibration import camera_opinion, check_camera
from vggtgeo.slam.trust.change_of_sides import check_sides
from vggtgeo.slam.trust.depth_agreement import check_depth, depth_ratios
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import FrameEvidence
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.pace import pace
from vggtgeo.slam.trust.scale_drift import check_scale, hand_overs
from vggtgeo.slam.trust.steps import breaks, check_steps, steps
from vggtgeo.slam.trust.still_points import check_parts, divide


def found_by_steps(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    """Jumps, by the images of both ends of each step."""
    taken = steps(estimate, evidence)
    return check_steps(estimate, taken, breaks(estimate, evidence, taken))


def found_by_parts(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    """Parts of the picture that stand still, or move on their own."""
    return check_parts(estimate, [divide(step) for step in steps(estimate, evidence)])


def found_by_sides(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    """Poses that leave what they had explained for what they had not."""
    return list(check_sides(estimate, steps(estimate, evidence)))


def found_by_depth(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    """Depth against motion and other depth."""
    return list(check_depth(estimate, depth_ratios(estimate, evidence, pace(estimate, evidence))))


def found_by_camera(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    """The calibration, by what the images ask for."""
    return check_camera(estimate, camera_opinion(estimate, evidence), SIZE)


def found_by_scale(estimate: Estimate, evidence: list[FrameEvidence]) -> list[Finding]:
    """The scale from keyframe to keyframe."""
    return check_scale(estimate, hand_overs(estimate, evidence, np.ones(len(estimate), bool)))
