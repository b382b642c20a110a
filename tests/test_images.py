"""Images in and out: names, types, what is never written, and what a failed write leaves behind."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from warp_reflect import images

SHAPE = (9, 14)


def channels(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    flat = {name: rng.random(SHAPE) for name in "RGBA"}
    flat |= {"Z": rng.random(SHAPE) * 100.0, "primId": rng.integers(0, 2**24, SHAPE).astype(np.float64)}
    vectors = {name: rng.standard_normal((*SHAPE, 3)) for name in ("N", "mirrorPoint", "reflection")}
    return flat | vectors | {"reflectionMotion": rng.standard_normal((*SHAPE, 2))}


def test_srgb_curves_are_each_others_inverse():
    values = np.linspace(0.0, 1.0, 1001)
    assert np.allclose(images.linear_from_srgb(images.srgb_from_linear(values)), values, atol=1e-6)
    # IEC 61966-2-1, and the published value of mid grey.
    assert images.linear_from_srgb(np.float32(0.5)) == pytest.approx(0.21404114, rel=1e-5)
    assert images.srgb_from_linear(np.float32(0.001)) == pytest.approx(0.01292, rel=1e-5)


def test_exr_has_the_named_channels_with_half_colour_and_float_data(tmp_path):
    images.write_exr(tmp_path / "a.exr", channels())
    reader = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    spec = reader.spec()
    types = dict(zip(spec.channelnames, map(str, spec.channelformats), strict=True))
    half = {"R", "G", "B", "A", "reflection.R", "reflection.G", "reflection.B"}
    data = {"Z", "primId", "N.X", "N.Y", "N.Z", "mirrorPoint.X", "mirrorPoint.Y", "mirrorPoint.Z"}
    data |= {"reflectionMotion.X", "reflectionMotion.Y"}
    assert types == dict.fromkeys(half, "half") | dict.fromkeys(data, "float")
    assert spec.get_string_attribute("compression") == "zip"
    assert spec.get_int_attribute("oiio:subimages") == 1
    assert (spec.width, spec.height) == (SHAPE[1], SHAPE[0])


TOLD = """
import json
import sys
import numpy as np
from pathlib import Path
from warp_reflect import images

def write(k):
    header = {"warp_reflect:plan": {"step": f"{k} " * 50_000}}
    if sys.argv[1] == "exr":
        images.write_exr("a.exr", {"Z": np.zeros((2, 2))}, attributes=header)
    else:
        images.write_png("a.png", np.zeros((2, 2)), {name: json.dumps(value) for name, value in header.items()})
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

sizes = [write(1000 + k) for k in range(120)]
attributes = images.check_whole("a." + sys.argv[1])
print(max(sizes[20:]) - max(sizes[:20]), attributes["warp_reflect:plan"] == {"step": "1119 " * 50_000})
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from Linux' /proc")
@pytest.mark.parametrize("ending", ["exr", "png"])
def test_texts_of_written_files_are_not_kept(tmp_path, ending):
    # OpenImageIO keeps all it is shown: here 250 kB a file, 25 MB in all.
    program = [sys.executable, "-c", TOLD, ending]
    told = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    grown, same = told.split()
    assert same == "True"
    assert int(grown) < 4e6


def test_header_entries_of_any_name_and_length_are_written(tmp_path):
    told = {"warp_reflect:empty": "", "warp_reflect:one": "a", "Copyright": "nobody", "warp_reflect:long": "ä" * 300}
    for multi_part in (False, True):
        images.write_exr(tmp_path / "a.exr", channels(), attributes=told, multi_part=multi_part)
        _, attributes = images.read_exr(tmp_path / "a.exr")
        assert attributes["Copyright"] == "nobody"
        assert attributes["warp_reflect:one"] == "a"
        assert attributes["warp_reflect:long"] == "ä" * 300


def test_texts_of_a_png_are_read_here_and_elsewhere(tmp_path):
    told = {"warp_reflect:key": "0123abcd", "Title": "Ä\n", "Comment": "x" * 5000}
    images.write_png(tmp_path / "a.png", np.full((3, 4, 3), 0.5), told)
    with Image.open(tmp_path / "a.png") as picture:
        picture.load()
        assert {name: picture.text[name] for name in told} == told
    assert images.check_whole(tmp_path / "a.png")["warp_reflect:key"] == "0123abcd"


