"""Options and fixtures every test may use."""

from __future__ import annotations

import gc
import importlib
import os
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_reflect
from warp_reflect import kernels, launch, warmup

# What `--warp-debug` runs where no files are named: tests that launch all kernels in seconds; file to names ("": all of it).
BOUNDS = {
    "test_bumps.py": ("test_map_of_one_direction_mirrors_as_tilted_corners_do[lookup",),
    "test_captured.py": (
        "test_a_repeated_frame_copies_its_camera_alone",
        "test_a_repeated_frame_is_the_launched_one_bit_for_bit[kitchen-settings5",
        "test_a_repeated_frame_is_the_launched_one_bit_for_bit[panes",
        "test_normal_maps_and_waves_turn_the_rays_of_repeated_frames",
    ),
    "test_compact.py": ("",),
    "test_cutouts.py": ("test_hundreds_of_holes", "test_a_distant_light"),
    "test_environment.py": ("test_coarser_levels_keep_the_mean",),
    "test_explosion_map.py": ("test_frames_are_finite_from_near_and_inside[eye0-0",),
    "test_forward.py": ("test_planar_equals_the_picture_of_a_mirrored_eye",),
    "test_frost.py": ("test_frost_is_finite", "test_what_a_mirror_shows_fades"),
    "test_glossy.py": (
        "test_plane_shows_the_lobe_over_a_known_sky[filter-0.15",
        "test_plane_shows_the_lobe_over_a_known_sky[gather-0.15",
        "test_nothing_gives_more_light_than_it_gets[0.3-accumulate",
    ),
    "test_glossy_prefiltered.py": ("test_threads_do_not_change_a_pixel[environment",),
    "test_grid.py": ("test_answers_that_are_there_already_are_kept",),
    "test_heightfield.py": ("test_step_limit", "test_ray", "test_vertical", "test_diagonal", "test_smallest"),
    "test_layered_environment.py": ("test_stage_of_one_mirror", "test_moving_mirrors_show_each_other"),
    "test_level_blend.py": ("test_values_of_any_size_approach",),
    "test_local_field.py": (
        "test_lines_side_by_side_are_swept_as_single_ones[33-Y",
        "test_blocks_of_texels_are_blended_as_single_ones[field-settings0",
    ),
    "test_local_maps.py": ("test_vectors_find_and_shade_what_single_texels_do[1-32",),
    "test_motion.py": ("test_motion_of_a_still_scene_and_of_a_first_frame_is_zero",),
    "test_normal_maps.py": ("test_bumps_are_seen_in_a_mirror",),
    "test_quadric.py": (
        "test_search_agrees_with_the_papers_curve_search[two sheets",
        "test_branches_hold_the_constructed_point[hyperbolic paraboloid",
        "test_scene_of_gprims_shows_what_the_reference_shows[ellipsoid_row",
    ),
    "test_raster.py": ("",),
    "test_raytraced.py": ("test_refit_follows_moved_points", "test_trace_is_watertight_at_vertices_and_edges[0.0"),
    "test_ray_query.py": ("test_moved_points_are_met_where_they_are",),
    "test_reflector_map.py": ("test_bare_solver_takes_a_reflector_map",),
    "test_refraction.py": ("test_statuses",),
    "test_reuse.py": ("test_reuse_of_a_still", "test_objects_behind_a_plane"),
    "test_scene_field.py": ("test_level_roofs_and_grounds_are_exact_in_both",),
    "test_segments.py": ("test_open_and_hollow_mirrors_show_what_tracing_shows[hollow near",),
    "test_shadows.py": (
        "test_lists_of_rays_bring_the_same",
        "test_shadowed_frames_do_not_depend",
        "test_a_closed_room_under_a_dome_is_dark",
    ),
    "test_solve.py": ("test_point_on_the_surface_is_its_own_reflection", "test_qim_agrees"),
    "test_solve_gradients.py": ("",),
    "test_textures.py": ("test_level_follows_the_path_through_a_mirror",),
    "test_transmission.py": ("test_water", "test_light_is_totally_reflected", "test_panes_behind"),
    "test_vector.py": (
        "test_masks_and_rays",
        "test_every_surface_is_shaded",
        "test_frames_are_the_same_bit_for_bit[small ball-exact",
        "test_mirrors_are_met",
    ),
    "test_viewer_session.py": ("test_search_path_descends_to_what_the_pixel_shows[newton",),
    "test_water.py": ("test_waves_are_finite", "test_the_mirrored_picture", "test_the_refracted_picture"),
}
ARCHITECTURES = (75, 80, 86, 89, 90, 100, 120)  # compute capabilities times ten: Turing to Blackwell
MANY = 200  # tests, or a bounds-checked run: kernels are compiled ahead, on the core that most tests leave idle
LAUNCHLESS = ("test_house.py",)  # files whose tests launch no kernel
CHECKED_MIN = 0.9  # share of the package's kernels that a bounds-checked run launches, or it proves little
WORKERS_MAX = 8  # processes of a whole run: each holds Warp, the kernels and its file's scenes, 1.5 GB at most
LAUNCHED = pytest.StashKey[list]()
CHECKED = pytest.StashKey[str]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="Warp device the tests run on: cpu or cuda:0")
    parser.addoption(
        "--all-architectures", action="store_true", help="Compile kernels for every CUDA architecture from 75 to 120"
    )
    parser.addoption(
        "--warp-debug",
        action="store_true",
        help="Compile kernels with Warp's checks of array bounds (a bad index ends the process); tell which were not launched",
    )


