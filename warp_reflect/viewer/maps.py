"""What maps of a scene hold, as meshes in the scene frame: what `geometry.meshes` adds where maps are looked up."""

from __future__ import annotations

import numpy as np
import pyvista as pv

from warp_reflect.cubemap import texel_directions
from warp_reflect.grid_rays import GridPlace
from warp_reflect.heightfield import HOLE
from warp_reflect.images import srgb_from_linear
from warp_reflect.scene import Scene
from warp_reflect.scene_field import SceneField
from warp_reflect.settings import Settings
from warp_reflect.techniques.layered_environment import Prepared, nearest_maps

CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))  # of a square, around it
COLUMNS_SHOWN = 1 << 20  # more than a screen has pixels


def reference_mesh(scene: Scene, prepared: list[tuple[Prepared, Settings]]) -> pv.PolyData:
    """The places of a scene's reference maps as points; `map` is the number, `mirrors` how many blend it."""
    references = prepared[0][0].references
    mesh = pv.PolyData(references.maps.centres - scene.origin)
    mesh.point_data["map"] = np.arange(references.maps.count, dtype=np.int32)
    mirrors = np.zeros(references.maps.count, np.int32)
    for each, settings in prepared:
        mirrors[nearest_maps(references, each.centre, settings.rem_count)] += 1
    mesh.point_data["mirrors"] = mirrors
    return mesh


def local_mesh(scene: Scene, prepared: Prepared, ratio: float) -> pv.PolyData:
    """The adaptive mesh of a local map, its nodes where their rays met the scene (Meyer and Loscos 2003, figure 7).

    Cells, but those that see sky: `rgb` at their first node, `size` in texels, `face`, `torn` where the depths of their
    corners are apart by more than `ratio` (a silhouette goes through); points: `distance` from the centre.
    """
    maps, cells = prepared.local, prepared.cells
    n = maps.resolution
    distance = maps.distance(0)
    directions = texel_directions(n)
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    face, y, x, size = cells.T
    corner = [(face, np.minimum(y + dy * size, n - 1), np.minimum(x + dx * size, n - 1)) for dx, dy in CORNERS]
    far = np.stack([distance[at] for at in corner], 1)
    kept = (far > 0.0).all(axis=1)
    if not kept.any():
        return pv.PolyData()
    nodes, place = np.unique(np.stack([(f * n + j) * n + i for f, j, i in corner], 1)[kept], return_inverse=True)
    reach = distance.reshape(-1)[nodes]
    towards = directions.reshape(-1, 3)[nodes] @ maps.axes[0].T
    points = prepared.centre - scene.origin + reach[:, None] * towards
    faces = np.column_stack([np.full(int(kept.sum()), 4), place.reshape(-1, 4)])
    mesh = pv.PolyData(points.astype(np.float32), faces.reshape(-1))
    color = np.clip(maps.radiance(0)[corner[0]][kept, :3], 0.0, 1.0)
    mesh.cell_data["rgb"] = (255.0 * srgb_from_linear(color) + 0.5).astype(np.uint8)
    mesh.cell_data["size"], mesh.cell_data["face"] = size[kept], face[kept]
    mesh.cell_data["torn"] = (far.max(axis=1) > (1.0 + ratio) * far.min(axis=1))[kept].astype(np.uint8)
    mesh.point_data["distance"] = reach
    mesh.field_data["centre"] = prepared.centre - scene.origin
    return mesh


def field_mesh(field: SceneField) -> pv.PolyData:
    """The roofs of a field's columns, or the tops of what is solid in its cells, a square each; cells: `height`."""
    if field.kind == "heightfield":
        grid = field.grid
        heights = grid.view.heights.numpy()[: grid.nx * grid.ny].reshape(grid.ny, grid.nx)
        y, x = np.nonzero(heights > HOLE)
        top = heights[y, x]
    else:
        nx, ny, nz = field.grid.shape
        index = field.grid.view.index.numpy().reshape(nz, ny, nx)
        z, y, x = np.nonzero(index >= 0)
        top = field.grid.view.spans.numpy()[index[z, y, x], 1]
    stride = -(-len(top) // COLUMNS_SHOWN) if len(top) else 1
    return _squares(field.grid.view.place, x[::stride], y[::stride], top[::stride])


def _squares(place: GridPlace, x: np.ndarray, y: np.ndarray, top: np.ndarray) -> pv.PolyData:
    """Level squares over columns, `top` in cells above the corner."""
    if not len(top):
        return pv.PolyData()
    grid = np.stack([np.stack([x + dx, y + dy, top], 1) for dx, dy in CORNERS], 1).reshape(-1, 3).astype(np.float64)
    points = np.empty_like(grid)
    points[:, [0, 3 - place.up, place.up]] = place.cell * grid
    points += np.array(place.corner)
    faces = np.column_stack([np.full(len(top), 4), np.arange(4 * len(top)).reshape(-1, 4)])
    mesh = pv.PolyData(points.astype(np.float32), faces.reshape(-1))
    mesh.cell_data["height"] = (place.cell * top).astype(np.float32)
    return mesh