def test_exr_round_trip_keeps_data_exactly_and_attributes(tmp_path):
    eye = np.array([1.0 / 3.0, 2.0e7 + 1.0 / 3.0, -1e-9])
    written = channels()
    header = {"warp_reflect:eye": eye, "warp_reflect:prims": {1: "/World/Ä"}, "warp_reflect:version": "0.1"}
    assert images.write_exr(tmp_path / "a.exr", written, attributes=header) == 0
    read, attributes = images.read_exr(tmp_path / "a.exr")
    assert set(read) == set(written)
    for name, values in written.items():
        limit = 2.0**-11 if name in images.COLOR_CHANNELS else 0.0
        assert np.allclose(read[name], values.astype(np.float32), rtol=limit, atol=0.0), name
    assert attributes["warp_reflect:eye"] == eye.tolist()
    assert attributes["warp_reflect:prims"] == {"1": "/World/Ä"}
    assert attributes["warp_reflect:version"] == "0.1"


def test_same_channels_make_the_same_file(tmp_path):
    for name in ("a.exr", "b.exr"):
        images.write_exr(tmp_path / name, channels())
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_exr_never_holds_nan_or_infinity(tmp_path):
    color, data = np.ones(SHAPE), np.ones(SHAPE)
    color[0, :5] = [np.nan, np.inf, -np.inf, 1e6, -70000.0]
    data[0, :4] = [np.nan, np.inf, -np.inf, 1e300]
    assert images.write_exr(tmp_path / "a.exr", {"R": color, "Z": data}) == 7
    read, _ = images.read_exr(tmp_path / "a.exr")
    assert read["R"][0, :6].tolist() == [0.0, 65504.0, -65504.0, 65504.0, -65504.0, 1.0]
    assert read["Z"][0, :5].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0]


def test_png_is_srgb_of_linear_and_never_wraps(tmp_path):
    rgb = np.zeros((*SHAPE, 3))
    rgb[0, :6, 0] = [0.0, 0.21404114, 1.0, 7.0, -3.0, np.nan]
    rgb[0, 6] = np.inf
    assert images.write_png(tmp_path / "a.png", rgb) == 4
    stored = oiio.ImageInput.open(str(tmp_path / "a.png")).read_image(oiio.UINT8)
    assert stored[0, :6, 0].tolist() == [0, 128, 255, 255, 0, 0]
    assert stored[0, 6].tolist() == [255, 255, 255]
    back = images.read_image(tmp_path / "a.png")
    assert back.rgb[0, 1, 0] == pytest.approx(0.21404114, abs=4e-3)
    assert images.read_image(tmp_path / "a.png", "raw").rgb[0, 1, 0] == pytest.approx(128 / 255)