def pytest_configure(config: pytest.Config) -> None:
    os.environ["WARP_REFLECT_CALIBRATION"] = ""  # plans as on any machine
    if config.getoption("--warp-debug"):
        wp.config.mode = "debug"
        # Kernels of that mode end the process when two threads run one at the same time: slices one after the other.
        launch.run_parallel = lambda jobs: [job() for job in jobs]
        recording = launch.recorded()
        config.stash[LAUNCHED] = recording.__enter__()
        config.add_cleanup(lambda: recording.__exit__(None, None, None))
    if hasattr(wp.config, "log_level"):
        wp.config.log_level = wp.LOG_WARNING
    else:
        wp.config.quiet = True


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Where all tests are asked for, and pytest-xdist is installed: on all cores, a file's tests in one process.

    Most tests keep one core busy. What is asked for by name, or in another way than by default, runs in this process.
    """
    option = config.option
    named = config.args_source is pytest.Config.ArgsSource.ARGS or option.keyword or option.markexpr != "not gl"
    single = (
        option.warp_debug or option.usepdb or option.collectonly or option.device != "cpu" or sys.platform == "win32"
    )
    told = getattr(option, "numprocesses", None) is not None or getattr(option, "tx", None)
    if not config.pluginmanager.hasplugin("xdist") or hasattr(config, "workerinput") or named or single or told:
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    option.numprocesses, option.dist = min(cores, WORKERS_MAX), "loadfile"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--warp-debug") or config.args_source is pytest.Config.ArgsSource.ARGS:
        return
    kept = [item for item in items if item.name.startswith(BOUNDS.get(item.path.name, ()))]
    for file, names in BOUNDS.items():
        for name in names:
            if not any(item.path.name == file and item.name.startswith(name) for item in kept):
                raise pytest.UsageError(f"--warp-debug: no test in {file} begins with '{name}'")
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = kept


def pytest_collection_finish(session: pytest.Session) -> None:
    # Tests, modules and the trees of all kernels stay to the end: the garbage collector need not look through them each time.
    gc.freeze()


def pytest_unconfigure() -> None:
    gc.unfreeze()  # libraries tell of what is left at the end of the process


def _kernels() -> set[str]:
    """The names of all kernels of the package, as `launch.recorded` gives them."""
    package = Path(warp_reflect.__file__).parent
    found = set()
    for path in sorted(package.rglob("*.py")):
        if "@wp.kernel" in path.read_text():
            module = importlib.import_module(".".join(path.relative_to(package.parent).with_suffix("").parts))
            found |= {f"{each.module.name}.{each.key}" for each in vars(module).values() if isinstance(each, wp.Kernel)}
    return found


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    if LAUNCHED not in session.config.stash or exitstatus != pytest.ExitCode.OK:
        return
    every = _kernels()
    left = sorted(every - {name for name, _ in session.config.stash[LAUNCHED]})
    session.config.stash[CHECKED] = f"bounds checked: {len(every) - len(left)} of {len(every)} kernels" + "".join(
        f"\n  not launched: {name}" for name in left
    )
    if len(left) > (1.0 - CHECKED_MIN) * len(every):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter, config: pytest.Config) -> None:
    if CHECKED in config.stash:
        terminalreporter.write_line(config.stash[CHECKED])


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> str:
    """The Warp device under test."""
    name = request.config.getoption("--device")
    wp.init()
    known = [device.alias for device in wp.get_devices()]
    if name not in known:
        pytest.exit(f"--device: got '{name}', this machine has {', '.join(known)}", returncode=2)
    return name


def _worker(config: pytest.Config) -> tuple[int, int]:
    """This process's number among those of pytest-xdist, and how many they are."""
    told = getattr(config, "workerinput", None)
    return (int(told["workerid"].removeprefix("gw")), told["workercount"]) if told else (0, 1)


