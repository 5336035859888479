"""Rows of the table of bad inputs: images, depth, text files, videos, point clouds and problem files."""

from __future__ import annotations

import io
import pickle
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_files as bad
import numpy as np
import tiny_layouts as layouts
import tiny_sequences as tiny
from bad_row import Row, read_frames, rows, solve_with

from vggtgeo.bundle.objective import energy
from vggtgeo.bundle.problem_file import load_problem
from vggtgeo.geometry.point_cloud import PointCloud
from vggtgeo.results.source import open_source
from vggtgeo.slam.settings.slam_settings import SlamSettings

PICTURE = bad.picture(1)
WIDE = (PICTURE.astype(np.uint16) << 8) + 128
HALF_GREY = np.vstack([PICTURE[:16], np.full((32, 64, 3), 128, np.uint8)])
NUL = b"\0" * 999
XYZ = "\nproperty float x\nproperty float y\nproperty float z\n"
WEIGHTS = ("pt_weight", "ln_weight", "d_weight")
LISTED = (
    *("edges", "var_kf", "var_uv", "d_init", "d_prior", "d_sigma", "pt_edge", "pt_var", "pt_target", "ln_edge"),
    *("ln_var", "ln_abc", *WEIGHTS),
)
LOADED: dict[str, Any] = {"call": load_problem, "argv": None}


def linked_to_itself(folder: Path) -> Path:
    """Good images and a link to itself."""
    bad.frames(folder / "frames")
    (folder / "frames/1.png").unlink()
    (folder / "frames/1.png").symlink_to("1.png")
    return folder / "frames"


def calibrated(content: str | bytes) -> Any:
    """Good images with this `calibration.txt`."""
    return lambda folder: bad.frames(folder / "frames", calibration=content)


def phone(folder: Path, size: tuple[int, int] = (20, 15)) -> Path:
    """Images and depth in folders, the depth of half their sides, or of another size."""
    made = layouts.rgbd(folder / "phone")
    for file in sorted((made / "depth").iterdir()):
        tiny.write_image(file, np.full(size[::-1], 2000, np.uint16))
    return made


def sensor(*change: str) -> Any:
    """A flight of EuRoC, a sentence of its `sensor.yaml` changed."""

    def make(folder: Path) -> Path:
        file = layouts.euroc(folder / "MH_01") / "mav0/cam0/sensor.yaml"
        (folder / "MH_01/mav0/imu0/data.csv").unlink()
        file.write_text((file.read_text() + "resolution: [40, 30]\n").replace(*change))
        return folder / "MH_01"

    return make


def matrix(content: str) -> Any:
    """Good images with this `camera-intrinsics.txt`."""

    def make(folder: Path) -> Path:
        bad.frames(folder / "frames", calibration=None)
        (folder / "frames/camera-intrinsics.txt").write_text(content)
        return folder / "frames"

    return make


def poses(content: str) -> Any:
    """A 7-Scenes folder with one pose file like this."""

    def make(folder: Path) -> Path:
        tiny.seven_scenes(folder / "seq-01")
        (folder / "seq-01/frame-000002.pose.txt").write_text(content)
        return folder / "seq-01"

    return make


