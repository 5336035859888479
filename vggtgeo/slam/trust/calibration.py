"""The camera against the images: does what was given explain where corners with depth are seen?

Pairs of frames `GAP` apart, in both directions, with the sensor's depth at the corners; what they say of the camera is
found in `slam/camera/camera_of_pairs.py`. Without such depth it is the map that is asked, see `free_focal`.

With the true poses, in pieces of 60 frames of corridor-office, building-walk and redkitchen, undisturbed: focal length
-5.5 to +1 %, principal point within 20 px, k1 -0.045 (redkitchen, whose lens has about that) to +0.02. With a
calibration 20 % off: 17 to 20 %; cut by an eighth on each side: 78 px (67 are true); k1 = -0.25: -0.22 to -0.27.
"""

from __future__ import annotations

import numpy as np

from vggtgeo.geometry import rigid
from vggtgeo.slam.camera.camera_of_pairs import CameraOpinion, CameraPair, camera_of_pairs
from vggtgeo.slam.trust.estimate import Estimate
from vggtgeo.slam.trust.evidence import Evidence, common
from vggtgeo.slam.trust.finding import Finding
from vggtgeo.slam.trust.still_points import MOVING, STILL

GAP = 2
MOST_PAIRS = 60
LEAST_CORNERS = 15
LEAST_FLOW = 3.0
"""Pixels: a camera that stands still says nothing of its lens."""
BLOCK = 5
"""Frames in a block of time."""
AGAIN = 0.06
"""Radians between what two frames show (motion over depth, and turn; 30 pixels at a focal length of 500), at which the
later one shows the same again: errors of depth are shared by what sees the same surfaces. With a tenth of that, 80
frames of a slow Kinect, 67 pixels of motion in all, counted as ten independent blocks, and "wanted" k1 = -0.11 by 12
standard deviations (COLMAP has 0.02). In ten pieces of the four clips all that is told of a focal length 20 % too long
is told with this, too; with twice as much it is not in 40 frames of redkitchen."""
SIGMAS, CHANCE = 5.0, 1e-4
"""How sure a deviation must be to be told: standard deviations, and with few blocks of time what Student's t makes of
this chance. Forty frames of redkitchen "wanted" the principal point 48 px away."""
FOCAL_CHANCE = 1e-3
"""The same of the focal length, which most pairs must fit better, too. Forty frames are 8 blocks: 8.6 deviations, and
15.5 of `CHANCE`. In 24 such pieces of clips the right focal length is at most 4.2 off; one 20 % wrong in building-walk
13.6, with 0.94 of the pairs, and was called good at 7 cm."""
MOST_MOVED = 0.05
"""Of the focal length: how far a run may move the camera to count as settled. Healthy ones moved it by at most 3.8 %
with a loose prior, and by less than 1 % with the one that holds it."""
SIGMAS_OF_MOVED = 3.0
"""Of the focal length of such a run, whose camera was wrong once already. Given one 1.3 times too long, 40 frames of
corridor-office moved it to one 8 % too long, by 3.4 deviations: 3.3 cm in place of 0.5, and called good."""
MOST_FOCAL = 0.08
"""Relative. Images without depth, 40 to 60 frames of each clip, are sure of a focal length that is 0.6 to 2.2 % from
the given one where that is right, and 10 to 32 % where it is 20 % wrong; those of few keyframes, that are sure of
none, are no farther than 1.1 cm off all the same."""
NEARLY_ALL = 0.8
"""Of the pairs: where so many fit another focal length better, `SIGMAS` are enough. 0.97 and 6.6 deviations where 40
frames of redkitchen had one 20 % too short (13 cm), 0.84 and 8.3 where building-walk's had one 20 % too long (6 cm),
both called good (`benchmarks/stress.py --clips redkitchen --start 220 --variants K-20`, `building-walk --start 120
--variants K+20`). With the right one, in 17 pieces of 40 frames of the clips: at most 3.2 deviations where so many fit
better, and 6.0 where 0.70 do."""
LEAST_BETTER = 2 / 3
"""Of the pairs that must fit that focal length better. 0.54 to 0.58 do with the right camera, 0.72 to 0.89 where it was
10 or 20 % wrong and the images could tell. A rolling shutter in fast turns stretches images one way: on TUM
freiburg1/rpy they "want" 565 px in place of 517, by six standard deviations, and 0.58 of the pairs fit that better."""
FAR = 0.2
"""Where the images want one so far off, `SIGMAS` are enough, and `BETTER_OF_FAR` of the pairs. Of eight pieces of 40
frames of redkitchen with one 1.3 times too long (scales of 1.15 to 1.31) six want the right one to 4 %, by 6.6 to 23
deviations, 0.64 to 0.96 of the pairs: without this rule two of them are told. Of the right one, 16 pieces of the four
clips want at most 0.18, by 5.8 (`benchmarks/focal_lengths.py`, all clips, `--factors 1 1.3`)."""
BETTER_OF_FAR = 0.5
BETTER_HALF = 0.85
"""The same where half of the time says so: a lens that zooms. 0.92 where half of corridor-office was enlarged by 1.3;
with the right camera at most 0.76 (corridor-office, redkitchen, freiburg1/rpy)."""
MOST_SHIFT = 0.05
"""Of the principal point, in image widths."""
MOST_WARP = 0.03
"""Of the corners, in image diagonals. Redkitchen's lens moves them by 7 px (0.9 %) and is found to move them by 16 and
17 where its frames are played twice; 65 px that nobody told (8 %) cost 1.3 cm in 40 frames of corridor-office and 0.2
in those of redkitchen. What is sure and smaller is a note of the run."""
MOST_ASIDE = 0.06
"""Of the given principal point from the middle of the images, in their width or height. A sensor sits behind its lens:
published calibrations of TUM RGB-D, EuRoC, KITTI and ICL-NUIM are 0.014 off (root mean square), at most 0.033. Images
that were cut, turned or scaled after their calibration are beyond."""
MOST_FOUND_ASIDE = 0.1
"""The same of a camera that the run found for itself: five standard deviations of what such a one has before anything
is seen (`camera.guessed_centre_sigma`). 0.13 where a rolling shutter had bent everything, 86 cm in building-walk."""
LEAST_FOUND_FOCAL = 0.25
"""Of the longer side of the images: the widest lens that is made to draw straight lines straight (9 mm before 36 mm,
127 degrees); a fisheye that sees half of everything has 0.32. A generated film that glides straight into an arcade was
found with 40 px for 400, in agreement with itself, the map flat by a factor of nine, and called good. Films of
strangers that came out right have 0.43 to 0.88."""
NO_CAMERA = 1.0
"""The same of the camera that images want, beyond which it is none: a cut image can have its principal point outside,
but not by so much. Pictures with a mark in the corner, of a camera that hardly moved, "wanted" it 549 px above the
middle of 480 rows (every step of the search was the longest one), and 1551 px of focal length for 481."""
MOST_BY_LENS = 0.1
"""By how much a lens that a run found for itself may have changed its focal length, logarithm. A bedroom filmed by a
phone: 0.22 (792 px, 989 with a lens, 803 by all of the video), and the camera turned by 15 degrees too little, called
good; a walk straight on 0.14; four sources that came out right 0.01 to 0.06."""
MOST_BY_UNTAKEN_LENS = 0.2
"""The same of a lens that matches do not ask for by more than chance. A head-mounted fisheye (f 208 by COLMAP), four
keyframes: 368 px, 213 with a lens, 8.8 degrees off and called good. Pieces of redkitchen without calibration, four
with depth and four without (`benchmarks/starts.py --uncalibrated --frames 54 --first 8 --every 120 [--depth]`): at most
0.08; its first 40 frames without: 0.12 (562 and 501 px in five keyframes, 525 is true)."""
CONFIRMED = 0.3
"""Of that distance: what images that know it to a fifth of it want at most, if the given camera is theirs after all."""


