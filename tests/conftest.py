"""Options and fixtures every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import warp as wp


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="Warp device the tests run on: cpu or cuda:0")


def pytest_configure(config: pytest.Config) -> None:
    os.environ["WARP_REFLECT_CALIBRATION"] = ""  # plans as on any machine
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
