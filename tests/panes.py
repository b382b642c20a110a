"""Scenes in memory over a floor whose colours are its places, for what is seen through surfaces and on water."""

import dataclasses

import numpy as np
from rooms import placed, sphere, square

import warp_reflect as wr
from warp_reflect.scene import CameraData, FinishData, InstanceData, LightData, MaterialData, Scene, SceneData

GLASS = MaterialData(transmission=1.0, roughness=0.0, ior=1.5)
WATER = MaterialData(transmission=1.0, roughness=0.0, ior=1.333, finish=FinishData("/water", interface="solid"))
WHITE = MaterialData(base_color=(1.0, 1.0, 1.0), specular_workflow=True, roughness=1.0)
SIZE = (160, 90)
HALF = 8.0  # of the coded floor
EYE = placed(0.1, 0.6, 4.0)


def stage(*things, sky=1.0, floor=True, camera=EYE, projection="perspective"):
    """Things (mesh, world_from_object, material) over a floor whose radiance is its place: (x, z) scaled to 0 .. 1."""
    flat = square(1, HALF)
    where = 0.5 + 0.5 * flat.points[:, [0, 2]] / HALF
    flat.colors = np.stack([where[:, 0], where[:, 1], np.full(len(where), 0.5)], axis=1).astype(np.float32)
    flat.color_index = flat.triangles
    meshes, instances, materials = [flat], [], [dataclasses.replace(WHITE, uses_vertex_color=True)]
    if floor:
        instances.append(InstanceData(0, placed(0, -1, -3), "/floor", (0,)))
    for k, (mesh, world, material) in enumerate(things, 1):
        meshes.append(mesh)
        materials.append(material)
        instances.append(InstanceData(k, world, f"/thing{k}", (k,)))
    dome = LightData("/dome", "dome", (sky,) * 3, np.eye(4))
    eye = CameraData("/camera", camera, near=0.05, focal_length=22.0, projection=projection)
    return Scene(SceneData("coded floor", meshes, instances, materials, [dome], [eye]))


def balls(seed=1):
    """Coloured ones above the floor, in front of and behind what is at z = 1."""
    rng = np.random.default_rng(seed)
    plain = dataclasses.replace(sphere(), parts=[])
    return [
        (
            plain,
            placed(rng.uniform(-3, 3), rng.uniform(0.3, 1.5), rng.uniform(-6, 1), 0.3),
            MaterialData(base_color=tuple(rng.uniform(0.1, 0.9, 3)), roughness=1.0),
        )
        for _ in range(12)
    ]


def frame(scene, size=SIZE, previous=None, **settings):
    return wr.render_frame(scene, wr.make_plan(scene, size=size, settings=wr.Settings(**settings)), previous=previous)


def upright(z, half=1.0):
    """A pane that faces +Z."""
    world = np.eye(4)
    world[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    world[2, 3] = z
    return square(1, half), world


def with_finish(material, **values):
    return dataclasses.replace(material, finish=dataclasses.replace(material.finish or FinishData("/asked"), **values))


def eye_rays(camera):
    """(origin, unit directions [height, width, 3])."""
    width, height = camera.size
    x = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    y = -(np.arange(height) + 0.5 - camera.cy) / camera.fy
    d = camera.forward + x[None, :, None] * camera.right + y[:, None, None] * camera.up
    return camera.eye, d / np.linalg.norm(d, axis=2, keepdims=True)


def shown_places(picture, mask):
    """(x, z) of the coded floor that a picture shows where nothing but it is seen; 0 elsewhere."""
    # The floor's blue is 0.5 everywhere: the share of the light that got through.
    share = 2.0 * np.where(mask, picture[..., 2], 0.5)
    places = np.where(mask[..., None], (picture[..., :2] / share[..., None] - 0.5) * 2.0 * HALF, 0.0)
    return places - np.array([0.0, 3.0]) * mask[..., None]


def floor_error_px(picture, expected, mask):
    """How far the floor's points shown are from the expected ones, in pixels: by how the expected ones change."""
    step = [np.linalg.norm(np.gradient(expected, axis=k), axis=2) for k in (0, 1)]
    # An axis along which the floor is stretched out least counts: distances over it are the most pixels.
    return (np.linalg.norm(shown_places(picture, mask) - expected, axis=2) / np.minimum(*step))[mask]
