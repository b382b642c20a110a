"""Hostile files: refused with one line, or read in a child whose end is not ours."""

import os
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils

from warp_reflect.stage import guard
from warp_reflect.stage.guard import Limits, check_file, confinement_fault, read_untrusted
from warp_reflect.stage.layers import check_layers
from warp_reflect.stage.read import read_stage
from warp_reflect.stage.transfer import check, load, save


@pytest.fixture
def crate(tmp_path):
    path = tmp_path / "good.usdc"
    stage = samples.new_stage(path)
    samples.add_cube_mesh(stage, "/Cube")
    stage.GetRootLayer().Save()
    return path


def refused(path, match, limits=None):
    with pytest.raises(ValueError, match=match) as caught:
        check_file(path, limits or Limits())
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_good_files_pass(crate, tmp_path):
    check_file(crate, Limits())
    text = tmp_path / "good.usda"
    Sdf.Layer.FindOrOpen(str(crate)).Export(str(text))
    check_file(text, Limits())
    package = tmp_path / "good.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(crate), str(package))
    check_file(package, Limits())


def test_what_is_no_stage_is_refused(tmp_path):
    for name, content in {"empty": b"", "picture": b"\x89PNG\r\n\x1a\n", "wide": "#usda 1.0".encode("utf-16")}.items():
        path = tmp_path / name
        path.write_bytes(content)
        refused(path, "not a USD file")
    with pytest.raises(FileNotFoundError, match="no such stage"):
        check_file(tmp_path / "nowhere", Limits())
    refused(tmp_path, "not a regular file")


def test_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.usda")
    refused(tmp_path / "pipe.usda", "not a regular file")


def test_crate_counts_and_offsets_are_checked(crate, tmp_path):
    good = crate.read_bytes()
    (toc,) = struct.unpack_from("<q", good, 16)
    first_section = struct.unpack_from("<16sqq", good, toc + 8)
    broken = {
        "a truncated header": good[:20],
        "table of contents lies": good[:16] + struct.pack("<q", 10**12) + good[24:],
        "sections, more than 64": good[:toc] + struct.pack("<Q", 2**26) + good[toc + 8 :],
        "section TOKENS at": good[: toc + 24] + struct.pack("<q", 10**9) + good[toc + 32 :],
        "claims 1000000000 entries": good[: first_section[1]] + struct.pack("<Q", 10**9) + good[first_section[1] + 8 :],
    }
    assert first_section[0].startswith(b"TOKENS")
    for text, content in broken.items():
        path = tmp_path / "broken.usdc"
        path.write_bytes(content)
        refused(path, text)


def test_nul_and_nesting_in_text_are_refused(tmp_path):
    path = tmp_path / "deep.usda"
    path.write_text("#usda 1.0\n" + 'def "A" {\n' * 700 + "}" * 700)
    refused(path, "nested 700 deep")
    path.write_text('#usda 1.0\ndef "A" (doc = """' + "{" * 5000 + '""")\n{\n}\n# ' + "(" * 5000 + "\n")
    check_file(path, Limits())
    path.write_bytes(b'#usda 1.0\ndef "A\0B" {\n}\n')
    refused(path, "NUL byte at 16")
    path.write_text("#usda 1.0\n" + "# filler\n" * 100)
    refused(path, "bytes of text, more than 500", Limits(text_bytes=500))


def test_packages_are_checked(tmp_path):
    path = tmp_path / "bad.usdz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.usda", "#usda 1.0\n" * 50)
    refused(path, "is compressed")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("../../a.usda", "#usda 1.0\n")
    refused(path, "leaves the package")
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.usda", "#usda 1.0\n")
        archive.writestr("a.usda", "#usda 1.0\n")
    refused(path, "two entries named")
    path.write_bytes(b"PK\x03\x04 nothing more")
    refused(path, "zip")


def test_confinement_follows_links_and_packages(tmp_path):
    inside = tmp_path / "show"
    inside.mkdir()
    (tmp_path / "secret.usda").write_text("#usda 1.0\n")
    (inside / "link.usda").symlink_to(tmp_path / "secret.usda")
    assert not confinement_fault(str(inside / "a.usda"), str(inside))
    assert not confinement_fault(f"{inside}/a.usdz[../../b.png]", str(inside))
    assert not confinement_fault("/anywhere", "")
    for file in (inside / ".." / "secret.usda", inside / "link.usda", tmp_path / "show2" / "a.usda"):
        assert "outside the folder" in confinement_fault(str(file), str(inside))


