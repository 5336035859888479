"""The fused map: mesh and cloud of depth maps of a sphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from posed_keyframes import keyframe_of, slots_of
from scipy.spatial.transform import Rotation

from vggtgeo.evaluation import surface_points
from vggtgeo.geometry import rigid
from vggtgeo.geometry.mesh import Mesh
from vggtgeo.io.errors import InputError
from vggtgeo.mapping.cloud import map_points
from vggtgeo.mapping.depth_fusion import SurfaceFusion
from vggtgeo.mapping.depth_map import DepthMap
from vggtgeo.mapping.tsdf import merge_meshes
from vggtgeo.slam.sparse_map.keyframe import Keyframe

RADIUS, AWAY, VOXEL = 0.5, 2.0, 0.04
INTRINSICS = np.array([200.0, 200.0, 59.5, 59.5])
SHAPE = (120, 120)


def sphere_views(noise: float = 0.0) -> tuple[list[Keyframe], list[DepthMap]]:
    """Fourteen cameras around a sphere at the origin, with its exact depth but for noise."""
    rng, keyframes, depth_maps = np.random.default_rng(0), [], []
    x, y = np.meshgrid((np.arange(120) - 59.5) / 200, (np.arange(120) - 59.5) / 200)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    square = (rays**2).sum(-1)
    inside = AWAY**2 - square * (AWAY**2 - RADIUS**2)
    depth = np.where(inside > 0, (AWAY - np.sqrt(np.maximum(inside, 0))) / square, np.nan)
    for number, turn in enumerate(_around()):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, [0, 0, AWAY]
        image = np.full((*SHAPE, 3), [200, 100, 10 * number], np.uint8)
        noisy = (depth + noise * rng.normal(size=SHAPE)).astype(np.float32)
        keyframes.append(keyframe_of(number, image, pose, slots_of(np.zeros((0, 2)), np.zeros(0)), noisy))
        known = np.isfinite(noisy)
        sigma = np.where(known, max(noise, 0.002) / AWAY, np.nan).astype(np.float32)
        depth_maps.append(DepthMap(noisy, sigma, known.astype(np.float32)))
    return keyframes, depth_maps


def _around() -> list[np.ndarray]:
    """Rotations that bring the faces, edges and corners of a cube before the camera, 26 in all."""
    steps = (-1.0, 0.0, 1.0)
    directions = [np.array([x, y, z]) for x in steps for y in steps for z in steps if x or y or z]
    return [Rotation.align_vectors([[0.0, 0.0, -1.0]], [direction])[0].as_matrix() for direction in directions]


def fused(
    keyframes: list[Keyframe], depth_maps: Sequence[DepthMap | None], voxel: float = VOXEL, min_views: int = 2
) -> Mesh:
    """The mesh of all views at once."""
    fusion = SurfaceFusion(INTRINSICS, voxel, min_views)
    fusion.update(keyframes, depth_maps)
    return fusion.mesh


def test_the_mesh_is_the_sphere() -> None:
    # Proves that noisy views fuse to a closed surface (each edge has two faces, also where blocks meet), within a
    # quarter of a voxel of the truth on average, with outward normals and faces, and the colours seen. Oracle: the
    # sphere.
    mesh = fused(*sphere_views(noise=0.01))
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - RADIUS).mean() < 0.25 * VOXEL
    assert np.abs(radius - RADIUS).max() < 1.5 * VOXEL
    edges = np.sort(np.concatenate([mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).mean() > 0.995
    outward = mesh.vertices / radius[:, None]
    assert ((mesh.normals * outward).sum(1) > 0.7).mean() > 0.99
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((across * corners.mean(axis=1)).sum(1) > 0).mean() > 0.99
    assert (mesh.colours[:, 0] == 200).all()
    found = surface_points((mesh.vertices, mesh.faces), 0.025)
    assert np.abs(np.linalg.norm(found, axis=1) - RADIUS).mean() < 0.25 * VOXEL
    assert np.abs(found.mean(axis=0)).max() < 0.05 * RADIUS  # even: no side has more points than another


def moved(keyframe: Keyframe, metres: float) -> Keyframe:
    """The keyframe with its camera moved along its own optical axis."""
    pose = keyframe.pose.copy()
    pose[2, 3] += metres
    return replace(keyframe, pose=pose)


def away(keyframe: Keyframe, number: int) -> Keyframe:
    """The keyframe of that number, whose camera and all that it sees are 10 m along the world's x."""
    pose = keyframe.pose.copy()
    pose[:3, 3] -= pose[:3, :3] @ [10.0, 0, 0]
    return replace(keyframe, number=number, pose=pose)


