"""The data channels of a frame: their names, and what the reflection layers put into them."""

from __future__ import annotations

import difflib

import warp as wp

from warp_reflect.launch import launch
from warp_reflect.layers import CameraView, GBuffer, ReflectionLayer, eye_ray_origin
from warp_reflect.optics import specular_residual
from warp_reflect.scene import Scene, SceneView
from warp_reflect.settings import Status

wp.set_module_options({"enable_backward": False})

CONVERGED = wp.constant(int(Status.CONVERGED))

# Group name to its components ("" for a single channel of the group's own name).
CHANNELS = {
    "RGBA": ("R", "G", "B", "A"),
    "Z": ("",),
    "N": (".X", ".Y", ".Z"),
    "primId": ("",),
    "reflectorId": ("",),
    "reflectedId": ("",),
    "reflection": (".R", ".G", ".B"),
    "mirrorPoint": (".X", ".Y", ".Z"),
    "reflectedPoint": (".X", ".Y", ".Z"),
    "pathLength": ("",),
    "reflectionMotion": (".X", ".Y"),
    "residual": ("",),
    "status": ("",),
    "method": ("",),
}
# What others call our channels: Hydra's and UsdRender's usual names, and those of Omniverse's renderer.
ALIASES = {
    "color": "RGBA",
    "Ci": "RGBA",
    "beauty": "RGBA",
    "rgba": "RGBA",
    "LdrColor": "RGBA",
    "HdrColor": "RGBA",
    "a": "A",
    "alpha": "A",
    "depth": "Z",
    "z": "Z",
    "DepthSD": "Z",
    "DistanceToImagePlaneSD": "Z",
    "normal": "N",
    "normals": "N",
    "NormalSD": "N",
}
POINTS = ("mirrorPoint", "reflectedPoint")  # world points, known relative to the eye


@wp.kernel
def reflection_channels_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    method: int,
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    # Layer:
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    distance: wp.array(dtype=float),
    status: wp.array(dtype=wp.uint8),
    on_ray: int,
    # Outputs:
    out_mirror_point: wp.array(dtype=wp.vec3),
    out_reflected_point: wp.array(dtype=wp.vec3),
    out_reflected_id: wp.array(dtype=float),
    out_path_length: wp.array(dtype=float),
    out_residual: wp.array(dtype=float),
    out_status: wp.array(dtype=float),
    out_method: wp.array(dtype=float),
):
    """One thread per mirror pixel of a layer; points relative to the eye."""
    i = first + wp.tid()
    p = pixel[i]
    row = p / camera[0].width
    mirror = point[i] - camera[0].eye
    out_mirror_point[p] = mirror
    out_status[p] = float(int(status[i]))
    out_method[p] = float(method)
    if triangle[i] < 0:
        return
    reflected = mirror + distance[i] * direction[i]
    if on_ray == 0:
        # What is shown is not what the reflected ray meets.
        corners = scene.triangles[triangle[i]]
        weight = 1.0 - u[i] - v[i]
        shown = weight * scene.points[corners[0]] + u[i] * scene.points[corners[1]] + v[i] * scene.points[corners[2]]
        reflected = shown - camera[0].eye
    origin = eye_ray_origin(camera[0], float(p - row * camera[0].width) + 0.5, float(row) + 0.5)
    out_reflected_point[p] = reflected
    out_reflected_id[p] = float(scene.patches[scene.triangle_patch[triangle[i]]].prim)
    out_path_length[p] = wp.length(mirror - origin) + wp.length(reflected - mirror)
    out_residual[p] = specular_residual(mirror, normal[i], origin, reflected)


def reflection_channels(
    scene: Scene,
    gbuffer: GBuffer,
    layers: dict[int, ReflectionLayer],
    threads: int = 0,
    unrefined: frozenset[int] = frozenset(),
) -> dict[str, wp.array]:
    """The channels of all layers on the scene's device, 0 where there is no reflection.

    Args:
        unrefined: Reflectors whose pixels show the virtual triangle drawn there, whether the reflected ray meets it or not.

    Returns:
        `mirrorPoint`, `reflectedPoint` vec3 [height * width], relative to the eye, world axes, scene units;
        `reflectedId`, `pathLength`, `residual`, `status`, `method` float32 [height * width].
    """
    width, height = gbuffer.camera.size
    device = scene.device
    points = {name: wp.zeros(width * height, dtype=wp.vec3, device=device) for name in POINTS}
    names = ("reflectedId", "pathLength", "residual", "status", "method")
    values = {name: wp.zeros(width * height, dtype=float, device=device) for name in names}
    for number, layer in layers.items():
        pixels = layer.pixels
        launch(
            reflection_channels_kernel,
            pixels.count,
            [scene.view, gbuffer.view, layer.method]
            + [pixels.pixel, pixels.point, pixels.normal, pixels.direction]
            + [layer.triangle, layer.u, layer.v, layer.distance, layer.status, int(number not in unrefined)]
            + [*points.values(), *values.values()],
            device,
            threads,
        )
    return points | values


def known_names() -> list[str]:
    """Every name that `Frame.__getitem__` accepts."""
    names = []
    for group, parts in CHANNELS.items():
        names.append(group)
        names += [_full_name(group, part) for part in parts if part]
    return names


def _full_name(group: str, part: str) -> str:
    return part if group == "RGBA" else group + part


def own_name(name: str) -> str:
    """Our name of a channel that is asked for by ours or by one of `ALIASES`.

    Raises:
        KeyError: an unknown name; the message lists the known ones, the nearest first.
    """
    name = ALIASES.get(name, name)
    component_of(name)
    return name


def component_of(name: str) -> tuple[str, int | None]:
    """(group, component index or None for the whole group) of a channel name.

    Raises:
        KeyError: an unknown name; the message lists the known ones.
    """
    if name in CHANNELS:
        return name, None
    for group, parts in CHANNELS.items():
        for k, part in enumerate(parts):
            if part and name == _full_name(group, part):
                return group, k
    near = difflib.get_close_matches(name, known_names(), n=3)
    nearest = f"nearest: {', '.join(near)}; " if near else ""
    raise KeyError(f"unknown channel '{name}'; {nearest}known: {', '.join(known_names())}")