def cut_video(folder: Path) -> Path:
    """Two thirds of a video."""
    whole = bad.video(folder / "clip.mp4").read_bytes()
    (folder / "clip.mp4").write_bytes(whole[: len(whole) * 2 // 3])
    return folder / "clip.mp4"


def lines(file: str, text: str) -> Any:
    """A TUM folder with this list."""
    return bad.rgbd(bad.write(file, text))


def empty(folder: Path) -> Path:
    """A folder without files."""
    (folder / "a").mkdir()
    return folder / "a"


def spoilt(layout: Callable[[Path], Path], name: str, content: str) -> Callable[[Path], Path]:
    """A recording in this layout, of which one file holds something else."""

    def make(folder: Path) -> Path:
        (layout(folder / "room") / name).write_text(content)
        return folder / "room"

    return make


def flat(folder: Path, width: int = 2000, height: int = 3) -> Path:
    """Images that are wide and low."""
    for row in range(3):
        tiny.write_image(folder / f"frames/{row}.png", bad.picture(row, width, height))
    return folder / "frames"


def windows_list(folder: Path) -> None:
    """A list as Windows writes text."""
    (folder / "rgb.txt").write_bytes(b"\xef\xbb\xbf" + (folder / "rgb.txt").read_bytes().replace(b"\n", b"\r\n"))


def wide_list(folder: Path) -> None:
    """A list as spreadsheets and PowerShell write text."""
    (folder / "rgb.txt").write_bytes((folder / "rgb.txt").read_text().replace("\n", "\r\n").encode("utf-16"))


def cut_problem(folder: Path) -> Path:
    """The first bytes of a problem file."""
    return bad.file("problem.npz", bad.problem()(folder).read_bytes()[:900])(folder)


IMAGES = rows(
    "Images",
    [
        ("no bytes", bad.with_image(lambda: b"")),
        ("half a PNG", bad.with_image(lambda: bad.encoded(".png")[:2000])),
        ("half a JPEG", bad.with_image(lambda: bad.cut_jpeg()[:-2], ".jpg")),
        ("half a JPEG with an end mark", bad.with_image(bad.cut_jpeg, ".jpg")),
        (
            "a JPEG with three bytes before its end mark, as some cameras write it",
            bad.with_image(lambda: bad.encoded(".jpg")[:-2] + b"\1\2\3\xff\xd9", ".jpg"),
        ),
        ("a header of 60000 x 60000 pixels", bad.with_image(bad.huge_png)),
        ("another size than the others", bad.with_image(lambda: bad.encoded(".png", bad.picture(1, 80, 60)))),
        ("16-bit PNG", bad.with_image(lambda: bad.encoded(".png", WIDE))),
        ("floating-point TIFF", bad.with_image(lambda: bad.encoded(".tiff", PICTURE.astype(np.float32)), ".tiff")),
        ("a JPEG that asks to be turned (EXIF)", bad.with_image(bad.turned_jpeg, ".jpg")),
        ("a link to itself", linked_to_itself),
        ("grey", bad.with_image(lambda: bad.encoded(".png", PICTURE[..., 0]))),
        ("with transparency", bad.with_image(lambda: bad.encoded(".png", np.dstack([PICTURE, PICTURE[..., 0]])))),
        ("grey at its end, whole", bad.with_image(lambda: bad.encoded(".jpg", HALF_GREY), ".jpg")),
        ("all of them damaged", lambda folder: bad.file("a/1.png", "no")(folder).parent),
        ("an empty folder", empty),
        ("a folder of other files", lambda folder: bad.file("a/notes.txt", "")(folder).parent),
        ("a single image", bad.file("a.png", bad.encoded(".png"))),
        ("a recording of Record3D, one depth damaged", spoilt(layouts.record3d, "rgbd/1.depth", "bvx2 and no more")),
        ("a damaged EXR", spoilt(layouts.record3d_exported, "depth/1.exr", "v/1")),
    ],
    call=read_frames,
)
SMALL = rows(
    "Images",
    [],
    argv=lambda made: ["run", made, "-o", made.parent / "out", "--intrinsics", "1500,1500,1000,1"],
)
DEPTH = rows(
    "Depth images",
    [
        ("16 bits in metres", bad.every_depth(lambda: np.full((tiny.HEIGHT, tiny.WIDTH), 2, np.uint16))),
        ("one pixel for a whole image", lambda folder: phone(folder, (1, 1))),
        ("8 bits", bad.every_depth(lambda: tiny.image(1)[..., 0])),
        ("all zero", bad.every_depth(lambda: np.zeros((tiny.HEIGHT, tiny.WIDTH), np.uint16))),
        ("another size than the images", bad.every_depth(lambda: tiny.depth_codes(0, 20, 15))),
        ("one that is cut off", bad.rgbd(bad.write("depth/10.104000.png", b"\x89PNG\r\n\x1a\n"))),
        ("one that is not there", bad.rgbd(lambda folder: (folder / "depth/10.104000.png").unlink())),
        ("none near in time", lines("depth.txt", "99 depth/10.104000.png\n")),
    ],
    call=read_frames,
)
OPENED: dict[str, Any] = {"call": lambda made: open_source(made, None, SlamSettings())}
"""As a run opens a sequence: a truth that cannot be read costs the comparison only."""
LISTS = rows(
    "Lists and poses",
    [
        ("`rgb.txt` without a line", lines("rgb.txt", "# nothing\n")),
        ("a word for a time", lines("rgb.txt", "now rgb/10.000000.png\n")),
        ("a file that is not there", lines("rgb.txt", "10.0 rgb/10.000000.png\n10.1 rgb/no.png\n")),
        ("times out of order", lines("rgb.txt", "10.1 rgb/10.100000.png\n10.0 rgb/10.000000.png\n")),
        ("a time twice", lines("rgb.txt", "10.0 rgb/10.000000.png\n10.0 rgb/10.100000.png\n")),
        ("UTF-16, as spreadsheets write it", bad.rgbd(wide_list)),
        ("a byte order mark and CR LF", bad.rgbd(windows_list)),
        ("truth with seven columns", lines("groundtruth.txt", "10 0 0 0 0 0 1\n"), OPENED),
        ("a pose file of 7-Scenes with NaN", poses("nan " * 16)),
        ("a pose file of 7-Scenes with nine numbers", poses("1 " * 9), OPENED),
        ("a pose file of 7-Scenes that is no rotation", poses("2 " * 12 + "0 0 0 1"), OPENED),
    ],
    call=read_frames,
)
CALIBRATION = rows(
    "Calibration",
    [
        ("words", calibrated("fx fy cx cy")),
        ("nothing", calibrated("")),
        ("three numbers", calibrated("55 55 31.5")),
        ("a focal length of 0.001", calibrated("0.001 0.001 31.5 23.5")),
        ("a lens of another kind in EuRoC's `sensor.yaml`", sensor("radial-tangential", "omni")),
        ("a `sensor.yaml` of other images", sensor("[40, 30]", "[752, 480]")),
        ("of another image size", calibrated("525 525 120 90")),
        ("commas, a byte order mark and CR LF", calibrated(b"\xef\xbb\xbf55, 55, 31.5, 23.5\r\n")),
        ("a matrix of eight numbers", matrix("1 " * 8)),
        ("a matrix that is none of intrinsics", matrix("1 2 3 4 5 6 7 8 9")),
        ("none", calibrated(None)),
    ],
    call=read_frames,
)
VIDEOS = rows(
    "Videos",
    [
        ("text", bad.file("clip.mp4", "no video")),
        ("no bytes", bad.file("clip.mp4", b"")),
        ("cut off", cut_video),
        ("zeros in its middle", bad.holed_video),
        ("text: FFmpeg draws its letters", bad.file("clip.mp4", "1305031102.175 rgb/1.png\n" * 99)),
        ("a list of other files for FFmpeg", bad.file("clip.mp4", "ffconcat version 1.0\nfile /etc/passwd\n")),
    ],
    call=read_frames,
)
CLOUDS = rows(
    "Point clouds",
    [
        ("text", bad.file("map.ply", "no cloud")),
        ("no vertices", bad.ply("format ascii 1.0\n")),
        ("fewer points than declared", bad.ply("format ascii 1.0\nelement vertex 3" + XYZ, b"1 2 3\n")),
        (
            "a header of 10^15 points",
            bad.ply("format binary_little_endian 1.0\nelement vertex 1000000000000000" + XYZ, NUL),
        ),
        ("a point that is NaN", bad.ply("format ascii 1.0\nelement vertex 1" + XYZ, b"nan 2 3\n")),
        ("20 GB of zeros", lambda folder: bad.lengthened(folder / "map.ply")),
        ("not there", lambda folder: folder / "map.ply"),
    ],
    call=PointCloud.load_ply,
)


def twice(folder: Path) -> Path:
    """A problem whose archive has two arrays of one name."""
    made = bad.problem()(folder)
    with warnings.catch_warnings(), zipfile.ZipFile(made, "a") as archive:
        warnings.simplefilter("ignore", UserWarning)
        archive.writestr("d_prior.npy", archive.read("d_prior.npy"))
    return made


def energy_of(made: Path) -> None:
    """The energy of a problem in a file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a landmark that only its depth told of
        problem, start, _ = load_problem(made)
    assert np.isfinite(energy(problem, start))


NPY = io.BytesIO()
np.save(NPY, np.zeros(9))
HUGE = {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
OBJECTS = {"descr": "|O", "fortran_order": False, "shape": (1,)}
PROBLEMS = rows(
    "`vggtgeo solve`",
    [
        ("not there", lambda folder: folder / "no.npz"),
        ("no bytes", bad.file("problem.npz", b"")),
        ("text", bad.file("problem.npz", "no problem")),
        ("cut off", cut_problem),
        ("a `.npy` named `.npz`", bad.file("problem.npz", NPY.getvalue())),
        ("a pickle", bad.file("problem.npz", pickle.dumps({"edges": 1}))),
        ("an array is missing", bad.problem(pt_weight=None)),
        ("an array of another shape", bad.problem(T_init=np.zeros((3, 4)))),
        ("an array of words", bad.problem(d_prior=lambda old: old.astype(str))),
        ("complex numbers", bad.problem(d_prior=lambda old: old.astype(complex))),
        ("a header that declares 72.8 TiB", bad.member("d_prior", HUGE)),
        ("Python objects", bad.member("d_prior", OBJECTS, pickle.dumps([1]))),
        ("a damaged header", bad.member("d_prior", None, b"\x93NUMPY\x01\0\xff\xff{{{{")),
        (
            "300 MB of one array, packed into 0.3 MB",
            bad.member("d_prior", {**HUGE, "shape": (4 * 10**7,)}, bytes(32 * 10**7)),
            {"slack": 5.0},
        ),
        ("an array twice", twice),
        ("`alpha` that is NaN", bad.problem(alpha=np.nan)),
        ("`alpha` of 0: no depth", bad.problem(alpha=0.0), {"call": energy_of, "argv": None}),
        ("`alpha` that is negative", bad.problem(alpha=-1.0)),
        ("`huber` that is zero", bad.problem(huber=0.0)),
        ("`huber` that is NaN", bad.problem(huber=np.nan)),
        ("a negative weight", bad.problem(pt_weight=bad.put(3, -1.0))),
        ("a weight that is NaN", bad.problem(ln_weight=bad.put(3, np.nan))),
        ("a weight that is infinite", bad.problem(d_weight=bad.put(3, np.inf))),
        ("indices that are no whole numbers", bad.problem(pt_edge=lambda old: old + 0.5)),
        ("an index out of range", bad.problem(pt_var=bad.put(0, 10**6))),
        ("a negative index", bad.problem(var_kf=bad.put(0, -1))),
        ("an edge from a keyframe to itself", bad.problem(edges=lambda old: np.vstack([old, [[1, 1]]]))),
        ("an edge twice", bad.problem(edges=lambda old: np.vstack([old, old[:1]]))),
        ("a keyframe that nothing observes", bad.without_keyframe(2)),
        ("no weight that is positive", bad.problem(**dict.fromkeys(WEIGHTS, np.zeros_like))),
        (
            "a landmark that nothing observes",
            bad.problem(d_weight=np.zeros_like, pt_weight=bad.put(slice(0, 6), 0.0)),
            LOADED,
        ),
        ("no landmark", bad.problem(**dict.fromkeys(LISTED, lambda old: old[:0]))),
        ("no keyframe", bad.problem(T_init=lambda old: old[:0])),
        ("a quaternion of length zero", bad.problem(T_init=bad.put((1, slice(0, 4)), 0.0))),
        ("a pose with NaN", bad.problem(T_init=bad.put((1, 5), np.nan))),
        ("intrinsics with NaN", bad.problem(k_init=bad.put(0, np.nan))),
        ("a negative focal length", bad.problem(k_init=bad.put(0, -500.0))),
        ("a prior's deviation that is zero", bad.problem(k_prior_sigma=bad.put(0, 0.0))),
        ("a prior's deviation whose square is zero", bad.problem(k_prior_sigma=bad.put(0, 1e-200))),
        ("a depth that is negative", bad.problem(d_init=bad.put(0, -1.0))),
        ("a depth that is NaN", bad.problem(d_init=bad.put(0, np.nan))),
        ("a depth prior that is NaN", bad.problem(d_prior=bad.put(0, np.nan))),
        ("a depth prior's deviation that is zero", bad.problem(d_sigma=bad.put(0, 0.0))),
        ("a line whose normal is no unit vector", bad.problem(ln_abc=lambda old: 3 * old)),
        ("a target that is infinite", bad.problem(pt_target=bad.put((0, 0), np.inf))),
        ("targets beyond all numbers", bad.problem(pt_target=lambda old: old + 1e200), {"slack": 20.0}),
        ("unknown arrays beside the known ones, whatever they declare", bad.member("unknown", HUGE), LOADED),
        (
            "saved: a class of a stranger",
            bad.saved(header=lambda old: old["classes"][0].__setitem__(0, "os:system")),
        ),
        ("saved: another version", bad.saved(header=lambda old: old.update(version=99))),
        ("saved: a description that is no JSON", bad.saved(header=lambda old: "{")),
        ("saved: nine hundred brackets", bad.saved(header=bad.nested)),
        ("saved: an array is missing", bad.saved(lambda old: old.pop("problem.terms[0].target"))),
        ("saved: a weight that is NaN", bad.saved(lambda old: old["problem.terms[0].weight"].fill(np.nan))),
        ("saved: an edge to a keyframe that is not there", bad.saved(lambda old: old["problem.edges.target"].fill(99))),
        (
            "saved: an array of matches that was cut",
            bad.saved(lambda old: old.update({"problem.terms[0].target": old["problem.terms[0].target"][:-1]})),
        ),
        (
            "saved: places of edges that are not theirs",
            bad.saved(
                lambda old: old.update({"problem.edges.index_at_host": old["problem.edges.index_at_host"] + 10**6})
            ),
        ),
        ("saved: two landmarks at one place", bad.saved(lambda old: old["index.slot"].fill(0))),
        (
            "saved: a parameter that the camera has not",
            bad.saved(lambda old: old["problem.terms[3].index"].fill(99)),
        ),
        (
            "saved: a kernel without width",
            bad.saved(lambda old: old.update({"problem.terms[0].kernel.delta": np.array(-1.0)})),
        ),
        ("saved: edges from a keyframe to itself", bad.saved(lambda old: old["problem.edges.target"].fill(0))),
        ("saved: a match that is NaN", bad.saved(lambda old: old["problem.terms[0].target"].fill(np.nan))),
        ("saved: poses with NaN", bad.saved(lambda old: old["state.poses.wxyz_xyz"].fill(np.nan))),
    ],
    argv=solve_with(),
    slack=3.0,
)
ARGUMENTS = rows(
    "`vggtgeo solve`",
    [
        ("`--max-steps 0`", bad.problem(), {"argv": solve_with("--max-steps", "0")}),
        (
            "`--dtype float32` of a number beyond it",
            bad.problem(pt_target=bad.put((1, 0), 1e60)),
            {"argv": solve_with("--dtype", "float32"), "slack": 20.0},
        ),
        ("`--dtype float16`", bad.problem(), {"argv": solve_with("--dtype", "float16")}),
        ("`--repeat 0`", bad.problem(), {"argv": solve_with("--repeat", "0")}),
    ],
)
FILES: list[Row] = [*IMAGES, *SMALL, *DEPTH, *LISTS, *CALIBRATION, *VIDEOS, *CLOUDS, *PROBLEMS, *ARGUMENTS]
