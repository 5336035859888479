"""Log the entities of a run to Rerun, and those of a finished run from its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vggtgeo.datasets.image_files import read_codes
from vggtgeo.geometry import pinhole, rigid
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.geometry.trajectory import Trajectory
from vggtgeo.results.files import DEPTH_UNIT
from vggtgeo.results.output_checks import check_can_be_shown
from vggtgeo.slam.callback import WindowRecord
from vggtgeo.slam.run import frame_trajectory
from vggtgeo.slam.sparse_map.covisibility import Pair
from vggtgeo.slam.sparse_map.keyframe import Keyframe
from vggtgeo.slam.sparse_map.map import loop_edges, submap_of
from vggtgeo.slam.state import Slam, lost_stretches
from vggtgeo.solvers.levenberg_marquardt import IterationRecord

RADIUS = 0.011
"""Radius of the points of clouds, metres."""
SIGMAS = 20.0
"""Size of the ellipsoids, standard deviations: one deviation is only millimetres in a good window."""
_BLUE, _ORANGE, _GREEN, _GREY = (31, 95, 191), (224, 123, 26), (58, 143, 92), (150, 150, 150)
_RED, _PURPLE = (200, 40, 40), (142, 95, 176)
_GRAPH_RADIUS = 160.0
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 75]


class Entities:
    """Logs the entities of a run to a Rerun stream, at the stream's current time; one method for each entity."""

    def __init__(self, stream: Any) -> None:
        import rerun

        self._stream, self._rr = stream, rerun

    def axes(self) -> None:
        """Log the axes of the world: x right, y down, z forward."""
        self._stream.log("world", self._rr.ViewCoordinates.RDF, static=True)

    def clear(self, *paths: str) -> None:
        """Remove all entities below `paths`, from the current time on."""
        for path in paths:
            self._stream.log(path, self._rr.Clear(recursive=True))

    def camera(self, pose: np.ndarray, intrinsics: np.ndarray, image: np.ndarray) -> None:
        """Log the current frame's camera (`pose` world -> camera, float [4, 4]) with its image at half size."""
        height, width = image.shape[:2]
        fx, fy, cx, cy = (float(value) for value in intrinsics)
        self.pose("world/camera", pose)
        half = (width // 2, height // 2)
        camera = np.array([[fx / 2, 0, (cx - 0.5) / 2], [0, fy / 2, (cy - 0.5) / 2], [0, 0, 1]])
        axes = self._rr.ViewCoordinates.RDF
        lens = self._rr.Pinhole(image_from_camera=camera, resolution=half, camera_xyz=axes, image_plane_distance=0.25)
        self._stream.log("world/camera/image", lens, self._jpeg(cv2.resize(image, half, interpolation=cv2.INTER_AREA)))

    def pose(self, path: str, pose: np.ndarray) -> None:
        """Log a camera pose, world -> camera, float [4, 4]; entities below `path` are in the camera's frame."""
        to_world = rigid.invert(pose)
        self._stream.log(path, self._rr.Transform3D(translation=to_world[:3, 3], mat3x3=to_world[:3, :3]))

    def path(self, trajectory: Trajectory, keyframes: Trajectory) -> None:
        """Log the path of all frames so far, and the keyframes on it."""
        self._lines("world/trajectory", [trajectory.positions], _BLUE)
        self._stream.log("world/keyframes", self._rr.Points3D(keyframes.positions, colors=[_BLUE], radii=-4.0))

    def loops(self, slam: Slam, apart: int) -> None:
        """Log lines between the keyframes of loop closures. apart: see `loop_edges`."""
        ends = [[rigid.centre(slam.keyframes[number].pose) for number in edge] for edge in loop_edges(slam.map, apart)]
        self._lines("world/loops", ends, _PURPLE)

    def lost(self, slam: Slam) -> None:
        """Log where tracking was lost: a point and, within one submap, a line to the place of relocalisation.

        Also log the paths of submaps that are not connected to the largest one, whose relative pose is a guess.
        """
        label = submap_of(slam.map) if slam.keyframes else np.zeros(0, int)
        losses, gaps = [], []
        for first, last in lost_stretches(slam):
            around = [slam.frames[row] for row in (first - 1, last + 1) if 0 <= row < len(slam.frames)]
            centres = [rigid.centre(slam.pose(record)) for record in around]
            if first:
                losses.append(centres[0])
            if len(around) == 2 and label[around[0].reference] == label[around[1].reference]:
                gaps.append(centres)
        self._lines("world/lost", gaps, _RED, -2.0)
        self._stream.log("world/lost/begun", self._rr.Points3D(np.reshape(losses, (-1, 3)), colors=[_RED], radii=-6.0))
        paths = [frame_trajectory(slam, submap).positions for submap in range(1, label.max(initial=0) + 1)]
        self._lines("world/unjoined", paths, _ORANGE)

    def covariance(self, keyframes: list[Keyframe], covariances: np.ndarray) -> None:
        """Log ellipsoids of the camera centres; `covariances` [n, 6, 6] of the left tangents, translation first."""
        known = [
            (keyframe.pose, covariance)
            for keyframe, covariance in zip(keyframes, covariances, strict=True)
            if np.isfinite(covariance).all() and covariance[:3, :3].any()
        ]
        drawn = [ellipsoid(pose, covariance) for pose, covariance in known]
        centres, half_sizes, quaternions = ([part[i] for part in drawn] for i in range(3))
        colours = [(*_ORANGE, 120)] * len(drawn)
        shapes = self._rr.Ellipsoids3D(centers=centres, half_sizes=half_sizes, quaternions=quaternions, colors=colours)
        self._stream.log("world/covariance", shapes)

    def window(self, keyframes: list[Keyframe], pairs: list[Pair]) -> None:
        """Log the window's keyframes and matched pairs, as a graph and as lines in the world."""
        names = {keyframe.number: str(keyframe.number) for keyframe in keyframes}
        inside = [pair for pair in pairs if pair.first in names and pair.second in names]
        ids = list(names.values())
        turn = 2 * np.pi * np.arange(len(keyframes)) / len(keyframes)
        places = _GRAPH_RADIUS * np.stack([np.sin(turn), -np.cos(turn)], 1)  # the oldest at the top, clockwise
        nodes = self._rr.GraphNodes(ids, positions=places, labels=[f"frame {k.frame}" for k in keyframes])
        edges = self._rr.GraphEdges([(names[pair.first], names[pair.second]) for pair in inside])
        self._stream.log("window/graph", nodes, edges)
        centre = {keyframe.number: rigid.centre(keyframe.pose) for keyframe in keyframes}
        strips = [np.stack([centre[pair.first], centre[pair.second]]) for pair in inside]
        self._lines("world/covisibility", strips, (*_GREEN, 90), -0.8)

    def keyframe(self, keyframe: Keyframe, pair: Pair | None) -> None:
        """Log image, matches of `pair`, line segments, depth and confidence of a keyframe."""
        self._stream.log("keyframe/image", self._jpeg(keyframe.image))
        seen = np.zeros((0, 2)) if pair is None else pair.points.pixels_j
        before = np.zeros((0, 2)) if pair is None else pair.points.pixels_i
        self._stream.log("keyframe/image/matches", self._rr.Points2D(seen, colors=[_BLUE], radii=2.0))
        motion = self._rr.LineStrips2D(np.stack([before, seen], 1), colors=[(*_BLUE, 140)], radii=-0.7)
        self._stream.log("keyframe/image/motion", motion)
        ends = np.asarray(keyframe.lines.segments.endpoints, np.float64).reshape(-1, 2, 2)
        matched = np.isin(np.arange(len(ends)), [] if pair is None else pair.lines.index_j)
        colours = np.where(matched[:, None], _ORANGE, _GREY).astype(np.uint8)
        self._stream.log("keyframe/image/lines", self._rr.LineStrips2D(list(ends), colors=colours, radii=-1.5))
        if keyframe.images.has_depth:
            millimetres = np.nan_to_num(1000.0 * keyframe.depth[::2, ::2].astype(np.float32)).astype(np.uint16)
            self.depth(millimetres, 1000.0)
        self.confidence(keyframe.depth_confidence[::2, ::2])

    def depth(self, codes: np.ndarray, units_per_metre: float) -> None:
        """Log a keyframe's depth, uint16 [H, W], 0 = unknown."""
        self._stream.log("keyframe/depth", self._rr.DepthImage(codes, meter=units_per_metre, colormap="viridis"))

    def confidence(self, codes: np.ndarray) -> None:
        """Log the confidence of a keyframe's depth, uint8 [H, W], 255 = 1."""
        coloured = cv2.applyColorMap(codes, cv2.COLORMAP_VIRIDIS)
        self._stream.log("keyframe/confidence", self._jpeg(coloured[..., ::-1]))

    def points(self, keyframes: list[Keyframe], intrinsics: np.ndarray) -> None:
        """Log the window's adjusted points, in the colours of their pixels."""
        points, colours = [], []
        for keyframe in keyframes:
            inverse = keyframe.points.inverse_depth
            known = np.nonzero(np.isfinite(inverse) & (inverse > 0.1))[0]
            points.append(rigid.unproject(keyframe.points.pixels[known], inverse[known], keyframe.pose, intrinsics))
            colours.append(pinhole.at_pixels(keyframe.image, keyframe.points.pixels[known]))
        cloud = self._rr.Points3D(np.concatenate(points), colors=np.concatenate(colours), radii=-1.5)
        self._stream.log("world/points", cloud)

    def mesh(self, mesh: Mesh) -> None:
        """Log the mesh of the map, for all times."""
        shape = self._rr.Mesh3D(
            vertex_positions=mesh.vertices,
            triangle_indices=mesh.faces,
            vertex_normals=mesh.normals,
            vertex_colors=mesh.colours,
        )
        self._stream.log("world/mesh", shape, static=True)

    def cloud(self, path: str, points: np.ndarray, colours: np.ndarray) -> None:
        """Log points, float32 [n, 3], and colours, uint8 [n, 3], from the current time on."""
        self._stream.log(path, self._rr.Points3D(points, colors=colours, radii=RADIUS))

    def residuals(self, record: WindowRecord) -> None:
        """Log the RMS residual of each term after an adjustment."""
        for name, value in record.rms.items():
            if np.isfinite(value):
                self._stream.log(f"plots/residuals/{name}", self._rr.Scalars(value))

    def iteration(self, row: int, energy: float, record: IterationRecord | None, members: int) -> None:
        """Log the energy after step `row` of the window's solver.

        With a `record` also log the cameras, and the base-10 logarithms of damping, gradient norm, and the largest
        motion of a camera centre, metres.
        """
        self._stream.log("plots/solver/energy", self._rr.Scalars(energy))
        if record is None:
            return
        centres = [_centres(record.moved[k][:members]) for k in (row, max(row - 1, 0))]
        self._lines("world/iteration", [centres[0]], _ORANGE, -1.0)
        values = {
            "damping": float(record.damping[row]),
            "gradient": float(record.gradient_norm[row]),
            "step": float(np.linalg.norm(centres[0] - centres[1], axis=1).max()),
        }
        for name, value in values.items():
            if value > 0 and np.isfinite(value):
                self._stream.log(f"plots/convergence/{name}", self._rr.Scalars(np.log10(value)))

    def tracking(self, slam: Slam) -> None:
        """Log the inliers of the last frame, and the number of frames since tracking was lost."""
        self._stream.log("plots/tracking/inliers", self._rr.Scalars(float(slam.frames[-1].inliers)))
        self._stream.log("plots/tracking/lost", self._rr.Scalars(float(slam.tracker.lost)))

    def note(self, text: str, level: str = "WARN") -> None:
        """Log a message of the run."""
        self._stream.log("notes", self._rr.TextLog(text, level=level))

    def _lines(self, path: str, strips: Sequence[Any], colour: tuple[int, ...], radius: float = -1.5) -> None:
        self._stream.log(path, self._rr.LineStrips3D(strips, colors=[colour] * len(strips), radii=radius))

    def _jpeg(self, image: np.ndarray) -> Any:
        done, code = cv2.imencode(".jpg", image[..., ::-1], _QUALITY)
        assert done
        return self._rr.EncodedImage(contents=code.tobytes(), media_type="image/jpeg")


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


def _centres(poses: Any) -> np.ndarray:
    """Return the camera centres, [n, 3], of poses world -> camera, [n, 7]."""
    return rigid.invert(rigid.to_matrix(np.asarray(poses, np.float64)))[:, :3, 3]


def log_folder(stream: Any, folder: Path) -> None:
    """Log the path, keyframes, map and mesh of a finished run, and each keyframe's saved depth and confidence.

    Raises:
        InputError: `trajectory.txt`, `keyframes.txt` or `map.ply` is missing in `folder`.

    """
    check_can_be_shown(folder)
    entities = Entities(stream)
    entities.axes()
    stream.set_time("frame", sequence=0)
    entities.path(*(Trajectory.load_tum(folder / name) for name in ("trajectory.txt", "keyframes.txt")))
    cloud = PointCloud.load_ply(folder / "map.ply")
    entities.cloud("world/map", cloud.points, cloud.colours)
    if (folder / "mesh.ply").is_file():
        entities.mesh(Mesh.load_ply(folder / "mesh.ply"))
    for file in sorted(folder.glob("depth/*.depth.png")):
        if (number := file.name.split(".")[0]).isdecimal():
            stream.set_time("frame", sequence=int(number))
            entities.depth(read_codes(file), DEPTH_UNIT)
            confidence = file.with_name(f"{number}.confidence.png")
            if confidence.is_file():
                entities.confidence(read_codes(confidence))
