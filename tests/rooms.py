"""Small scenes in memory: a mirror over a floor with balls around it."""

import dataclasses

import numpy as np

import warp_reflect as wr
from warp_reflect.scene import CameraData, InstanceData, MaterialData, MeshData, Part, Patch, Scene, SceneData, Shape

CHROME = MaterialData(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)


def placed(x, y, z, scale=1.0):
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = x, y, z
    return matrix


def sphere(rows=24, columns=48):
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    points = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    points[0], points[-1] = [0, 1, 0], [0, -1, 0]
    points = points.reshape(-1, 3)
    i = np.arange(rows * columns)
    a, b = i, i // columns * columns + (i + 1) % columns
    faces = np.concatenate([np.stack([a, b, a + columns], 1), np.stack([b, b + columns, a + columns], 1)])
    p = points[faces]
    faces = faces[np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) > 1e-9]
    return MeshData(
        points.astype(np.float32),
        faces.astype(np.int32),
        points.astype(np.float32),
        parts=[Part(0, len(faces), patches=(Patch(0, len(faces), Shape("quadric", np.eye(4), 1.0, 0.0, 1.0)),))],
    )


def square(cells, half):
    u, v = np.meshgrid(np.linspace(-half, half, cells + 1), np.linspace(-half, half, cells + 1), indexing="ij")
    points = np.stack([v, 0 * u, u], -1).reshape(-1, 3)
    i = np.arange(cells * cells)
    a = i // cells * (cells + 1) + i % cells
    below = a + cells + 1
    faces = np.concatenate([np.stack([a, below, a + 1], 1), np.stack([a + 1, below, below + 1], 1)])
    return MeshData(points.astype(np.float32), faces.astype(np.int32), double_sided=True)


def room(mirror, mirror_at, floor_cells=12):
    """A mirror over a floor with balls around it; the camera looks down -Z."""
    plain = dataclasses.replace(sphere(), parts=[])
    instances = [InstanceData(0, mirror_at, "/mirror", (0,)), InstanceData(1, placed(0, -1, 0), "/floor", (1,))]
    rng = np.random.default_rng(0)
    for k in range(10):
        x, z = rng.uniform(-3, 3, 2)
        instances.append(InstanceData(2, placed(x, rng.uniform(-0.5, 1.5), z + 2, 0.3), f"/ball{k}", (1,)))
    return Scene(
        SceneData(
            "room",
            [mirror, square(floor_cells, 6.0), plain],
            instances,
            [CHROME, MaterialData()],
            [],
            [CameraData("/camera", placed(0.1, 0.3, 4.0), near=0.05, focal_length=22.0)],
        )
    )


def render(scene, method, previous=None, size=(160, 90), camera=None, **settings):
    plan = wr.make_plan(scene, size=size, settings=wr.Settings(**settings), method=method)
    return wr.render_frame(scene, plan, camera=camera, previous=previous)


def identical(a, b):
    comparison = wr.compare_frames(a, b)
    assert comparison.interior_pixels > 500
    return comparison.share(comparison.identical)


def plane_room():
    """A wall-sized plane at z = -2 that faces +Z."""
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    turn[2, 3] = -2.0
    return room(square(2, 2.5), turn)