def camera_opinion(estimate: Estimate, evidence: Evidence) -> CameraOpinion | None:
    """The camera by the run's corners, starting at that of the run and its poses; None where there is too little."""
    return camera_of_pairs(_pairs(estimate, evidence), estimate.intrinsics, compared=True)


def check_camera(estimate: Estimate, opinion: CameraOpinion | None, size: tuple[int, int]) -> list[Finding]:
    """Deviations of the camera that the run ends with that are sure and large; size: width and height, pixels.

    opinion: found with the intrinsics at the end of the run. Those of a run that has moved from a wrong calibration to
    where the images want them are no fault; but whoever was that far off must have settled better than others.
    """
    if not estimate.calibrated:
        found = [*_check_guess(estimate), *_check_lens(estimate), *_check_found_middle(estimate.intrinsics, size)]
        return [*found, *_check_found_focal(estimate.intrinsics, size)]
    if opinion is not None and _is_no_camera(estimate.intrinsics[2:] + opinion.value[1:3], size):
        opinion = None
    middle = _check_middle(estimate.intrinsics, opinion, size)
    moved = bool(np.any(np.abs(estimate.intrinsics - estimate.given) > MOST_MOVED * estimate.given[0]))
    much = 0.5 if moved else 1.0
    if opinion is None:
        return [*_check_focal(estimate, much * MOST_FOCAL), *middle]
    found = []
    focal, x, y, radial = (float(value) for value in opinion.value)
    needed = max(SIGMAS, opinion.quantile(CHANCE))
    limits = np.full(len(opinion.value), needed)
    far = abs(focal) > FAR
    limits[0] = SIGMAS if far or opinion.better > NEARLY_ALL else max(SIGMAS, opinion.quantile(FOCAL_CHANCE))
    limits = np.array([SIGMAS_OF_MOVED, *0.8 * limits[1:]]) if moved else limits
    sure = np.abs(opinion.value) > limits * opinion.sigma
    always, at_times = opinion.better > LEAST_BETTER, opinion.better_half > BETTER_HALF
    believed = always or at_times or ((far or moved) and opinion.better > BETTER_OF_FAR)
    if sure[0] and abs(focal) > much * MOST_FOCAL and believed:
        wanted = float(np.exp(focal) * estimate.intrinsics[0])
        text = f"the images want a focal length of {wanted:.0f} px; the run has {estimate.intrinsics[0]:.0f}"
        text += "" if always or not at_times else ", which fits a part of the time: was there a zoom?"
        found.append(Finding("calibration", "degraded", text))
    if (sure[1] and abs(x) > much * MOST_SHIFT * size[0]) or (sure[2] and abs(y) > much * MOST_SHIFT * size[0]):
        text = f"the images want the principal point {x:.0f}, {y:.0f} px beside where it is taken to be"
        found.append(Finding("calibration", "degraded", text))
    else:
        found += middle
    diagonal, focal_length = float(np.hypot(*size)), float(estimate.intrinsics[0])
    warp = abs(radial) * (diagonal / 2 / focal_length) ** 3 * focal_length
    if sure[3] and warp > MOST_WARP * diagonal:
        text = (
            f"the images are distorted (k1 about {radial:.2f}, {warp:.0f} px in the corners), and the calibration does "
            "not say so"
        )
        found.append(Finding("calibration", "degraded", text))
    return found


