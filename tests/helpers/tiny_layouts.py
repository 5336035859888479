"""Tiny recordings in the layouts of the benchmarks, as they are downloaded; see `tiny_sequences` for their contents."""

import json
import shutil
import warnings
import zipfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from tiny_sequences import HEIGHT, INTRINSICS, WIDTH, depth_codes, image, pose, write_image

from vggtgeo import datasets
from vggtgeo.io.errors import InputWarning

COUNT = 3
POSES = tuple(pose(number) for number in range(COUNT))
YAW = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def _matrix(values: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in values) + "\n"


def replica(folder: Path, poses: Sequence[np.ndarray] = POSES) -> Path:
    """A room of NICE-SLAM's Replica, its camera beside it; depth in 1 / 6553.5 m."""
    for number in range(len(poses)):
        write_image(folder / f"results/frame{number:06d}.jpg", image(number))
        write_image(folder / f"results/depth{number:06d}.png", depth_codes(number))
    (folder / "traj.txt").write_text("".join(" ".join(map(str, one.ravel())) + "\n" for one in poses))
    fx, fy, cx, cy = INTRINSICS
    camera = {"w": WIDTH, "h": HEIGHT, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "scale": 6553.5}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder


def rgbd(folder: Path, colour: str = "rgb/{}.png", depth: str = "depth/{}.png") -> Path:
    """Colour and depth side by side, depth in millimetres, the camera as Open3D's recorders write it."""
    for number in range(COUNT):
        write_image(folder / colour.format(number), image(number))
        write_image(folder / depth.format(number), depth_codes(number))
    fx, fy, cx, cy = INTRINSICS
    matrix = [fx, 0.0, 0.0, 0.0, fy, 0.0, cx, cy, 1.0]
    camera = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": matrix}
    (folder / "intrinsic.json").write_text(json.dumps(camera))
    return folder