def doubling(folder, levels):
    """A file whose prims double with every level of references."""
    lines = ["#usda 1.0", 'def "L0"', "{", "}"]
    for k in range(1, levels + 1):
        lines += [f'def "L{k}"', "{"]
        lines += [f'    def "{side}" (references = </L{k - 1}>)\n    {{\n    }}' for side in "AB"]
        lines += ["}"]
    path = folder / f"tree{levels}.usda"
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_reference_trees_are_counted_before_they_grow(tmp_path):
    check_layers(doubling(tmp_path, 10), Limits())
    with pytest.raises(ValueError, match="would compose to"):
        check_layers(doubling(tmp_path, 40), Limits())


def test_the_count_bounds_what_composes(tmp_path):
    path = doubling(tmp_path, 8)
    stage = Usd.Stage.Open(path)
    composed = sum(1 for _ in stage.TraverseAll())
    with pytest.raises(ValueError, match="would compose to"):
        check_layers(path, Limits(prims=composed - 1))
    check_layers(path, Limits(prims=composed + 1))


def test_reference_chains_and_cycles_end(tmp_path):
    lines = ["#usda 1.0"]
    lines += [f'def "C{k}" (references = </C{k + 1}>)\n{{\n}}' for k in range(300)]
    path = tmp_path / "chain.usda"
    path.write_text("\n".join([*lines, 'def "C300"\n{\n}\n']))
    with pytest.raises(ValueError, match="more than 200 references"):
        check_layers(str(path), Limits())
    path = tmp_path / "cycle.usda"
    path.write_text('#usda 1.0\ndef "A" (references = </B>)\n{\n}\ndef "B" (references = </A>)\n{\n}\n')
    check_layers(str(path), Limits())


def test_instances_are_counted_once(tmp_path):
    lines = ["#usda 1.0", 'def "Tree"', "{", *(f'    def "P{k}"\n    {{\n    }}' for k in range(100)), "}"]
    lines += [f'def "I{k}" (instanceable = true references = </Tree>)\n{{\n}}' for k in range(100)]
    path = tmp_path / "forest.usda"
    path.write_text("\n".join(lines) + "\n")
    check_layers(str(path), Limits(prims=500))


def test_layers_outside_the_root_are_refused(tmp_path):
    inside = tmp_path / "show"
    inside.mkdir()
    secret = samples.new_stage(tmp_path / "secret.usda")
    samples.add_quad(secret, "/Quad")
    samples.saved(secret)
    path = inside / "stage.usda"
    path.write_text('#usda 1.0\ndef "A" (references = @../secret.usda@</Quad>)\n{\n}\n')
    assert len(read_stage(path).instances) == 1
    with pytest.raises(ValueError, match=r"secret\.usda is outside the folder"):
        read_stage(path, limits=Limits(root=str(inside)))
    with pytest.raises(ValueError, match=r"secret\.usda: outside the folder"):
        check_layers(str(path), Limits(root=str(inside)))
    assert len(read_stage(path, limits=Limits(root=str(tmp_path))).instances) == 1


def test_instance_budget_is_kept(tmp_path):
    stage = samples.new_stage(tmp_path / "many.usda")
    instancer = UsdGeom.PointInstancer.Define(stage, "/PI")
    instancer.CreatePrototypesRel().SetTargets(["/PI/Quad"])
    samples.add_quad(stage, "/PI/Quad")
    instancer.CreateProtoIndicesAttr([0] * 100)
    instancer.CreatePositionsAttr([Gf.Vec3f(k, 0, 0) for k in range(100)])
    path = samples.saved(stage)
    assert len(read_stage(path, limits=Limits(instances=100)).instances) == 100
    with pytest.raises(ValueError, match="</PI>: more than 99 instances"):
        read_stage(path, limits=Limits(instances=99))
    with pytest.raises(ValueError, match="triangles, expected at most 199"):
        read_stage(path, limits=Limits(triangles=199))


