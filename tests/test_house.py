"""The rules of the house: who imports whom, what `import warp_reflect` loads, what every kernel keeps to."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import warp as wp

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "warp_reflect"
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}

# A module imports from its own floor or below. A new module belongs into this table; `x.*` is a folder.
FLOORS = {
    1: "settings launch compact counts vector direct_vector hits_vector packets wide_packets wide_tree ray_tree ray_query "
    "devices optics any_hit shapes bodies topology cubemap quadrics quadric_roots quadric_curve quadric_fit heightfield "
    "heightfield_vector grid_rays occupancy voxels "
    "images metrics timing clipping cutouts",
    2: "scene scene_times at_rest reflectors environment_maps baked_maps "
    "segments layers trees ray_walk bvh raster raster_pieces raster_vector raster_rays_vector shade shade_vector surface "
    "surface_vector pictures textures holes cut_shadows "
    "normal_maps bounces direct shadow_starts shadow_neighbours shadows transmission "
    "transmission_vector waves waves_vector channels stage stage.* scene_field "
    "baked_environments shadow_starts_vector shadow_lists shadows_vector bvh_vector",
    3: "solve solver solve_device solve_plane solve_convex solve_map solve_general solve_qim solver_gradients mirrors "
    "refraction solve_refraction solver_arrays reflector_maps techniques techniques.* finishes finishes.*",
    4: "kernels planner plan_rows detail mirrored_eyes effects lighting probe budget choice applicable calibration calibrate "
    "realised bake frame captured motion virtual_objects seen sweep sweep_report",
    5: "__main__ cli warmup viewer viewer.* pipeline process progress cluster farm",
}
# Where an imported library may appear, inside functions or out.
HOMES = {
    "pxr": ("stage",),
    "OpenImageIO": ("images",),
    "pyvista": ("viewer",),
    "vtk": ("viewer",),
    "cyclopts": ("cli",),
    "rich": ("viewer", "progress"),
    "matplotlib": ("sweep_report", "viewer"),
    "trimesh": ("stage", "techniques", "viewer", "bodies", "shapes"),
    "coacd": ("techniques", "stage"),
    "dask": ("cluster",),
    "distributed": ("cluster",),
    "scipy": (),
    "embreex": ("sweep",),
    "flip_evaluator": ("sweep",),
    "MaterialX": ("stage",),
}
HEAVY = (
    "pxr",
    "OpenImageIO",
    "pyvista",
    "vtk",
    "trimesh",
    "cyclopts",
    "rich",
    "matplotlib",
    "distributed",
    "embreex",
    "flip_evaluator",
    "scipy",
    "MaterialX",
)
LINES_MAX = 900


def floor(module: str) -> int | None:
    """The floor of a module; None for the package itself, which hands out names of every floor."""
    name = module.removeprefix("warp_reflect").removeprefix(".")
    if not name:
        return None
    for number, names in FLOORS.items():
        listed = names.split()
        if name in listed or f"{name.partition('.')[0]}.*" in listed:
            return number
    pytest.fail(f"{module} has no floor: add it to FLOORS in {Path(__file__).name}")


@cache
def tree_of(module: str) -> ast.Module:
    return ast.parse(FILES[module].read_text())


@cache
def imported_modules(module: str) -> set[str]:
    """Every module that a file imports, at its top or in a function, by full name."""
    tree = tree_of(module)
    package = module if FILES[module].name == "__init__.py" else module.rpartition(".")[0]
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                stem = package.split(".")
                base = ".".join([*stem[: len(stem) - node.level + 1], *([base] if base else [])])
            # What is imported may be a module itself, or a name in one.
            full = {f"{base}.{alias.name}" for alias in node.names}
            found |= full & FILES.keys()
            if full - FILES.keys():
                found.add(base)
    return found


@pytest.mark.parametrize("module", FILES)
def test_imports_point_down_the_floors(module):
    here = floor(module)
    if here is None:
        return
    for name in imported_modules(module):
        if name == "warp_reflect":
            continue
        if name.partition(".")[0] == "warp_reflect":
            assert name in FILES, f"{module} imports {name}, which does not exist"
            assert floor(name) <= here, f"{module} (floor {here}) imports {name} (floor {floor(name)})"


@pytest.mark.parametrize("module", FILES)
def test_public_face_is_used_by_faces_only(module):
    """Below the top floor a module names the module it means: `import warp_reflect` reaches every floor."""
    tree = tree_of(module)
    nodes = list(ast.walk(tree))
    whole = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    taken = {
        alias.name
        for node in nodes
        if isinstance(node, ast.ImportFrom) and node.module == "warp_reflect" and not node.level
        for alias in node.names
        if f"warp_reflect.{alias.name}" not in FILES
    }
    if floor(module) != 5:
        assert "warp_reflect" not in whole
        assert taken <= {"__version__"}


@pytest.mark.parametrize("module", FILES)
def test_libraries_stay_in_their_homes(module):
    name = module.removeprefix("warp_reflect").removeprefix(".")
    for imported in {full.partition(".")[0] for full in imported_modules(module)}:
        if imported in HOMES:
            homes = HOMES[imported]
            assert name.partition(".")[0] in homes, f"{module} imports {imported}; its place is {homes or 'tests'}"


def test_import_loads_nothing_heavy():
    script = f"import warp_reflect, sys; print([name for name in {HEAVY!r} if name in sys.modules])"
    run = [sys.executable, "-c", script]
    done = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_all_exist():
    package = importlib.import_module("warp_reflect")
    for name in package.__all__:
        assert getattr(package, name) is not None


@pytest.mark.parametrize("module", FILES)
def test_file_is_of_readable_length(module):
    lines = FILES[module].read_text().count("\n")
    assert lines <= LINES_MAX, f"{FILES[module].relative_to(ROOT)}: {lines} lines"


def is_kernel(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any(
        ast.unparse(decorator).startswith("wp.kernel") for decorator in node.decorator_list
    )


KERNEL_MODULES = [module for module in FILES if any(map(is_kernel, ast.walk(tree_of(module))))]


@pytest.mark.parametrize("module", KERNEL_MODULES)
def test_kernels_take_their_first_element_and_stand_at_module_scope(module):
    tree = tree_of(module)
    top = {id(node) for node in tree.body}
    for node in filter(is_kernel, ast.walk(tree)):
        assert id(node) in top, f"{module}.{node.name} is not at module scope"
        argument = node.args.args[0]
        assert (argument.arg, ast.unparse(argument.annotation)) == ("first", "int"), f"{module}.{node.name}"
        assert node.name.endswith("_kernel"), f"{module}.{node.name}"


@pytest.mark.parametrize("module", KERNEL_MODULES)
def test_kernel_modules_build_no_backward_pass(module):
    importlib.import_module(module)
    assert wp.get_module(module).options["enable_backward"] is False


@pytest.mark.parametrize("module", KERNEL_MODULES)
def test_kernels_are_launched_through_launch(module):
    """`launch` cuts a launch over the CPU's threads; a bare `wp.launch` would start at no element."""
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in ("wp.launch", "wp.launch_tiled"), f"{module}, line {node.lineno}"


@pytest.mark.parametrize("module", KERNEL_MODULES)
def test_kernels_compile_for_cuda_without_a_gpu(module, compiled_for_cuda):
    """To PTX for the oldest and the newest architecture; with `--all-architectures` for those between as well."""
    names = [node.name for node in ast.walk(tree_of(module)) if is_kernel(node)]
    for architecture, texts in compiled_for_cuda(module).items():
        made = "".join(texts)
        targets = {word.rstrip(",") for line in made.splitlines() if ".target" in line for word in line.split()}
        assert f"sm_{architecture}" in targets
        assert [name for name in names if name not in made] == []