def nerfstudio(folder: Path, per_frame: bool = False) -> Path:
    """Images in any order, the camera of images of twice the pixels, of the file or of each frame; depth of half the
    pixels, millimetres; OpenGL's axes.
    """
    fx, fy, cx, cy = INTRINSICS
    camera = {"fl_x": 2 * fx, "fl_y": 2 * fy, "cx": 2 * cx + 1, "cy": 2 * cy + 1, "w": 2 * WIDTH, "h": 2 * HEIGHT}
    frames = []
    for number in reversed(range(COUNT)):
        write_image(folder / f"images/frame_{number + 8}.png", image(number))
        write_image(folder / f"depth/{number}.png", depth_codes(number)[::2, ::2])
        matrix = POSES[number] @ np.diag([1.0, -1.0, -1.0, 1.0])
        frame = {"file_path": f"./images/frame_{number + 8}.png", "transform_matrix": matrix.tolist()}
        frames.append({**frame, "depth_file_path": f"depth/{number}.png", **(camera if per_frame else {})})
    content = {**({} if per_frame else camera), "camera_model": "OPENCV", "k1": 0.0, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def scannet(folder: Path) -> Path:
    """An exported scan: colour of twice the pixels, millimetres, the second pose lost."""
    for number in range(COUNT):
        write_image(folder / f"color/{number}.png", image(number, 2 * WIDTH, 2 * HEIGHT))
        write_image(folder / f"depth/{number}.png", depth_codes(number))
        matrix = pose(number) if number != 1 else np.full((4, 4), -np.inf)
        (folder / f"pose/{number}.txt").parent.mkdir(exist_ok=True)
        (folder / f"pose/{number}.txt").write_text(_matrix(matrix))
    fx, fy, cx, cy = INTRINSICS
    for name, factor in (("color", 2.0), ("depth", 1.0)):
        matrix = np.eye(4)
        # the centre of pixel (0, 0) is the origin: a point at x in the small image lies at 2 x + 0.5 in the large one
        shift = 0.5 * (factor - 1)
        matrix[:2, :3] = [[factor * fx, 0, factor * cx + shift], [0, factor * fy, factor * cy + shift]]
        (folder / "intrinsic").mkdir(exist_ok=True)
        (folder / f"intrinsic/intrinsic_{name}.txt").write_text(_matrix(matrix))
    return folder


def scannet_flat(folder: Path) -> Path:
    """The same as SensReader in C++ exports it."""
    made = scannet(folder)
    for number in range(COUNT):
        for what, old, new in (("color", ".png", ".png"), ("depth", ".png", ".pgm"), ("pose", ".txt", ".txt")):
            source, target = made / what / f"{number}{old}", made / f"frame-{number:06d}.{what}{new}"
            if old == new:
                source.rename(target)
            else:
                write_image(target, depth_codes(number))
    lines = ["m_versionNumber = 4\n"]
    for name in ("Color", "Depth"):
        numbers = (made / f"intrinsic/intrinsic_{name.lower()}.txt").read_text().split()
        lines.append(f"m_calibration{name}Intrinsic = {' '.join(numbers)} \n")
    for what in ("color", "depth", "pose", "intrinsic"):
        shutil.rmtree(made / what)
    (made / "_info.txt").write_text("".join(lines))
    return made


def euroc(folder: Path) -> Path:
    """A flight: the camera looks along the body's x axis, 0.1 m before its centre; body poses at 200 Hz."""
    base, start = folder / "mav0", 1403636579763555584
    lines, truth = (
        ["#timestamp [ns],filename\n"],
        ["#timestamp, p x, y, z [m], q w, x, y, z\n"],
    )
    for number in range(COUNT):
        time = start + 50_000_000 * number
        write_image(base / f"cam0/data/{time}.png", image(number))
        lines.append(f"{time},{time}.png\n")
        truth.append(f"{time},{number},0,0,1,0,0,0,0,0,0,0,0,0,0,0,0\n")
    (base / "cam0/data.csv").write_text("".join(lines))
    extrinsics = YAW.copy()
    extrinsics[0, 3] = 0.1
    (base / "cam0/sensor.yaml").write_text(
        "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
        f"  data: [{', '.join(map(str, extrinsics.ravel()))}]\n"
        f"intrinsics: [{', '.join(map(str, INTRINSICS))}] #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 1.8e-05]\n"
    )
    for name, text in (("state_groundtruth_estimate0", "".join(truth)), ("imu0", "#nothing\n")):
        (base / name).mkdir()
        (base / name / "data.csv").write_text(text)
    return folder


def icl(folder: Path) -> Path:
    """The TUM-compatible form: the truth begins with frame 1; rising by y, turning about z."""
    lines, truth = [], []
    for number in range(COUNT):
        write_image(folder / f"rgb/{number}.png", image(number, 640, 480))
        write_image(folder / f"depth/{number}.png", depth_codes(number, 640, 480))
        lines.append(f"{number} depth/{number}.png {number} rgb/{number}.png\n")
        truth.append(f"{number} 1 {number} 2 0 0 {np.sin(0.1 * number)} {np.cos(0.1 * number)}\n")
    (folder / "associations.txt").write_text("".join(lines))
    (folder / "livingRoom0.gt.freiburg").write_text("".join(truth[1:]))
    return folder


def icl_raw(folder: Path) -> Path:
    """As POV-Ray rendered it: distances along the rays to a wall 2 m ahead, a camera that turns and rises; the first
    pixel of each sees nothing.
    """
    across, down = np.meshgrid((np.arange(640) - 319.5) / 481.2, (np.arange(480) - 239.5) / 480.0)
    distances = 2.0 * np.sqrt(1 + across**2 + down**2)
    distances[0, 0] = 1e10
    for number in range(COUNT):
        stem = folder / f"scene_00_{number:04d}"
        write_image(stem.with_suffix(".png"), image(number, 640, 480))
        stem.with_suffix(".depth").write_text(" ".join(f"{value:.6f}" for value in distances.ravel()) + " \n")
        sine, cosine = np.sin(0.1 * number), np.cos(0.1 * number)
        vectors = {"pos": f"1.5, {number}, -2", "dir": f"{sine}, 0, {cosine}", "up": "0, 1, 0", "lookat": "0, 0, 1"}
        vectors |= {"sky": "0, 1, 0", "right": f"{1.33 * cosine}, 0, {-1.33 * sine}", "fpoint": "0, 0, 10"}
        lines = [f"cam_{name:8s} = [{value}]';\n" for name, value in vectors.items()]
        stem.with_suffix(".txt").write_text("".join(lines) + "cam_angle    = 90;\n")
    return folder


def tanks(folder: Path, poses: Sequence[np.ndarray] = POSES) -> Path:
    """A scene with its log, its alignment to the scanner (twice as large, moved along z) and its crop."""
    log = []
    for number, one in enumerate(poses):
        write_image(folder / f"{number + 1:06d}.jpg", image(number))
        log.append(f"{number} {number} 0\n" + _matrix(one))
    (folder / f"{folder.name}_COLMAP_SfM.log").write_text("".join(log))
    alignment = np.diag([2.0, 2.0, 2.0, 1.0])
    alignment[2, 3] = 5.0
    (folder / f"{folder.name}_trans.txt").write_text(_matrix(alignment))
    corners = [[0, 0, 0], [2, 0, 0], [2, 0, 2], [1, 0, 1], [0, 0, 2]]
    crop = {"orthogonal_axis": "Y", "axis_min": -1.0, "axis_max": 1.0, "bounding_polygon": corners}
    (folder / f"{folder.name}.json").write_text(json.dumps(crop))
    return folder


def kitti(folder: Path) -> Path:
    """A drive of the odometry benchmark, colour; the truth beside it, of the grey camera 6 cm to the right."""
    place = folder / "sequences" / "07"
    for number in range(COUNT):
        write_image(place / f"image_2/{number:06d}.png", image(number))
    fx, fy, cx, cy = INTRINSICS
    rows = {"P0": [fx, 0, cx, 0], "P2": [fx, 0, cx, 0.06 * fx]}
    lines = [f"{name}: " + " ".join(map(str, [*row, 0, fy, cy, 0, 0, 0, 1, 0])) + "\n" for name, row in rows.items()]
    (place / "calib.txt").write_text("".join(lines))
    (place / "times.txt").write_text("".join(f"{0.1037 * number:e}\n" for number in range(COUNT)))
    (folder / "poses").mkdir()
    (folder / "poses/07.txt").write_text("".join(" ".join(map(str, pose(n)[:3].ravel())) + "\n" for n in range(COUNT)))
    return place


def kitti_raw(folder: Path) -> Path:
    """A synced and rectified drive of KITTI's raw recordings, its calibration in the folder of the day, and GPS/IMU."""
    place = folder / "2011_09_26" / "2011_09_26_drive_0001_sync"
    times = [f"2011-09-26 13:02:25.{964389445 + number * 100_000_000 // 8:09d}\n" for number in range(COUNT)]
    for number in range(COUNT):
        for camera in ("image_00", "image_02"):
            write_image(place / f"{camera}/data/{number:010d}.png", image(number))
            (place / camera / "timestamps.txt").write_text("".join(times))
    (place / "oxts/data").mkdir(parents=True)
    (place / "oxts/data/0000000000.txt").write_text("49.0 8.4 112.8\n")
    (place / "oxts/timestamps.txt").write_text("".join(times))
    fx, fy, cx, cy = INTRINSICS
    (place.parent / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\n"
        f"S_rect_02: {WIDTH:e} {HEIGHT:e}\n"
        f"P_rect_02: {fx:e} 0 {cx:e} {0.06 * fx:e} 0 {fy:e} {cy:e} 0 0 0 1 0\n"
    )
    return place


def record3d(folder: Path) -> Path:
    """A recording of the app Record3D, unpacked: depth of half the pixels, one row of it without trust; a camera of
    each frame, which differ a little; OpenGL's axes.
    """
    from imagecodecs import lzfse_encode

    for number in range(COUNT):
        write_image(folder / f"rgbd/{number}.jpg", image(number))
        (folder / f"rgbd/{number}.depth").write_bytes(lzfse_encode(record3d_depth(number).tobytes()))
        trust = np.full((HEIGHT // 2, WIDTH // 2), 2, np.uint8)
        trust[5] = 0
        (folder / f"rgbd/{number}.conf").write_bytes(lzfse_encode(trust.tobytes()))
    (folder / "metadata").write_text(json.dumps(RECORD3D | {"dw": WIDTH // 2, "dh": HEIGHT // 2}))
    return folder


def record3d_exported(folder: Path) -> Path:
    """The same as the app exports it, "EXR + JPG"."""
    import OpenEXR

    (folder / "depth").mkdir(parents=True)
    for number in range(COUNT):
        write_image(folder / f"rgb/{number}.jpg", image(number))
        file = OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"R": record3d_depth(number)})
        file.write(str(folder / f"depth/{number}.exr"))
    (folder / "metadata.json").write_text(json.dumps(RECORD3D))
    return folder


def record3d_depth(number: int) -> np.ndarray:
    """Metres, float32, in half the pixels: 1 + number / 10, the first pixel none."""
    depth = np.full((HEIGHT // 2, WIDTH // 2), 1 + number / 10, np.float32)
    depth[0, 0] = np.nan
    return depth


RECORD3D = {
    "w": WIDTH,
    "h": HEIGHT,
    "fps": 60,
    "K": [INTRINSICS[0] + 3, 0, 0, 0, INTRINSICS[1] + 3, 0, *INTRINSICS[2:], 1],
    "perFrameIntrinsicCoeffs": [[value + 0.1 * (number - 1) for value in INTRINSICS] for number in range(COUNT)],
    "frameTimestamps": [0.1 * number for number in range(COUNT)],
    "poses": [
        [*Rotation.from_matrix(one[:3, :3] @ np.diag([1.0, -1.0, -1.0])).as_quat(), *one[:3, 3]] for one in POSES
    ],
}


def record3d_file(path: Path) -> Path:
    """The same as the app shares it: a zip archive."""
    place = record3d(path.with_suffix(".made"))
    with zipfile.ZipFile(path, "w") as archive:
        for file in place.rglob("*"):
            archive.write(file, file.relative_to(place))
    return path


def arkit(folder: Path) -> Path:
    """A recording of ARKitScenes, its depth of half the pixels; the poses are world -> camera."""
    lines = []
    for number in range(COUNT):
        stem = f"41069021_{305.377 + 0.1 * number:.3f}.png"
        write_image(folder / "lowres_wide" / stem, image(number))
        write_image(folder / "lowres_depth" / stem, depth_codes(number, WIDTH // 2, HEIGHT // 2))
        camera = folder / "lowres_wide_intrinsics" / stem.replace(".png", ".pincam")
        camera.parent.mkdir(exist_ok=True)
        camera.write_text(f"{WIDTH} {HEIGHT} " + " ".join(str(value + 0.1 * (number - 1)) for value in INTRINSICS))
        lines.append(f"{305.377 + 0.1 * number:.3f} 0 0 0 {-number} 0 0\n")
    (folder / "lowres_wide.traj").write_text("".join(lines))
    return folder


def stray(folder: Path) -> Path:
    """A recording of Stray Scanner: a video of 1920 x 1440, depth of 64 x 48, one row of it without trust."""
    folder.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (1920, 1440))
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw\n"]
    for number in range(COUNT):
        writer.write(np.full((1440, 1920, 3), 60 * number + 40, np.uint8))
        write_image(folder / f"depth/{number:06d}.png", depth_codes(number, 64, 48))
        trust = np.full((48, 64), 2, np.uint8)
        trust[5] = 0
        write_image(folder / f"confidence/{number:06d}.png", trust)
        rows.append(f"{100.0 + 0.1 * number}, {number:06d}, {number}, 0, 0, 0, 0, 0, 1\n")
    writer.release()
    (folder / "odometry.csv").write_text("".join(rows))
    (folder / "camera_matrix.csv").write_text("1400.0, 0.0, 959.5\n0.0, 1400.0, 719.5\n0.0, 0.0, 1.0\n")
    return folder


def scanner3d(folder: Path, by_columns: bool = False) -> Path:
    """An export of 3D Scanner App: every second frame has an image, depth of half the pixels, its first row without
    trust, a thumbnail. by_columns: matrices as ARKit itself has them.
    """
    fx, fy, cx, cy = INTRINSICS
    for number in range(2 * COUNT):
        intrinsics, place = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), pose(number / 2) @ OPENGL
        stated = {"intrinsics": intrinsics, "cameraPoseARFrame": place}
        content = {key: (value.T if by_columns else value).ravel().tolist() for key, value in stated.items()}
        if number % 2 == 0:
            write_image(folder / f"frame_{number:05d}.jpg", image(number // 2))
        _small_depth(folder / f"depth_{number:05d}.png", folder / f"conf_{number:05d}.png", number // 2, 2)
        (folder / f"frame_{number:05d}.json").write_text(json.dumps(content | {"time": 100 + 0.05 * number}))
    write_image(folder / "thumb_00.jpg", image(0, 8, 6))
    (folder / "info.json").write_text("{}")
    return folder


def polycam(folder: Path, corrected: bool = False) -> Path:
    """Raw data of Polycam, named by times. corrected: the app made second poses, 1 m aside; those state no times."""
    fx, fy, cx, cy = INTRINSICS
    for number in range(COUNT):
        name = f"{6234500000 + 100000 * number}"
        for kind, aside in (("", 0.0), ("corrected_", 1.0))[: 1 + corrected]:
            place = pose(number) @ OPENGL
            place[0, 3] += aside
            camera = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": WIDTH, "height": HEIGHT}
            camera |= {f"t_{row}{column}": place[row, column] for row in range(3) for column in range(4)}
            camera |= {} if kind else {"timestamp": int(name)}
            file = folder / f"keyframes/{kind}cameras/{name}.json"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(camera))
            write_image(folder / f"keyframes/{kind}images/{name}.jpg", image(number))
        parts = (folder / f"keyframes/{what}/{name}.png" for what in ("depth", "confidence"))
        _small_depth(*parts, number, 255)
    write_image(folder / "thumbnail.jpg", image(0, 8, 6))
    (folder / "mesh_info.json").write_text("{}")
    return folder


def _small_depth(depth: Path, confidence: Path, number: int, high: int) -> None:
    write_image(depth, depth_codes(number, WIDTH // 2, HEIGHT // 2))
    trust = np.full((HEIGHT // 2, WIDTH // 2), high, np.uint8)
    trust[0] = 0
    write_image(confidence, trust)


def matroska(path: Path, milliseconds: tuple[int, ...], aspect: Fraction = Fraction(1)) -> Path:
    """A video of 64 x 48 pixels with frames at just these times, as phones record them: brightness tells the number.

    aspect: width of a pixel over its height.
    """
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=Fraction(1000 * (len(milliseconds) - 1), milliseconds[-1]))
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.codec_context.sample_aspect_ratio = aspect
        for row, time in enumerate(milliseconds):
            picture = np.full((48, 64, 3), 30 + 40 * row, np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuvj420p")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def quietly_opened(path: Path, kind: str | None = None) -> datasets.Sequence:
    """The recording, without what its reader warns of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return datasets.open_sequence(path, kind)