def rich_stage(path):
    stage = samples.new_stage(path)
    cube = samples.add_cube_mesh(stage, "/Cube")
    cube.CreateDisplayColorPrimvar("uniform").Set([Gf.Vec3f(k, 0, 0) for k in range(6)])
    UsdGeom.Capsule.Define(stage, "/Capsule").AddScaleOp().Set(Gf.Vec3f(1, 2, 3))
    samples.bind(stage.GetPrimAtPath("/Capsule"), samples.add_material(stage, "/M", metallic=1.0))
    UsdGeom.Camera.Define(stage, "/Camera")
    UsdGeom.BasisCurves.Define(stage, "/Curves")
    return samples.saved(stage)


def assert_same(a, b):
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif hasattr(a, "__dataclass_fields__"):
        for name in a.__dataclass_fields__:
            assert_same(getattr(a, name), getattr(b, name))
    elif isinstance(a, (list, tuple)):
        assert type(a) is type(b) and len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a == b and type(a) is type(b)


def test_handing_over_keeps_every_bit(tmp_path):
    data = read_stage(rich_stage(tmp_path / "stage.usda"))
    save(data, tmp_path)
    assert_same(load(tmp_path), data)


def test_damaged_answers_are_refused(tmp_path):
    data = read_stage(rich_stage(tmp_path / "stage.usda"))
    for change in (
        lambda d: d.meshes[0].triangles.__setitem__((0, 0), 99),
        lambda d: d.meshes[0].points.__setitem__((0, 0), np.nan),
        lambda d: d.meshes[0].color_index.__setitem__((0, 0), -1),
        lambda d: setattr(d.instances[0], "mesh", 7),
        lambda d: setattr(d.instances[0], "materials", (5,)),
        lambda d: setattr(d.instances[0], "materials", ()),
    ):
        save(data, tmp_path)
        damaged = load(tmp_path)
        damaged.meshes[0].points = damaged.meshes[0].points.copy()
        change(damaged)
        with pytest.raises(ValueError, match="damaged answer"):
            check(damaged)
    save(data, tmp_path)
    (tmp_path / "arrays.bin").write_bytes((tmp_path / "arrays.bin").read_bytes()[:1000])
    with pytest.raises(ValueError, match="damaged answer"):
        load(tmp_path)


def test_untrusted_reading_gives_the_same_scene(tmp_path):
    path = rich_stage(tmp_path / "stage.usda")
    assert_same(read_untrusted(path), read_stage(path))


def test_untrusted_errors_come_through_as_one_line(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such stage"):
        read_untrusted(tmp_path / "nowhere.usda")
    path = tmp_path / "bad.usda"
    path.write_text("#usda 1.0\ndef Mesh {\n")
    with pytest.raises(ValueError, match=r"cannot read .*bad\.usda") as caught:
        read_untrusted(path)
    assert "\n" not in str(caught.value)


def stand_in(tmp_path, monkeypatch, code):
    """Put another program in the child's place, to see what becomes of its end."""
    package = tmp_path / "stand_in" / "warp_reflect" / "stage"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package.parent / "__init__.py").touch()
    (package / "child.py").write_text(code)
    monkeypatch.setattr(sys, "path", [str(package.parents[1]), *sys.path])
    # `python -m` looks into the current folder first.
    monkeypatch.chdir(package.parents[1])


@pytest.mark.parametrize(
    ("code", "seconds", "expected"),
    [
        # Those that end by themselves are given all the time that a busy machine may take to start them.
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            300.0,
            r"the USD library crashed on .* \(signal 11",
        ),
        ("import time; time.sleep(600)", 1.0, "took longer than 1 s"),
        ("raise MemoryError('too much')", 300.0, "failed: MemoryError: too much"),
    ],
)
def test_a_child_that_dies_or_hangs_is_one_line(tmp_path, monkeypatch, code, seconds, expected):
    path = rich_stage(tmp_path / "stage.usda")
    stand_in(tmp_path, monkeypatch, code)
    with pytest.raises(ValueError, match=expected) as caught:
        read_untrusted(path, seconds=seconds)
    assert "\n" not in str(caught.value)


def test_memory_of_the_child_is_bounded(tmp_path):
    path = rich_stage(tmp_path / "stage.usda")
    with pytest.raises(ValueError, match=r"stage\.usda"):
        read_untrusted(path, memory_bytes=150 * 2**20)


def test_nothing_is_left_behind(tmp_path, monkeypatch):
    path = rich_stage(tmp_path / "stage.usda")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(guard.tempfile, "tempdir", str(scratch))
    read_untrusted(path)
    assert not list(Path(scratch).iterdir())
