"""The logged entities, one function each; they take plain values and a stream whose time is set."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.slam.run import frame_trajectory
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import loop_edges, submap_of
from vggtgeo.slam.state import Slam
from vggtgeo.slam.submaps import lost_stretches
from vggtgeo.slam.window_recorder import WindowRecord
from vggtgeo.solvers.levenberg_marquardt import IterationRecord

RADIUS = 0.011
"""Of the points of clouds, metres."""
SIGMAS = 20.0
"""Size of the ellipsoids, standard deviations: one is only millimetres in a good window."""
_BLUE, _ORANGE, _GREEN, _GREY = (31, 95, 191), (224, 123, 26), (58, 143, 92), (150, 150, 150)
_RED, _PURPLE = (200, 40, 40), (142, 95, 176)
_GRAPH_RADIUS = 160.0
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 75]


def log_camera(stream: Any, pose: np.ndarray, intrinsics: np.ndarray, image: np.ndarray) -> None:
    """Log the current frame's camera (`pose` world -> camera, float [4, 4]) with its image at half size."""
    import rerun as rr

    height, width = image.shape[:2]
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    log_pose(stream, "world/camera", pose)
    half = (width // 2, height // 2)
    camera = np.array([[fx / 2, 0, (cx - 0.5) / 2], [0, fy / 2, (cy - 0.5) / 2], [0, 0, 1]])
    lens = rr.Pinhole(
        image_from_camera=camera, resolution=half, camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.25
    )
    stream.log("world/camera/image", lens, _jpeg(cv2.resize(image, half, interpolation=cv2.INTER_AREA)))


def log_pose(stream: Any, path: str, pose: np.ndarray) -> None:
    """Log where a camera stands, `pose` world -> camera, float [4, 4]: entities below `path` are in its frame."""
    import rerun as rr

    to_world = rigid.invert(pose)
    stream.log(path, rr.Transform3D(translation=to_world[:3, 3], mat3x3=to_world[:3, :3]))


def log_path(stream: Any, trajectory: Trajectory, keyframes: Trajectory) -> None:
    """Log the path of all frames so far, and the keyframes on it."""
    import rerun as rr

    stream.log("world/trajectory", rr.LineStrips3D([trajectory.positions], colors=[_BLUE], radii=-1.5))
    stream.log("world/keyframes", rr.Points3D(keyframes.positions, colors=[_BLUE], radii=-4.0))


def log_loops(stream: Any, slam: Slam, apart: int) -> None:
    """Log lines between the keyframes of loop closures, see `loop_edges`."""
    import rerun as rr

    ends = [[rigid.centre(slam.keyframes[number].pose) for number in edge] for edge in loop_edges(slam.map, apart)]
    stream.log("world/loops", rr.LineStrips3D(ends, colors=[_PURPLE] * len(ends), radii=-1.5))


def log_lost(stream: Any, slam: Slam) -> None:
    """Log where tracking was lost: a point there and, within one submap, a line to where it was relocalised. Also the
    paths of submaps that are not connected with the largest; their pose relative to it is a guess.
    """
    import rerun as rr

    label = submap_of(slam.map) if slam.keyframes else np.zeros(0, int)
    losses, gaps = [], []
    for first, last in lost_stretches(slam):
        around = [slam.frames[row] for row in (first - 1, last + 1) if 0 <= row < len(slam.frames)]
        centres = [rigid.centre(slam.pose(record)) for record in around]
        if first:
            losses.append(centres[0])
        if len(around) == 2 and label[around[0].reference] == label[around[1].reference]:
            gaps.append(centres)
    stream.log("world/lost", rr.LineStrips3D(gaps, colors=[_RED] * len(gaps), radii=-2.0))
    stream.log("world/lost/begun", rr.Points3D(np.reshape(losses, (-1, 3)), colors=[_RED], radii=-6.0))
    paths = [frame_trajectory(slam, submap).positions for submap in range(1, label.max(initial=0) + 1)]
    stream.log("world/unjoined", rr.LineStrips3D(paths, colors=[_ORANGE] * len(paths), radii=-1.5))


def log_covariance(stream: Any, keyframes: list[Keyframe], covariances: np.ndarray) -> None:
    """Log ellipsoids of the camera centres; `covariances` [n, 6, 6] of the left tangents, translation first."""
    import rerun as rr

    known = [
        (keyframe.pose, covariance)
        for keyframe, covariance in zip(keyframes, covariances, strict=True)
        if np.isfinite(covariance).all() and covariance[:3, :3].any()
    ]
    drawn = [ellipsoid(pose, covariance) for pose, covariance in known]
    centres, half_sizes, quaternions = ([part[i] for part in drawn] for i in range(3))
    colours = [(*_ORANGE, 120)] * len(drawn)
    stream.log(
        "world/covariance",
        rr.Ellipsoids3D(centers=centres, half_sizes=half_sizes, quaternions=quaternions, colors=colours),
    )


def ellipsoid(pose: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centre [3], half sizes [3] and quaternion (x, y, z, w) of the `SIGMAS` ellipsoid of a camera's centre.

    A step `rho` of the translation moves the centre by `-R' rho`, so its covariance is `R' Sigma R`.
    """
    rotation = pose[:3, :3]
    variances, axes = np.linalg.eigh(rotation.T @ covariance[:3, :3] @ rotation)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    frame = np.eye(4)
    frame[:3, :3] = axes
    quaternion = np.roll(rigid.to_quaternion(frame[None])[0, :4], -1)
    return rigid.centre(pose), SIGMAS * np.sqrt(np.maximum(variances, 0.0)), quaternion


def log_window(stream: Any, keyframes: list[Keyframe], pairs: list[Pair]) -> None:
    """Log the window's keyframes and matched pairs, as a graph and as lines in the world."""
    import rerun as rr

    names = {keyframe.number: str(keyframe.number) for keyframe in keyframes}
    inside = [pair for pair in pairs if pair.first in names and pair.second in names]
    ids = list(names.values())
    turn = 2 * np.pi * np.arange(len(keyframes)) / len(keyframes)
    places = _GRAPH_RADIUS * np.stack([np.sin(turn), -np.cos(turn)], 1)  # the oldest at the top, clockwise
    nodes = rr.GraphNodes(ids, positions=places, labels=[f"frame {k.frame}" for k in keyframes])
    stream.log("window/graph", nodes, rr.GraphEdges([(names[pair.first], names[pair.second]) for pair in inside]))
    centre = {keyframe.number: rigid.centre(keyframe.pose) for keyframe in keyframes}
    strips = [np.stack([centre[pair.first], centre[pair.second]]) for pair in inside]
    stream.log("world/covisibility", rr.LineStrips3D(strips, colors=[(*_GREEN, 90)] * len(strips), radii=-0.8))


def log_keyframe(stream: Any, keyframe: Keyframe, pair: Pair | None) -> None:
    """Log image, matches of `pair`, line segments, depth and confidence of a keyframe."""
    import rerun as rr

    stream.log("keyframe/image", _jpeg(keyframe.image))
    seen = np.zeros((0, 2)) if pair is None else pair.points.pixels_j
    before = np.zeros((0, 2)) if pair is None else pair.points.pixels_i
    stream.log("keyframe/image/matches", rr.Points2D(seen, colors=[_BLUE], radii=2.0))
    stream.log(
        "keyframe/image/motion", rr.LineStrips2D(np.stack([before, seen], 1), colors=[(*_BLUE, 140)], radii=-0.7)
    )
    ends = np.asarray(keyframe.lines.segments.endpoints, np.float64).reshape(-1, 2, 2)
    matched = np.isin(np.arange(len(ends)), [] if pair is None else pair.lines.index_j)
    colours = np.where(matched[:, None], _ORANGE, _GREY).astype(np.uint8)
    stream.log("keyframe/image/lines", rr.LineStrips2D(list(ends), colors=colours, radii=-1.5))
    if keyframe.images.has_depth:
        millimetres = np.nan_to_num(1000.0 * keyframe.depth[::2, ::2].astype(np.float32)).astype(np.uint16)
        stream.log("keyframe/depth", rr.DepthImage(millimetres, meter=1000.0, colormap="viridis"))
    coloured = cv2.applyColorMap(keyframe.depth_confidence[::2, ::2], cv2.COLORMAP_VIRIDIS)
    stream.log("keyframe/confidence", _jpeg(coloured[..., ::-1]))


def log_points(stream: Any, keyframes: list[Keyframe], intrinsics: np.ndarray) -> None:
    """Log the window's adjusted points, in the colours of their pixels."""
    import rerun as rr

    points, colours = [], []
    for keyframe in keyframes:
        inverse = keyframe.points.inverse_depth
        known = np.nonzero(np.isfinite(inverse) & (inverse > 0.1))[0]
        points.append(rigid.unproject(keyframe.points.pixels[known], inverse[known], keyframe.pose, intrinsics))
        colours.append(pinhole.at_pixels(keyframe.image, keyframe.points.pixels[known]))
    stream.log("world/points", rr.Points3D(np.concatenate(points), colors=np.concatenate(colours), radii=-1.5))


def log_mesh(stream: Any, mesh: Mesh) -> None:
    """Log the mesh of the map, at all times."""
    import rerun as rr

    shape = rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=mesh.normals,
        vertex_colors=mesh.colours,
    )
    stream.log("world/mesh", shape, static=True)


def log_cloud(stream: Any, path: str, points: np.ndarray, colours: np.ndarray) -> None:
    """Log points, float32 [n, 3], and colours, uint8 [n, 3], from the current time on."""
    import rerun as rr

    stream.log(path, rr.Points3D(points, colors=colours, radii=RADIUS))


def log_residuals(stream: Any, record: WindowRecord) -> None:
    """Log the RMS residual of each term after an adjustment."""
    import rerun as rr

    for name, value in record.rms.items():
        if np.isfinite(value):
            stream.log(f"plots/residuals/{name}", rr.Scalars(value))


def log_iteration(stream: Any, row: int, energy: float, record: IterationRecord | None, members: int) -> None:
    """Log the energy after step `row` of the window's solver and, from a `record`, the cameras, and base-10 logarithms
    of damping, gradient norm, and largest motion of a camera centre, metres.
    """
    import rerun as rr

    stream.log("plots/solver/energy", rr.Scalars(energy))
    if record is None:
        return
    centres = [_centres(record.moved[k][:members]) for k in (row, max(row - 1, 0))]
    stream.log("world/iteration", rr.LineStrips3D([centres[0]], colors=[_ORANGE], radii=-1.0))
    values = {
        "damping": float(record.damping[row]),
        "gradient": float(record.gradient_norm[row]),
        "step": float(np.linalg.norm(centres[0] - centres[1], axis=1).max()),
    }
    for name, value in values.items():
        if value > 0 and np.isfinite(value):
            stream.log(f"plots/convergence/{name}", rr.Scalars(np.log10(value)))


def _centres(poses: Any) -> np.ndarray:
    """Return the camera centres, [n, 3], of poses world -> camera, [n, 7]."""
    return rigid.invert(rigid.to_matrix(np.asarray(poses, np.float64)))[:, :3, 3]


def log_tracking(stream: Any, slam: Slam) -> None:
    """Log the inliers of the last frame, and the number of frames since tracking was lost."""
    import rerun as rr

    stream.log("plots/tracking/inliers", rr.Scalars(float(slam.frames[-1].inliers)))
    stream.log("plots/tracking/lost", rr.Scalars(float(slam.tracker.lost)))


def log_note(stream: Any, text: str, level: str = "WARN") -> None:
    """Log a message of the run."""
    import rerun as rr

    stream.log("notes", rr.TextLog(text, level=level))


def _jpeg(image: np.ndarray) -> Any:
    import rerun as rr

    done, code = cv2.imencode(".jpg", image[..., ::-1], _QUALITY)
    assert done
    return rr.EncodedImage(contents=code.tobytes(), media_type="image/jpeg")