def _compile_once(locks: Path) -> None:
    """Of several processes one compiles a kernel module; the others wait for it, and find it in Warp's cache.

    Each compiles one module at a time: they leave no core idle.
    """
    import fcntl

    compile_module = launch._compile
    launch._compilers = cache(lambda process: ThreadPoolExecutor(1, "warp_reflect_compile"))

    def compile_alone(module: wp.Module, device: wp.Device) -> None:
        with open(locks / f"{module.name}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            compile_module(module, device)

    launch._compile = compile_alone


@pytest.fixture(autouse=True)
def default_device(request: pytest.FixtureRequest) -> Iterator[None]:
    """Where arrays lie that a test names no device for: on the one under test if it asks for it, else on the CPU.

    Warp itself would take a GPU wherever there is one.
    """
    with wp.ScopedDevice(request.getfixturevalue("device") if "device" in request.fixturenames else "cpu"):
        yield


@pytest.fixture(scope="session", autouse=True)
def compiled_ahead(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> None:
    """What tests will need is on its way to be compiled: for CUDA what they ask for, for the CPU all, where most are run."""
    config = request.config
    worker, workers = _worker(config)
    if workers > 1:
        _compile_once(tmp_path_factory.getbasetemp().parent)
    elif any("compiled_for_cuda" in getattr(item, "fixturenames", ()) for item in request.session.items):
        request.getfixturevalue("compiled_for_cuda")
    launching = [item for item in request.session.items if item.path.name not in LAUNCHLESS]
    if config.getoption("--device") == "cpu" and (len(launching) > MANY or LAUNCHED in config.stash):
        wp.init()
        for name in list(warmup.kernel_modules())[worker::workers]:
            launch.ready(kernels.modules_of(name), wp.get_device("cpu"))


@pytest.fixture(scope="session")
def compiled_for_cuda(request: pytest.FixtureRequest):
    """Gives the PTX of a kernel module, texts by architecture; what tests will ask for is compiled beside the others.

    Among several processes, which leave no core idle, it is compiled where it is asked for.
    """
    every = request.config.getoption("--all-architectures")
    architectures = ARCHITECTURES if every else (ARCHITECTURES[0], ARCHITECTURES[-1])

    def compiled(name: str) -> dict[int, list[str]]:
        texts: dict[int, list[str]] = {}
        for module in kernels.modules_of(name):
            for architecture in architectures:
                # Not among the tests' own folders: some tests watch those while this runs beside them.
                with tempfile.TemporaryDirectory() as folder:
                    made = wp.compile_aot_module(module, arch=[architecture], module_dir=folder, use_ptx=True)
                    found = [Path(path).read_text() for path in made if Path(path).suffix == ".ptx"]
                texts.setdefault(architecture, []).extend(found)
        return texts

    if _worker(request.config)[1] > 1:
        yield compiled
        return
    asked = [item for item in request.session.items if "compiled_for_cuda" in getattr(item, "fixturenames", ())]
    names = [item.callspec.params["module"] for item in asked]
    with ThreadPoolExecutor(1) as pool:
        begun = {name: pool.submit(compiled, name) for name in names}
        yield lambda name: begun[name].result()
        pool.shutdown(cancel_futures=True)


@pytest.fixture
def leave_images(tmp_path: Path):
    """Writes `_img.exr`, `_ref.exr` and `_error.exr` of two pictures and says where; for a test about to fail."""
    from warp_reflect.images import write_exr

    def leave(image: np.ndarray, reference: np.ndarray, name: str = "picture") -> str:
        error = np.abs(np.asarray(image, np.float64) - np.asarray(reference, np.float64))
        for suffix, pixels in (("img", image), ("ref", reference), ("error", error)):
            write_exr(tmp_path / f"{name}_{suffix}.exr", {"RGB": np.asarray(pixels)}, half=())
        return f"see {tmp_path}/{name}_*.exr"

    return leave


@pytest.fixture
def assert_images_close(leave_images):
    """A check that leaves pictures behind when two differ."""

    def check(image: np.ndarray, reference: np.ndarray, mean_abs: float, name: str = "picture") -> None:
        worst = float(np.mean(np.abs(np.asarray(image, np.float64) - np.asarray(reference, np.float64))))
        # Not `worst > mean_abs`: a NaN in a picture fails too.
        if not worst <= mean_abs:
            where = leave_images(image, reference, name)
            pytest.fail(f"{name}: mean absolute error {worst:.3g} > {mean_abs:.3g}; {where}")

    return check
