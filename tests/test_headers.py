"""Threads that compile share Warp's precompiled header, and do without where Warp keeps it elsewhere."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

SCRIPT = """
import os, sys, tempfile
import warp as wp
from warp_reflect import launch

wp.config.log_level = wp.LOG_WARNING
wp.init()
if sys.argv[1] == "elsewhere":
    # A header for every module, in a folder that is not known here.
    runtime = wp._src.context.runtime
    runtime.get_clang_pch_dir = lambda: tempfile.mkdtemp(dir=os.environ["WARP_CACHE_PATH"])
    del runtime._pch_dirs
SETS = (launch.PLAIN_FLAGS, launch.FINITE_FLAGS, launch.VECTOR_FLAGS, launch.PLAIN_FLAGS)
modules = [launch.module_part(__name__, f"of_{k}", cpu_compiler_flags=flags) for k, flags in enumerate(SETS)]


@wp.kernel(module=modules[0])
def plain_kernel(first: int, out: wp.array(dtype=float)):
    out[first + wp.tid()] = wp.sqrt(float(first + wp.tid()))


@wp.kernel(module=modules[1])
def finite_kernel(first: int, out: wp.array(dtype=float)):
    out[first + wp.tid()] = wp.max(float(first + wp.tid()), 2.0)


@wp.kernel(module=modules[2])
def vector_kernel(first: int, out: wp.array(dtype=float)):
    out[first + wp.tid()] = 2.0 * float(first + wp.tid())


@wp.kernel(module=modules[3])
def other_kernel(first: int, out: wp.array(dtype=float)):
    out[first + wp.tid()] = 3.0 - float(first + wp.tid())


for begun in launch.ready(modules, "cpu"):
    begun.result()
for kernel in (plain_kernel, finite_kernel, vector_kernel, other_kernel):
    out = wp.zeros(4, dtype=float, device="cpu")
    launch.launch(kernel, 4, [out], "cpu")
    print(*out.numpy())
folder = launch._headers(os.getpid())._folder.name
files = [os.path.join(folder, name) for name in os.listdir(folder)]
print(len(files), len({os.stat(file).st_ino for file in files}))
"""


@pytest.mark.parametrize(("kept", "headers"), [("as known", "3 1"), ("elsewhere", "0 0")])
def test_sets_of_flags_share_one_header(tmp_path, kept, headers):
    script = tmp_path / "compile.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "kernels"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(script), kept]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    told = done.stdout.splitlines()[-5:]
    assert told[1:] == ["2.0 2.0 2.0 3.0", "0.0 2.0 4.0 6.0", "3.0 2.0 1.0 0.0", headers]
    assert [float(x) for x in told[0].split()] == pytest.approx([0.0, 1.0, 2.0**0.5, 3.0**0.5])
    assert "without precompiled headers" not in done.stdout + done.stderr