@pytest.mark.long
def test_what_moved_is_fused_again_and_nothing_else() -> None:
    """A map with one view two voxels off, which dents the sphere before it, is brought back when that view is put
    right, by making anew only some of its blocks; a view that moves by less than the bound costs nothing, and one that
    comes late or goes is taken in or out. Oracle: the mesh of all views at once, to the last digit.
    """
    keyframes, depth_maps = sphere_views()
    far = [away(keyframes[0], 26), away(keyframes[1], 27)]  # another sphere, 10 m away
    keyframes, depth_maps = [*far, *keyframes], [*depth_maps[:2], *depth_maps]
    first = len(far)
    wrong = [*far, moved(keyframes[first], 2 * VOXEL), *keyframes[first + 1 :]]
    whole = fused(keyframes, depth_maps)
    fusion = SurfaceFusion(INTRINSICS, VOXEL, bound=0.5)
    fusion.update(wrong[:-1], depth_maps[:-1])
    fusion.update(wrong, depth_maps)
    towards = rigid.centre(keyframes[first].pose) / AWAY
    near = [mesh.vertices[np.abs(mesh.vertices).max(1) < 1] for mesh in (fusion.mesh, whole)]
    before = [vertices[vertices @ towards > 0.9 * RADIUS] for vertices in near]
    dent, sound = (np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).mean() for vertices in before)
    assert dent > 1.5 * sound, (dent, sound)
    every = SurfaceFusion(INTRINSICS, VOXEL).update(keyframes, depth_maps)
    again = fusion.update(keyframes, depth_maps)
    assert 0 < again < every, (again, every)
    same(fusion.mesh, whole)
    for metres, some in ((0.4 * VOXEL, False), (0.6 * VOXEL, True)):
        assert bool(fusion.update([moved(keyframes[0], metres), *keyframes[1:]], depth_maps)) is some
    fusion.update(keyframes[1:], depth_maps[1:])
    same(fusion.mesh, fused(keyframes[1:], depth_maps[1:]))


def same(found: Mesh, expected: Mesh) -> None:
    for name in ("vertices", "faces", "normals", "colours"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_second_view_changes_what_one_view_is_enough_for() -> None:
    """One view makes a surface alone; of two from opposite sides, both must have seen a voxel, so that next to nothing
    is left. Oracle: both fused at once.
    """
    keyframes, depth_maps = sphere_views()
    opposite = [keyframes[0], keyframes[-1]], [depth_maps[0], depth_maps[-1]]
    fusion = SurfaceFusion(INTRINSICS, VOXEL)
    fusion.update(*(part[:1] for part in opposite))
    assert len(fusion.mesh.faces)
    fusion.update(*opposite)
    same(fusion.mesh, fused(*opposite))


def test_the_mesh_of_a_building_is_joined() -> None:
    """Blocks that share vertices are joined however far others are; oracle: the parts' own vertices, counted."""
    keyframes, depth_maps = sphere_views()
    part = fused(keyframes[:4], depth_maps[:4], min_views=1)
    far = replace(part, vertices=part.vertices + np.float32([150, 120, 50]))
    whole = merge_meshes([part, far, part, far], VOXEL)
    assert len(part.vertices) > 500
    assert len(whole.vertices) == 2 * len(part.vertices)
    assert len(whole.faces) == 4 * len(part.faces)


def test_a_small_piece_is_left_out() -> None:
    # Proves that a false depth of a few pixels, apart from everything, makes no surface. Oracle: the mesh without it.
    keyframes, depth_maps = sphere_views()
    mesh = fused(keyframes, depth_maps)
    false = depth_maps[0].depth.copy()
    false[5:9, 5:9] = 1.0
    spoilt = DepthMap(false, np.full(SHAPE, 0.001, np.float32), np.isfinite(false).astype(np.float32))
    again = fused(keyframes, [spoilt, *depth_maps[1:]])
    assert np.linalg.norm(again.vertices, axis=1).max() == pytest.approx(
        np.linalg.norm(mesh.vertices, axis=1).max(), abs=VOXEL
    )


def test_the_cloud_has_outward_normals() -> None:
    # Proves that points of the cloud lie on the sphere, with normals away from its middle. Oracle: the sphere.
    keyframes, depth_maps = sphere_views()
    cloud = map_points(keyframes[6:8], INTRINSICS, depth_maps[6:8], voxel=VOXEL)
    alone = map_points(keyframes[:1], INTRINSICS, depth_maps[:1], voxel=VOXEL)
    assert len(alone) > 100
    assert len(cloud) > 50  # what both see
    for found in (cloud, alone):
        assert found.normals is not None
        np.testing.assert_allclose(np.linalg.norm(found.points, axis=1), RADIUS, atol=0.02)
        known = np.linalg.norm(found.normals, axis=1) > 0.5
        assert known.mean() > 0.7
        assert ((found.normals * found.points).sum(1)[known] > 0.8 * RADIUS).mean() > 0.95


def test_no_depth_is_no_mesh(tmp_path: Path) -> None:
    # Proves that without any depth there is an empty mesh, that a mesh comes back from its file, and the errors of what
    # cannot be a mesh. Oracle: the mesh written.
    keyframes, depth_maps = sphere_views()
    nothing = fused(keyframes, [None] * len(keyframes))
    assert len(nothing.faces) == 0
    mesh = fused(keyframes[:1], depth_maps[:1], 2 * VOXEL)
    mesh.save_ply(tmp_path / "mesh.ply")
    again = Mesh.load_ply(tmp_path / "mesh.ply")
    for name in ("vertices", "faces", "normals", "colours"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name))
    with pytest.raises(InputError, match=r"`voxel` .*0"):
        SurfaceFusion(INTRINSICS, 0.0)
    with pytest.raises(InputError, match="`faces` names vertex"):
        Mesh(mesh.vertices[:2], mesh.faces, mesh.normals[:2], mesh.colours[:2])