def save(path: Path, names: list[str], pixels: np.ndarray, kind="float", **attributes) -> Path:
    """A picture made with the library itself."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.channelnames = names
    for name, value in attributes.items():
        if isinstance(value, tuple):
            spec.attribute(name, oiio.TypeDesc(f"float[{len(value)}]"), value)
        else:
            spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(np.ascontiguousarray(pixels, np.float32)), output.geterror()
    assert output.close()
    return path


def test_bad_samples_are_replaced_and_counted_on_reading(tmp_path):
    pixels = np.ones((4, 5, 3))
    pixels[0, 0] = [np.nan, np.inf, -5.0]
    pixels[1, 1, 1] = -np.inf
    picture = images.read_image(save(tmp_path / "a.exr", ["R", "G", "B"], pixels))
    assert picture.cleaned == 4
    assert picture.rgb[0, 0].tolist() == [0.0, 0.0, 0.0]
    assert np.isfinite(picture.rgb).all()
    assert picture.rgb.dtype == np.float32


def test_channels_are_found_by_name(tmp_path):
    ramp = np.arange(5 * 6).reshape(5, 6, 1) + np.arange(5) * 100.0
    picture = images.read_image(save(tmp_path / "a.exr", ["Z", "B", "A", "R", "G"], ramp))
    assert picture.rgb[0, 0].tolist() == [300.0, 400.0, 100.0]
    assert picture.alpha is not None
    layered = save(tmp_path / "b.exr", ["beauty.B", "beauty.G", "beauty.R"], ramp[..., :3])
    assert images.read_image(layered).rgb[0, 0].tolist() == [200.0, 100.0, 0.0]
    grey = images.read_image(save(tmp_path / "c.exr", ["Y"], ramp[..., 1:2]))
    assert grey.rgb[0, 1].tolist() == [101.0] * 3
    assert grey.cleaned == 0


@pytest.mark.parametrize("name", ["a.png", "a.tga", "a.tif"])
def test_colour_under_alpha_is_read_as_stored(tmp_path, name):
    stored = np.full((2, 3, 4), 200, np.uint8)
    stored[..., 3] = [0, 100, 255]
    spec = oiio.ImageSpec(3, 2, 4, oiio.UINT8)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    writer = oiio.ImageOutput.create(str(tmp_path / name))
    writer.open(str(tmp_path / name), spec)
    writer.write_image(stored)
    writer.close()
    picture = images.read_image(tmp_path / name)
    assert np.allclose(images.srgb_from_linear(picture.rgb), 200 / 255, atol=1e-6)
    assert np.allclose(picture.alpha, np.array([0, 100, 255]) / 255, atol=1e-6)


def test_grey_8_bit_stays_as_stored_and_colour_is_decoded(tmp_path):
    grey = images.read_image(save(tmp_path / "g.png", ["Y"], np.full((3, 3, 1), 0.5), "uint8"))
    assert grey.rgb[0, 0, 0] == pytest.approx(0.5, abs=2e-3)
    color = images.read_image(save(tmp_path / "c.png", ["R", "G", "B"], np.full((3, 3, 3), 0.5), "uint8"))
    assert color.rgb[0, 0, 0] == pytest.approx(0.214, abs=3e-3)
    forced = images.read_image(tmp_path / "g.png", "sRGB")
    assert forced.rgb[0, 0, 0] == pytest.approx(0.214, abs=3e-3)
    with pytest.raises(ValueError, match="expected auto, sRGB or raw"):
        images.read_image(tmp_path / "g.png", "srgb")


def test_acescg_is_converted_to_rec709(tmp_path):
    ap1 = images.NAMED_PRIMARIES["lin_ap1_scene"]
    pixels = np.broadcast_to([0.4, 0.3, 0.2], (3, 3, 3))
    path = save(tmp_path / "a.exr", ["R", "G", "B"], pixels, chromaticities=ap1)
    # The published matrix of ACEScg (S-2014-004) to Rec.709 with Bradford adaptation.
    published = np.array([[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]])
    assert np.allclose(images.read_image(path).rgb[1, 1], published @ [0.4, 0.3, 0.2], atol=1e-4)
    assert np.allclose(images.read_image(path, "raw").rgb[1, 1], [0.4, 0.3, 0.2], atol=1e-6)


def test_cut_files_are_refused_not_half_read(tmp_path):
    """A JPEG cut in the middle of its pixels is read "successfully" by the library, grey where it was cut."""
    noise = np.random.default_rng(1).random((120, 160, 3))
    for name in ("a.jpg", "a.png", "a.exr"):
        whole = save(tmp_path / name, ["R", "G", "B"], noise, "half" if name == "a.exr" else "uint8")
        images.read_image(whole)
        data = whole.read_bytes()
        for share in (0.0, 0.1, 0.5, 0.75, 0.9):
            cut = tmp_path / f"cut_{name}"
            cut.write_bytes(data[: int(share * len(data))])
            with pytest.raises(OSError, match="cannot be read") as caught:
                images.read_image(cut)
            assert f"cut_{name}" in str(caught.value)
            assert "\n" not in str(caught.value)


def test_pictures_beyond_the_limits_are_refused_quickly(tmp_path):
    wide = save(tmp_path / "a.exr", ["R", "G", "B"], np.zeros((600, 600, 3)), "float")
    with pytest.raises(OSError, match="cannot be read"):
        images.read_image(wide, size_limit_mb=2)
    assert images.read_image(wide).rgb.shape == (600, 600, 3)


def test_size_is_counted_in_floats_too(tmp_path):
    """One-bit grey is small as stored and large as three floats."""
    grey = save(tmp_path / "a.tif", ["Y"], np.zeros((900, 1000, 1)), "uint8")
    with pytest.raises(OSError, match=r"a\.tif: cannot be read: 1000 x 900 texels are 11 MB as numbers, at most 4 MB"):
        images.read_image(grey, size_limit_mb=1)
    assert images.read_image(grey, size_limit_mb=3).rgb.shape == (900, 1000, 3)


def test_what_is_no_file_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.png: cannot be read: no such file"):
        images.read_image(tmp_path / "none.png")
    os.mkfifo(tmp_path / "pipe.png")
    for bad in (tmp_path, tmp_path / "pipe.png"):
        with pytest.raises(OSError, match="not a regular file"):
            images.read_image(bad)


def test_unwritable_outputs_are_refused_before_any_work(tmp_path):
    for name in ("a.jpg", "a", "a.tif"):
        with pytest.raises(ValueError, match=r"use \.exr or \.png"):
            images.check_writable(tmp_path / name)
    with pytest.raises(OSError, match=r"the folder .* does not exist"):
        images.check_writable(tmp_path / "missing" / "a.exr")
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.exr").mkdir()
    for bad in (tmp_path / "file" / "a.exr", tmp_path / "folder.exr", tmp_path / ("x" * 300 + ".png")):
        with pytest.raises(OSError, match="cannot be written"):
            images.check_writable(bad)
    images.check_writable(tmp_path / "A.EXR")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.exr"]


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_full_disk_leaves_the_old_file_and_no_other(tmp_path, name):
    """A limit on the size of files stands for the full disk; the PNG writer reports success there."""
    script = f"""
        import resource, signal, sys
        import numpy as np
        from warp_reflect import images
        rgb = np.random.default_rng(2).random((200, 200, 3))
        write = lambda: images.write_exr({name!r}, {{"RGB": rgb}}) if {name!r}.endswith("exr") else \\
            images.write_png({name!r}, rgb)
        write()
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
        old = open({name!r}, "rb").read()
        try:
            write()
        except OSError as error:
            assert open({name!r}, "rb").read() == old
            print(error)
            sys.exit(7)
    """
    run = [sys.executable, "-c", textwrap.dedent(script)]
    environment = os.environ | {"PYTHONPATH": str(Path(images.__file__).parents[1])}
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 7, done.stderr
    assert done.stdout.startswith(f"{name}: cannot be written: ")
    assert len(done.stdout.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        images.write_png(tmp_path / "a.png", np.zeros((3, 3, 3)))
    assert list(tmp_path.iterdir()) == []


def test_link_stays_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    images.write_png(tmp_path / "real" / "a.png", np.zeros((3, 3, 3)))
    (tmp_path / "a.png").symlink_to(tmp_path / "real" / "a.png")
    images.write_png(tmp_path / "a.png", np.ones((3, 3, 3)))
    assert (tmp_path / "a.png").is_symlink()
    assert images.read_image(tmp_path / "real" / "a.png").rgb.min() == 1.0


def test_any_memory_order_is_written(tmp_path):
    rgb = np.random.default_rng(3).random((5, 4, 3)).astype(np.float32)
    for name, view in (("a", rgb.transpose(1, 0, 2)), ("b", np.broadcast_to(rgb[0, 0], (6, 7, 3)))):
        images.write_png(tmp_path / f"{name}.png", view)
        images.write_exr(tmp_path / f"{name}.exr", {"RGB": view})
        assert np.allclose(images.read_image(tmp_path / f"{name}.png").rgb, view, atol=5e-3)
        assert np.allclose(images.read_image(tmp_path / f"{name}.exr").rgb, view, atol=5e-4)


def test_wrong_shapes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="channel 'G': got shape"):
        images.write_exr(tmp_path / "a.exr", {"R": np.zeros((3, 4)), "G": np.zeros((4, 3))})
    with pytest.raises(ValueError, match="at least one channel"):
        images.write_exr(tmp_path / "a.exr", {})
    with pytest.raises(ValueError, match="5 components"):
        images.write_exr(tmp_path / "a.exr", {"N": np.zeros((3, 4, 5))})
    with pytest.raises(ValueError, match="expected"):
        images.write_png(tmp_path / "a.png", np.zeros((3, 4, 2)))
    assert list(tmp_path.iterdir()) == []
