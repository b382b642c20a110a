"""Arrays of any library in and out of the bare solvers: NumPy, Warp, and all with DLPack."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp


@dataclass
class Given:
    """Points on the device, and the way back to what they came from."""

    array: wp.array  # vec3 or vec3d [n]
    shape: tuple[int, ...]  # of the points as given, without the last axis
    library: Any  # None: NumPy; "warp_vectors", "warp_floats"; else a module with from_dlpack

    def give_back(self, array: wp.array, shape: tuple[int, ...]):
        """An answer in the type and library of the points, `shape` without the last axis of vectors."""
        shape = (*shape, *array.shape[1:])
        if self.library is None:
            result = array.numpy()
            return result.reshape((*shape, *result.shape[array.ndim :]))
        shape = shape or (1,)
        if self.library == "warp_vectors" or array.dtype not in (wp.vec3, wp.vec3d):
            result = array.reshape(shape)
        else:
            result = _as_floats(array, shape if self.shape or len(shape) > 1 else ())
        return result if isinstance(self.library, str) else self.library.from_dlpack(result)


def _as_floats(array: wp.array, shape: tuple[int, ...]) -> wp.array:
    """The same memory as floats, with a last axis of 3."""
    scalar = wp.float64 if array.dtype is wp.vec3d else wp.float32
    result = wp.array(ptr=array.ptr, dtype=scalar, shape=(*shape, 3), device=array.device)
    result._owner = array  # the memory lives as long as either
    return result


def _as_vectors(array: wp.array, name: str) -> wp.array:
    """A Warp array of vec3, vec3d, float32 or float64 as a flat array of vectors."""
    if array.dtype in (wp.vec3, wp.vec3d):
        return array.contiguous().flatten()
    vector = {wp.float32: wp.vec3, wp.float64: wp.vec3d}.get(array.dtype)
    if vector is None:
        raise TypeError(f"{name}: got a Warp array of {array.dtype.__name__}, expected vec3, vec3d or floats")
    if array.shape[-1] != 3:
        raise ValueError(f"{name}: got shape {tuple(array.shape)}, expected a last axis of 3")
    whole = array.contiguous()
    result = wp.array(ptr=whole.ptr, dtype=vector, shape=(whole.size // 3,), device=whole.device)
    result._owner = whole
    return result


def points_to_device(points, name: str, device) -> Given:
    """Points of any library as a flat array of vectors on a device.

    Args:
        points: [..., 3]: a Warp array, an array with DLPack, or what NumPy makes an array of.
        name: Of the function and its argument, for messages.
        device: Warp device for arrays of the host.

    Raises:
        ValueError: a last axis other than 3.
        TypeError: no numbers.
    """
    if isinstance(points, wp.array):
        vectors = points.dtype in (wp.vec3, wp.vec3d)
        shape = tuple(points.shape if vectors else points.shape[:-1])
        return Given(_as_vectors(points, name), shape, "warp_vectors" if vectors else "warp_floats")
    if hasattr(points, "__dlpack__") and not isinstance(points, np.ndarray):
        if getattr(points, "requires_grad", False):
            points = points.detach()
        if hasattr(points, "__array_namespace__"):
            library = points.__array_namespace__()
        else:
            library = sys.modules[type(points).__module__.partition(".")[0]]
        array = wp.from_dlpack(points)
        return Given(_as_vectors(array, name), tuple(array.shape[:-1]), library)
    host = _host_array(points, name)
    vector = wp.vec3 if host.dtype == np.float32 else wp.vec3d
    flat = np.ascontiguousarray(host.reshape(-1, 3))
    return Given(wp.array(flat, dtype=vector, device=device, copy=False), host.shape[:-1], None)


def _host_array(values, name: str) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{name}: got numbers of type {array.dtype}, expected floats")
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.float32 if array.dtype == np.float16 else np.float64)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(f"{name}: got shape {array.shape}, expected a last axis of 3")
    return array


def host_vectors(eye, name: str) -> np.ndarray:
    """The eye or eyes as float64 on the host, [3] or [m, 3].

    Raises:
        ValueError: another shape.
        TypeError: no numbers.
    """
    if isinstance(eye, wp.array):
        eye = eye.numpy()
    elif hasattr(eye, "__dlpack__") and not isinstance(eye, np.ndarray):
        eye = wp.from_dlpack(eye.detach() if getattr(eye, "requires_grad", False) else eye).numpy()
    array = _host_array(eye, name).astype(np.float64)
    if array.ndim > 2:
        raise ValueError(f"{name}: got shape {array.shape}, expected [3] or [m, 3]")
    return array
