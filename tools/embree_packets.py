"""Embree as a C++ program drives it: packets of 16 rays, on any number of threads, for `peers.py`.

`embree_packets.cpp` is built by the machine's C++ compiler where Embree 3 and its headers are installed (Debian:
libembree-dev). Embree itself is built by its distributor: `native` says whether it has packets of 16 for this processor.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from functools import cache
from pathlib import Path

import numpy as np
from wavefronts import NOTHING, RAY_STEP

SOURCE = Path(__file__).with_suffix(".cpp")
FLAGS = "-std=c++17", "-O3", "-march=native", "-shared", "-fPIC", "-pthread"


class _Camera(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_float * 3) for name in ("eye", "forward", "right", "up")),
        *((name, ctypes.c_float) for name in ("cx", "cy")),
        *((name, ctypes.c_int) for name in ("width", "height", "orthographic")),
    )


@cache
def built() -> tuple[ctypes.CDLL | None, str]:
    """(the library, "") or (None, why there is none)."""
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        return None, "no C++ compiler was found"
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "embree_packets.so"
        command = [compiler, *FLAGS, str(SOURCE), "-o", str(made), "-lembree3"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            fault = next((line for line in done.stderr.splitlines() if "error" in line or "cannot find" in line), "")
            return None, f"{fault.strip() or 'it cannot be built'}; install Embree 3 with its headers (libembree-dev)"
        library = ctypes.CDLL(str(made))
    library.peer_open.restype = ctypes.c_void_p
    return library, ""


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


class Packets:
    """A frame's eye rays and mirror rays by Embree's packets: hits, no shading.

    Args:
        wavefront: `wavefronts.Wavefront` of the same frame, which knows its mirrors and their normals.
        threads: CPU threads.

    Raises:
        RuntimeError: Embree, its headers or a compiler are missing.
    """

    def __init__(self, wavefront, threads: int):
        self._library, fault = built()
        if fault:
            raise RuntimeError(fault)
        scene, frame = wavefront.source, wavefront.frame
        camera = frame.camera
        self.threads, self._wavefront = threads, wavefront
        self._step = ctypes.c_float(RAY_STEP * scene.size)
        vectors = (camera.eye - scene.origin, camera.forward, camera.right / camera.fx, camera.up / camera.fy)
        self._camera = _Camera(
            *(tuple(float(x) for x in vector) for vector in vectors),
            camera.cx,
            camera.cy,
            *camera.size,
            camera.orthographic,
        )
        self.triangle = np.full(camera.size[0] * camera.size[1], NOTHING, np.int32)
        quadric_of_patch = np.full(len(scene.patch_shapes), -1, np.int32)
        quadric_of_patch[list(wavefront.quadric_rows)] = np.arange(len(wavefront.quadric_rows))
        rows = list(wavefront.quadric_rows.values())
        arrays = (
            np.ascontiguousarray(scene.host_points, np.float32),
            np.ascontiguousarray(scene.host_triangles, np.int32),
            np.ascontiguousarray(scene.host_normals, np.float32),
            np.ascontiguousarray(scene.host_normal_index, np.int32),
            wavefront.mirror_patch,
            np.asarray(rows, np.float32).reshape(len(rows), 14),
            quadric_of_patch,
        )
        points, triangles, normals, index, mirror, quadrics, of_patch = arrays
        self._peer = ctypes.c_void_p(
            self._library.peer_open(
                *(_address(points), len(points), _address(triangles), len(triangles), _address(normals), len(normals)),
                *(
                    _address(index),
                    _address(mirror),
                    _address(quadrics),
                    len(quadrics),
                    _address(of_patch),
                    len(of_patch),
                ),
            )
        )
        self.native = bool(self._library.peer_has_packets(self._peer))

    def rebuild(self) -> float:
        """Milliseconds of the tree, made anew."""
        start = time.perf_counter()
        self._library.peer_build(self._peer)
        return 1000.0 * (time.perf_counter() - start)

    def trace(self) -> float:
        """Milliseconds of both kinds of rays."""
        start = time.perf_counter()
        self._library.peer_trace(
            self._peer, ctypes.byref(self._camera), self._step, self.threads, _address(self.triangle)
        )
        return 1000.0 * (time.perf_counter() - start)

    def agreement(self) -> float:
        """Share of the reference's mirror pixels with its triangle."""
        return self._wavefront.share(self.triangle)

    def close(self) -> None:
        """Give Embree's memory back."""
        if self._peer:
            self._library.peer_close(self._peer)
            self._peer = None
