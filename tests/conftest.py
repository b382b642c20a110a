"""Options and fixtures every test may use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import warp as wp


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="Warp device the tests run on: cpu or cuda:0")


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(wp.config, "log_level"):
        wp.config.log_level = wp.LOG_WARNING
    else:
        wp.config.quiet = True


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> str:
    """The Warp device under test."""
    name = request.config.getoption("--device")
    wp.init()
    known = [device.alias for device in wp.get_devices()]
    if name not in known:
        pytest.exit(f"--device: got '{name}', this machine has {', '.join(known)}", returncode=2)
    return name


@pytest.fixture
def assert_images_close(tmp_path: Path):
    """A check that leaves `_img.exr`, `_ref.exr` and `_error.exr` behind when two pictures differ."""
    from warp_reflect.images import write_exr

    def check(image: np.ndarray, reference: np.ndarray, mean_abs: float, name: str = "picture") -> None:
        error = np.abs(np.asarray(image, np.float64) - np.asarray(reference, np.float64))
        worst = float(np.mean(error))
        if worst <= mean_abs:
            return
        for suffix, pixels in (("img", image), ("ref", reference), ("error", error)):
            write_exr(tmp_path / f"{name}_{suffix}.exr", {"RGB": np.asarray(pixels)}, half=())
        pytest.fail(f"{name}: mean absolute error {worst:.3g} > {mean_abs:.3g}; see {tmp_path}/{name}_*.exr")

    return check
