"""Compile kernels before they are needed: those that a stage's frames launch, or all there are."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter

import warp as wp

from warp_reflect import launch, vector
from warp_reflect.frame import render_frame
from warp_reflect.kernels import modules_of
from warp_reflect.planner import Plan
from warp_reflect.scene import Scene

PACKAGE = Path(__file__).parent


def warm_plan(scene: Scene, make_plan: Callable[[], Plan]) -> tuple[Plan, list[str], float]:
    """Plan, make a first frame, one that follows it, and all their channels.

    Args:
        scene: The scene.
        make_plan: Plans it; what the plan looks at is drawn for it, and not again for the frame.

    Returns:
        (the plan, names of the kernel modules that all this launches, seconds of loading and compiling).
    """
    before = launch.loading_ms()
    with launch.recorded() as launches:
        plan, frame = make_plan(), None
        for _ in range(2):
            frame = render_frame(scene, plan, previous=frame)
            for channel in frame.keys():
                frame.device_array(channel)
    names = sorted({name.rpartition(".")[0] for name, _ in launches})
    return plan, names, (launch.loading_ms() - before) / 1000.0


def warm_all(device: wp.DeviceLike, threads: int = 0) -> tuple[list[str], float]:
    """Compile every kernel module of the package, several at a time.

    Args:
        device: Where they are to run.
        threads: Modules compiled at a time for CUDA; 0: one per core.

    Returns:
        (names of the modules, seconds).
    """
    start = perf_counter()
    device = wp.get_device(device)
    names = [name for name in kernel_modules() if not name.endswith("_vector") or _runs_vectors(device)]
    modules = [module for name in names for module in modules_of(name)]
    if device.is_cpu:
        for loading in launch.ready(modules, device):
            loading.result()
    else:
        workers = launch.thread_count("cpu", threads)
        wp.force_load(device, modules, block_dim=launch.CUDA_BLOCK_DIM, max_workers=workers)
    return names, perf_counter() - start


def kernel_modules() -> Iterator[str]:
    """Names of the package's modules that define kernels, without importing them."""
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text()
        if "wp.kernel" not in text:  # most: a text is searched in no time, and parsed in 10 ms
            continue
        functions = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef))
        if any(ast.unparse(mark).startswith("wp.kernel") for each in functions for mark in each.decorator_list):
            yield ".".join((PACKAGE.name, *path.relative_to(PACKAGE).with_suffix("").parts))


def _runs_vectors(device: wp.Device) -> bool:
    return device.is_cpu and not vector.missing()