def _is_no_camera(centre: np.ndarray, size: tuple[int, int]) -> bool:
    sides = np.array(size, np.float64)
    return bool(np.any(np.abs(centre - (sides - 1.0) / 2.0) > NO_CAMERA * sides))


def _check_focal(estimate: Estimate, most: float) -> list[Finding]:
    """Does the map want the focal lengths that the run ends with? most: how far they may be off, relative."""
    if estimate.focal_wanted is None:
        return []
    own, wanted = (float(np.sqrt(np.prod(pair))) for pair in (estimate.intrinsics[:2], estimate.focal_wanted))
    if abs(np.log(wanted / own)) <= most:
        return []
    text = (
        f"the images want a focal length of about {wanted:.0f} px; the run has {own:.0f}; without intrinsics it is "
        "found from the images"
    )
    return [Finding("calibration", "degraded", text)]


def _check_middle(camera: np.ndarray, opinion: CameraOpinion | None, size: tuple[int, int]) -> list[Finding]:
    """Is the camera that of images of this size? Few frames say too little of the principal point to tell."""
    sides = np.array(size, np.float64)
    aside = camera[2:] - (sides - 1.0) / 2.0
    far = np.abs(aside) > MOST_ASIDE * sides
    if not far.any():
        return []
    if opinion is not None:
        wanted, sigma = opinion.value[1:3], opinion.sigma[1:3]
        sure = (np.abs(wanted) < CONFIRMED * np.abs(aside)) & (sigma < 0.2 * np.abs(aside))
        if sure[far].all():
            return []
    text = (
        f"the principal point, {camera[2]:.0f}, {camera[3]:.0f}, is far from the middle of the images of "
        f"{size[0]} x {size[1]} pixels: were they cut, turned or scaled after the calibration?"
    )
    return [Finding("calibration", "degraded", text)]


def _check_guess(estimate: Estimate) -> list[Finding]:
    """Was anything seen of the camera that nobody gave?"""
    if not estimate.guessed:
        return []
    focal = float(estimate.intrinsics[0])
    text = (
        f"nobody gave the camera, and too little was seen to find it: its focal length, {focal:.0f} px, is a guess; "
        "give the intrinsics"
    )
    return [Finding("calibration", "degraded", text)]


def _check_lens(estimate: Estimate) -> list[Finding]:
    """Is a focal length believed that came with a lens and is far from that without it, or the other way round?"""
    focal, without, with_one = float(estimate.intrinsics[0]), estimate.focal_without_lens, estimate.focal_with_lens
    if without is not None and abs(np.log(focal / without)) > MOST_BY_LENS:
        two = f"by the lens that was found its focal length is {focal:.0f} px, without it {without:.0f}"
    elif with_one is not None and abs(np.log(focal / with_one)) > MOST_BY_UNTAKEN_LENS:
        two = f"its focal length is {focal:.0f} px, and {with_one:.0f} if the lens distorts, which is not known"
    else:
        return []
    text = f"nobody gave the camera, and it is not sure: {two}; give the intrinsics and the distortion"
    return [Finding("calibration", "degraded", text)]


def _check_found_middle(camera: np.ndarray, size: tuple[int, int]) -> list[Finding]:
    """Is the camera that the run found for itself one that there is?"""
    sides = np.array(size, np.float64)
    aside = camera[2:] - (sides - 1.0) / 2.0
    if np.all(np.abs(aside) <= MOST_FOUND_ASIDE * sides):
        return []
    text = (
        f"nobody gave the camera, and what was found is no usual one: its principal point, {camera[2]:.0f}, "
        f"{camera[3]:.0f}, is far from the middle of the images of {size[0]} x {size[1]} pixels; give the intrinsics, "
        "or, if the images were cut out of larger ones, cut them around the middle"
    )
    return [Finding("calibration", "degraded", text)]


def _check_found_focal(camera: np.ndarray, size: tuple[int, int]) -> list[Finding]:
    """Does the camera that the run found for itself see no wider than lenses do?"""
    focal, longer = float(np.sqrt(camera[0] * camera[1])), max(size)
    if focal >= LEAST_FOUND_FOCAL * longer:
        return []
    wide = np.degrees(2 * np.arctan(longer / 2 / focal))
    text = (
        f"nobody gave the camera, and what was found cannot be right: with a focal length of {focal:.0f} px, images of "
        f"{size[0]} x {size[1]} pixels are {wide:.0f} degrees wide, as by no lens; the map is flat along its view; "
        "give the intrinsics"
    )
    return [Finding("calibration", "degraded", text)]


def _pairs(estimate: Estimate, evidence: Evidence) -> list[CameraPair]:
    spread = np.unique(np.linspace(0, max(len(evidence) - GAP - 1, 0), MOST_PAIRS).astype(int))
    starts = [int(row) for row in spread if row + GAP < len(evidence)]
    pairs = [(row, row + GAP) for row in starts] + [(row + GAP, row) for row in starts]
    blocks = _blocks(estimate, evidence, starts)
    found = []
    for row, other in pairs:
        if not (estimate.tracked[row] and estimate.tracked[other]):
            continue
        first, second = evidence[row], evidence[other]
        rows, others = common(first, second)
        depth = first.depth[rows].astype(np.float64)
        known = np.isfinite(depth) & (depth > 0)
        if np.count_nonzero(known) < LEAST_CORNERS:
            continue
        before, after = (pixels[known].astype(np.float64) for pixels in (first.pixels[rows], second.pixels[others]))
        depth = depth[known]
        relative = estimate.poses[other] @ rigid.invert(estimate.poses[row])
        world = ~_carried_along(before, after, depth, relative, estimate.intrinsics)
        before, after, depth = before[world], after[world], depth[world]
        if len(depth) < LEAST_CORNERS:
            continue
        if np.median(np.linalg.norm(after - before, axis=1)) < LEAST_FLOW:
            continue
        found.append(CameraPair(before, after, depth, relative, int(blocks[min(row, other)])))
    return found


def _carried_along(
    before: np.ndarray, after: np.ndarray, depth: np.ndarray, relative: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Which corners stay in their place where the pose moves what is at their depth, bool [m]: a display's, a
    watermark's, not the world's.

    No lens makes them still: one 20 % off moves by a fifth less or more. With a display over redkitchen of which a half
    was found by `still_parts.py`, 9 % of the corners, the rest of it "wanted" k1 = -0.105 +- 0.010 of right poses;
    without these corners it is -0.027 +- 0.017.
    """
    seen = np.linalg.norm(after - before, axis=1)
    points = rigid.unproject(before, 1 / depth, np.eye(4), intrinsics)
    moved = np.linalg.norm(rigid.project(points, relative, intrinsics) - before, axis=1)
    return np.asarray((seen < STILL) & (moved > MOVING), bool)


def _blocks(estimate: Estimate, evidence: Evidence, rows: list[int]) -> np.ndarray:
    """The block of time of each frame, int [n], where it is one of `rows`; a block that shows again what an earlier one
    did belongs to that.

    The errors of depth in two pictures of one view are the same: redkitchen's frames played twice "wanted" the
    principal point 60 px away, twice as surely as once.
    """
    blocks = np.arange(len(evidence)) // BLOCK
    for block in np.unique(blocks[rows])[1:]:
        start = int(block) * BLOCK
        middle = min(start + BLOCK // 2, len(evidence) - 1)
        # The block before this one is its neighbour in time, however slow the camera.
        motion = estimate.poses[: start - BLOCK] @ rigid.invert(estimate.poses[middle])
        moved = np.linalg.norm(motion[:, :3, 3], axis=1) / evidence[middle].depth_median
        turned = np.arccos(np.clip((np.trace(motion[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
        again = moved + turned < AGAIN
        if again.any():
            blocks[start : start + BLOCK] = blocks[int(np.argmax(again))]
    return blocks
