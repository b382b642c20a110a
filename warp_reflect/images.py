"""Images in and out: the only user of OpenImageIO.

Arrays are `[height, width]` or `[height, width, channels]`, row 0 at the top, linear Rec.709 unless said
otherwise.
A file appears under its final name whole or not at all.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import zlib
from collections.abc import Collection, Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

PNG_LEVEL = 4  # of zlib's 9: half the time of its default, 6, for a file that is 6 % larger
FORMATS = {".exr": "openexr", ".png": "png"}  # JPEG is left out: its writer ends the process on a full disk
COLOR_CHANNELS = frozenset({"R", "G", "B", "A", "RGB", "RGBA", "reflection"})  # half in an EXR
HALF_MAX = 65504.0  # largest finite half
SIZE_LIMIT_MB = 512  # decoded size above which a picture is refused: a 1 MB file can ask for 4 GB
FLOATS_PER_STORED = 4  # bytes of a float for one of a sample of 8 bits: such a picture of three colours may be as large
FRAME_LIMIT_MB = 8192  # the same for our own frames: 8K with every channel
SIDE_LIMIT = 32768  # pixels
# Rows that are put together and handed over at once, for each thread of the writer: one ZIP block of an EXR. More would be
# turned into pixels in main memory instead of in a core's own.
ROWS_AT_ONCE = 16
# OpenImageIO keeps every text that it is ever shown until the process ends: the plans of 500 frames are 5 MB, and every one,
# however short, splits a hole of the heap that the next frame's arrays had fitted in. So it is shown stand-ins, which differ by
# their length alone, in steps of so many bytes where JSON may be filled up with blanks.
TEXT_STEP = 256
STAND_IN = "-"
OWN_ENTRIES = "warp_reflect:"  # the library gives names that it knows (Copyright) others in the file
EXR_START = 8  # bytes: magic number and version
PNG_START = 33  # bytes: signature and first chunk

# x and y of red, green, blue and white: ITU-R BT.709.
REC709_PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
# Primaries of the named spaces that files declare (ACES: SMPTE ST 2065-1 and S-2014-004; P3: SMPTE EG 432-1).
NAMED_PRIMARIES = {
    "lin_ap1_scene": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
    "lin_ap0_scene": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767),
    "lin_p3d65_scene": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290),
    "lin_rec2020_scene": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
}
NAMED_PRIMARIES["acescg"] = NAMED_PRIMARIES["lin_ap1_scene"]
NAMED_PRIMARIES["aces2065-1"] = NAMED_PRIMARIES["lin_ap0_scene"]
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

_part_number = count()


class Picture(NamedTuple):
    """A picture that was read, ready to shade with."""

    rgb: np.ndarray
    """float32 [height, width, 3], finite and >= 0; linear Rec.709 (as stored if `color_space` was "raw")."""
    cleaned: int
    """Samples that were NaN, infinite or negative and were replaced."""
    alpha: np.ndarray | None = None
    """float32 [height, width] in [0, 1], where the file has one."""


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """Linear light of sRGB-encoded values, any shape (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, np.float32)
    high = ((np.maximum(encoded, 0.04045) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(encoded <= 0.04045, encoded / np.float32(12.92), high)


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """SRGB encoding of linear light, any shape, not clipped (IEC 61966-2-1)."""
    linear = np.asarray(linear, np.float32)
    high = np.float32(1.055) * np.maximum(linear, 0.0031308) ** np.float32(1.0 / 2.4) - np.float32(0.055)
    return np.where(linear <= 0.0031308, linear * np.float32(12.92), high)


def rec709_from_primaries(primaries) -> np.ndarray:
    """Matrix [3, 3] from linear RGB of the given primaries to linear Rec.709, acting on columns.

    Args:
        primaries: x and y of red, green, blue and white, [8] (OpenEXR's `chromaticities`).

    Source: SMPTE RP 177 (primaries to XYZ), Bradford adaptation between the whites.
    """
    source, target = _xyz_from_primaries(primaries), _xyz_from_primaries(REC709_PRIMARIES)
    cone_from = BRADFORD @ source.sum(axis=1)
    cone_to = BRADFORD @ target.sum(axis=1)
    adapt = np.linalg.inv(BRADFORD) @ np.diag(cone_to / cone_from) @ BRADFORD
    return np.linalg.inv(target) @ adapt @ source


def _xyz_from_primaries(primaries) -> np.ndarray:
    xy = np.asarray(primaries, np.float64).reshape(4, 2)
    xyz = np.stack([xy[:, 0], xy[:, 1], 1.0 - xy.sum(axis=1)])
    white = xyz[:, 3] / xyz[1, 3]
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], white)


def check_writable(path: str | os.PathLike) -> Path:
    """Refuse, before any work is done, an output that could not be written.

    Raises:
        ValueError: an unknown extension.
        OSError: the folder is missing, is no folder or is read-only, or the name cannot be used.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path}: cannot write a '{path.suffix}' image; use {' or '.join(FORMATS)}")
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        mode = stat.S_IFREG
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None
    if not stat.S_ISREG(mode):
        raise OSError(f"{path}: cannot be written: it exists and is not a regular file")
    folder = path.parent
    if not folder.is_dir():
        raise OSError(f"{path}: cannot be written: the folder '{folder}' does not exist; make it first")
    probe = _part_name(path)
    try:
        # A permission bit says little (root, read-only mounts): make a file.
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        probe.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None
    return path


def write_exr(
    path: str | os.PathLike,
    channels: Mapping[str, np.ndarray],
    half: Collection[str] = COLOR_CHANNELS,
    attributes: Mapping[str, object] | None = None,
    multi_part: bool = False,
) -> int:
    """Write an EXR, ZIP-compressed, half or float32 per channel.

    Args:
        path: Where; the format is EXR whatever the extension.
        channels: Name to array [height, width] or [height, width, n]. n components become `name.X .Y .Z`, or
            `name.R .G .B .A` where the name is in `half`; "RGB" and "RGBA" become their letters.
        half: Names (or what stands before a point in them) stored as half, clamped to +-65504; the others are
            float32.
        attributes: Header entries. str, int and float as they are; anything else as JSON (OpenImageIO drops
            float64 entries of an EXR: a JSON list keeps every digit).
        multi_part: One part per entry of `channels`, named by it, so that readers decode only what they want; the
            header entries are in the first.

    Returns:
        Samples that were NaN or infinite and were replaced: by 0 or +-65504 in a half channel, by 0 in a
        data channel.

    Raises:
        ValueError: no channel, or shapes that differ.
        OSError: the file could not be written; an older file under the name is still whole.
    """
    import OpenImageIO as oiio

    layers: list[list[tuple[str, np.ndarray, bool]]] = []
    for name, array in channels.items():
        array = np.asarray(array)
        if array.ndim not in (2, 3):
            raise ValueError(f"channel '{name}': got shape {array.shape}, expected [height, width] or [.., .., n]")
        is_half = name in half or name.rpartition(".")[0] in half
        layers.append([(suffix, plane, is_half) for suffix, plane in _split(name, array, is_half)])
    if not layers or 0 in layers[0][0][1].shape:
        raise ValueError(f"{path}: an image needs at least one channel and one pixel")
    height, width = layers[0][0][1].shape
    titles = list(channels)
    if not multi_part:
        layers, titles = [[plane for layer in layers for plane in layer]], [""]
    replaced, parts = 0, []
    for title, layer in zip(titles, layers, strict=True):
        planes = []
        for name, plane, is_half in layer:
            if plane.shape != (height, width):
                raise ValueError(f"channel '{name}': got shape {plane.shape}, expected {(height, width)} as the first")
            with np.errstate(over="ignore"):
                values = plane.astype(np.float32, copy=False)
            good = np.isfinite(values)
            if not good.all():
                replaced += int(good.size - np.count_nonzero(good))
                limit = HALF_MAX if is_half else 0.0
                values = np.nan_to_num(values, nan=0.0, posinf=limit, neginf=-limit)
            planes.append(np.clip(values, -HALF_MAX, HALF_MAX) if is_half else values)
        kinds = [is_half for _, _, is_half in layer]
        spec = oiio.ImageSpec(width, height, len(layer), oiio.HALF if all(kinds) else oiio.FLOAT)
        spec.channelnames = [name for name, _, _ in layer]
        if len(set(kinds)) > 1:  # of a file of several parts the library forgets formats that are all the same
            spec.channelformats = tuple(oiio.TypeDesc("half" if is_half else "float") for is_half in kinds)
        spec.attribute("compression", "zip")
        spec.attribute("oiio:ColorSpace", "lin_rec709_scene")
        spec.attribute("DateTime", "")  # the same frame is the same file
        if title:
            spec.attribute("oiio:subimagename", title)
        parts.append((spec, planes))
    texts: dict[str, bytes] = {}
    for name, value in (attributes or {}).items():
        if isinstance(value, int | float) and not isinstance(value, bool):
            parts[0][0].attribute(name, value)
            continue
        text = value.encode() if isinstance(value, str) else _filled_up(json.dumps(_jsonable(value)).encode())
        if text and name.startswith(OWN_ENTRIES):
            texts[name] = text
        parts[0][0].attribute(name, STAND_IN * len(text) if name in texts else text.decode())
    _write_whole(Path(path), "openexr", parts, texts)
    return replaced


def write_png(path: str | os.PathLike, rgb: np.ndarray, attributes: Mapping[str, str] | None = None) -> int:
    """Write linear colour as an 8-bit sRGB PNG (exposure 0, clipped to [0, 1]).

    Args:
        path: Where.
        rgb: Linear Rec.709, [height, width, 3 or 4] (straight alpha) or [height, width] (grey).
        attributes: Text entries of the header.

    Returns:
        Samples that were NaN or infinite and were replaced by 0 or 1.

    Raises:
        ValueError: another shape.
        OSError: as `write_exr`.
    """
    import OpenImageIO as oiio

    rgb = np.asarray(rgb)
    if rgb.ndim == 2:
        rgb = rgb[..., None]
    if rgb.ndim != 3 or rgb.shape[2] not in (1, 3, 4) or 0 in rgb.shape:
        raise ValueError(f"{path}: got an array of shape {rgb.shape}, expected [height, width, 1, 3 or 4]")
    with np.errstate(over="ignore"):
        values = rgb.astype(np.float32)
    replaced = int(values.size - np.count_nonzero(np.isfinite(values)))
    values = np.clip(np.nan_to_num(values, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    values[..., :3] = srgb_from_linear(values[..., :3])
    pixels = np.floor(values * 255.0 + 0.5).astype(np.uint8)
    height, width, channel_count = pixels.shape
    spec = oiio.ImageSpec(width, height, channel_count, oiio.UINT8)
    spec.attribute("oiio:ColorSpace", "srgb_rec709_scene")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("png:compressionLevel", PNG_LEVEL)
    spec.attribute("DateTime", "")
    texts = {name: str(value).encode() for name, value in (attributes or {}).items()}
    _write_whole(Path(path), "png", [(spec, [pixels[..., k] for k in range(channel_count)])], texts)
    return replaced


def read_exr(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Read the channels of a frame back, whatever their order in the file and over however many parts.

    Returns:
        (channels, attributes). `name.X .Y (.Z)` and `name.R .G .B (.A)` come back as one float32 array
        [height, width, 2..4] under `name`; every other channel as [height, width]. Attributes that hold
        a JSON list or object come back parsed.

    Raises:
        OSError: no such file, not a regular file, or not whole.
    """
    parts = _read_parts(Path(path), FRAME_LIMIT_MB)
    spec = parts[0][1]
    flat = {
        name: pixels[..., k]
        for pixels, part in parts
        if pixels.shape[:2] == parts[0][0].shape[:2]
        for k, name in enumerate(part.channelnames)
    }
    channels: dict[str, np.ndarray] = {}
    for name in flat:
        stem, dot, suffix = name.rpartition(".")
        for letters in ("XYZ", "XY", "RGBA", "RGB"):
            group = [f"{stem}.{letter}" for letter in letters]
            if dot and suffix in letters and all(member in flat for member in group):
                if stem not in channels:
                    channels[stem] = np.stack([flat[member] for member in group], axis=-1)
                break
        else:
            channels[name] = np.ascontiguousarray(flat[name])
    return channels, {item.name: _parsed(item.value) for item in spec.extra_attribs}


def check_whole(path: str | os.PathLike) -> dict[str, object]:
    """Decode every pixel of a picture of ours, all parts, and return the header's entries as `read_exr` does.

    Raises:
        OSError: no such file, not a regular file, or not whole.
    """
    return {item.name: _parsed(item.value) for item in _read_parts(Path(path), FRAME_LIMIT_MB)[0][1].extra_attribs}


def read_image(
    path: str | os.PathLike, color_space: str = "auto", size_limit_mb: int = SIZE_LIMIT_MB, signed: bool = False
) -> Picture:
    """Read a texture or an environment map.

    Args:
        path: Any format OpenImageIO reads; told apart by content.
        color_space: "auto", "sRGB" or "raw", as UsdUVTexture's `sourceColorSpace`: auto decodes 8-bit
            pictures of 3 or 4 channels as sRGB, and converts float pictures that declare other primaries
            (ACEScg ...) to Rec.709.
        size_limit_mb: Decoded size above which the file is refused; as floats, four times that. [MB]
        signed: Keep negative samples: directions, not light.

    Raises:
        ValueError: an unknown `color_space`.
        OSError: no such file, not a regular file, too large, or not whole; the text names the file.
    """
    if color_space not in ("auto", "sRGB", "raw"):
        raise ValueError(f"color_space: got '{color_space}', expected auto, sRGB or raw")
    try:
        return _read_picture(Path(path), color_space, size_limit_mb, signed)
    except MemoryError:
        # Below the limit as stored, one-bit samples take many times that as floats.
        raise OSError(f"{path}: cannot be read: not enough memory for its size") from None


def _read_picture(path: Path, color_space: str, size_limit_mb: int, signed: bool) -> Picture:
    pixels, spec = _read(path, size_limit_mb)
    names = [name.upper() for name in spec.channelnames]
    if not set("RGB") <= set(names):
        # A layered file without a main picture: its first layer that has all three.
        names = [name.rpartition(".")[2] for name in names]
    color = [names.index(letter) for letter in "RGB" if letter in names]
    if len(color) != 3:
        color = [names.index("Y")] * 3 if "Y" in names else [color[0] if color else 0] * 3
    rgb = np.ascontiguousarray(pixels[..., color])
    alpha = np.ascontiguousarray(pixels[..., names.index("A")]) if "A" in names else None
    bad = ~np.isfinite(rgb) if signed else ~(rgb >= 0.0) | (rgb > np.finfo(np.float32).max)
    distinct = bad if len(set(color)) == 3 else bad[..., :1]
    cleaned = int(np.count_nonzero(distinct))
    if cleaned:
        rgb[bad] = 0.0
    eight_bit = spec.format.size() == 1
    if color_space == "sRGB" or (color_space == "auto" and eight_bit and len(set(color)) == 3):
        rgb = linear_from_srgb(rgb)
    elif color_space == "auto" and spec.format.basetype in _float_types():
        primaries = _declared_primaries(spec)
        if primaries is not None:
            converted = rgb @ rec709_from_primaries(primaries).T.astype(np.float32)
            # Colours outside Rec.709 get a negative component; there is no negative light to reflect.
            rgb = np.maximum(converted, np.float32(0.0))
    if alpha is not None:
        alpha = np.clip(np.nan_to_num(alpha, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    return Picture(rgb.astype(np.float32, copy=False), cleaned, alpha)


def _float_types() -> tuple:
    import OpenImageIO as oiio

    return oiio.HALF, oiio.FLOAT, oiio.DOUBLE


def _declared_primaries(spec):
    """The primaries a float picture declares, None for Rec.709 or nothing."""
    declared = spec.getattribute("chromaticities")
    if declared is None or len(declared) != 8:
        declared = NAMED_PRIMARIES.get(spec.get_string_attribute("oiio:ColorSpace").lower())
    if declared is None or np.allclose(declared, REC709_PRIMARIES, atol=1e-3):  # 3 digits are what files write
        return None
    triangle = np.asarray(declared, float)[:6].reshape(3, 2)
    edges = triangle[1:] - triangle[0]
    area = abs(edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0])
    # Nonsense in a header is no reason to lose the picture.
    return declared if np.isfinite(area) and area > 1e-3 and declared[7] > 1e-3 else None


def _split(name: str, array: np.ndarray, is_color: bool) -> list[tuple[str, np.ndarray]]:
    if array.ndim == 2:
        return [(name, array)]
    components = array.shape[2]
    if name in ("RGB", "RGBA"):
        letters, prefix = name, ""
    else:
        letters, prefix = ("RGBA" if is_color else "XYZW"), f"{name}."
    if components > len(letters):
        raise ValueError(f"channel '{name}': got {components} components, expected at most {len(letters)}")
    return [(prefix + letters[k], array[..., k]) for k in range(components)]


def _jsonable(value):
    if isinstance(value, Mapping):
        return {str(key): _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _filled_up(text: bytes) -> bytes:
    """JSON with blanks at its end."""
    return text.ljust(-(-len(text) // TEXT_STEP) * TEXT_STEP)


def _put_png_texts(file: BinaryIO, texts: Mapping[str, bytes]) -> None:
    """Put texts in a PNG between its first chunk and the next (PNG Specification, 11.3.4)."""
    start, rest = file.read(PNG_START), file.read()
    file.seek(0)
    file.write(start)
    for name, text in texts.items():
        kind, between = (b"tEXt", b"\0") if text.isascii() else (b"iTXt", b"\0\0\0\0\0")
        content = kind + name.encode() + between + text
        file.write((len(content) - 4).to_bytes(4) + content + zlib.crc32(content).to_bytes(4))
    file.write(rest)


def _put_exr_texts(file: BinaryIO, texts: Mapping[str, bytes]) -> None:
    """Put texts in the place of their stand-ins of the same length in the first header of an EXR.

    An entry of a header is its name and its type, a zero byte after either, the length of its value in 4 bytes, and the
    value; an empty name ends the header (OpenEXR File Layout).
    """
    file.seek(EXR_START)
    left = dict(texts)
    while name := _until_zero(file):
        kind = _until_zero(file)
        length = int.from_bytes(file.read(4), "little")
        end = file.tell() + length
        text = left.pop(name.decode(), None)
        if text is not None:
            if kind != b"string" or length != len(text):
                raise OSError(f"header entry '{name.decode()}' came out as {length} bytes of {kind.decode()}")
            file.write(text)
        file.seek(end)
    if left:
        raise OSError(f"header entries {', '.join(left)} were left out")


PUT_TEXTS = {"openexr": _put_exr_texts, "png": _put_png_texts}


def _until_zero(file: BinaryIO) -> bytes:
    text = b""
    while (letter := file.read(1)) not in (b"\0", b""):
        text += letter
    return text


def _parsed(value):
    if isinstance(value, str) and value[:1] in ("[", "{"):
        try:
            return json.loads(value)
        except ValueError:
            return value
    return value


def remove_parts(path: str | os.PathLike) -> None:
    """Remove what killed processes left of a file half written; only for who knows that nobody is writing it."""
    final = Path(os.path.realpath(path))
    for part in final.parent.glob(f".{_part_mark(final)}-*.part"):
        part.unlink(missing_ok=True)


def _part_name(path: Path) -> Path:
    return path.parent / f".{_part_mark(path)}-{os.getpid()}-{next(_part_number)}.part"


def _part_mark(path: Path) -> str:
    """Stands for a name in the passing names of its file; the name itself may be as long as the system allows."""
    return hashlib.blake2b(path.name.encode(), digest_size=6).hexdigest()


def _write_whole(path: Path, format_name: str, parts: list[tuple], texts: Mapping[str, bytes] | None = None) -> None:
    """Write (spec, planes) parts under a passing name, read back, sync and rename: a reader never meets half a file.

    `texts` are put in its header after the reading back, which would keep them, too.

    The PNG writer returns success on a full disk and only `geterror` tells; a cut EXR keeps a valid header.
    """
    import OpenImageIO as oiio

    # A link stays a link: what it points at is replaced.
    final = Path(os.path.realpath(path))
    part = _part_name(final)
    try:
        output = oiio.ImageOutput.create(format_name)
        specs = tuple(spec for spec, _ in parts)
        rows = ROWS_AT_ONCE * max(oiio.get_int_attribute("threads"), 1)
        good = output.open(str(part), specs if len(specs) > 1 else specs[0])
        for number, (spec, planes) in enumerate(parts):
            if good and number:
                good = output.open(str(part), spec, "AppendSubimage")
            for first in range(0, spec.height, rows):
                end = min(first + rows, spec.height)
                good = good and output.write_scanlines(first, end, 0, np.stack([p[first:end] for p in planes], axis=-1))
        good = output.close() and good
        message = output.geterror()
        del output
        if not good or message:
            raise OSError(f"{path}: cannot be written: {_one_line(message, part) or 'the writer failed'}")
        _check_last_rows(path, part, specs)
        with open(part, "r+b") as file:
            if texts:
                PUT_TEXTS[format_name](file, texts)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, final)
        _sync_folder(final.parent)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, f"{path}: cannot be written: {os.strerror(error.errno)}") from None
    finally:
        part.unlink(missing_ok=True)


def _check_last_rows(path: Path, part: Path, specs) -> None:
    import OpenImageIO as oiio

    reader = oiio.ImageInput.open(str(part))
    for number, spec in enumerate(specs):
        row = None
        if reader and reader.seek_subimage(number, 0):
            row = reader.read_scanline(spec.height - 1, 0, oiio.UNKNOWN)
        message = reader.geterror() if reader else oiio.geterror()
        if row is None or message:
            raise OSError(f"{path}: cannot be written: the file came out cut (is the disk full?)")
    reader.close()


def _sync_folder(folder: Path) -> None:
    if not hasattr(os, "O_DIRECTORY"):
        return  # Windows cannot open a folder
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _one_line(message: str, part: Path | None = None) -> str:
    """First line of a library's text, without the passing name."""
    line = message.strip().splitlines()[0] if message.strip() else ""
    return line if part is None else line.replace(str(part), "the file")


def _read(path: Path, size_limit_mb: int):
    """(float32 [height, width, channels], spec) of a file's first part."""
    return next(_parts(path, size_limit_mb))


def _read_parts(path: Path, size_limit_mb: int) -> list[tuple]:
    """The same of every part."""
    return list(_parts(path, size_limit_mb))


def _parts(path: Path, size_limit_mb: int) -> Iterator[tuple]:
    import OpenImageIO as oiio

    try:
        # A pipe would block for ever.
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise OSError(f"{path}: cannot be read: not a regular file")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: cannot be read: no such file") from None
    oiio.attribute("limits:imagesize_MB", int(size_limit_mb))
    oiio.attribute("limits:resolution", SIDE_LIMIT)
    config = oiio.ImageSpec()
    # Formats that store colour apart from alpha are taken as stored: textures are not multiplied by their alpha.
    config.attribute("oiio:UnassociatedAlpha", 1)
    reader = oiio.ImageInput.open(str(path), config)
    if reader is None:
        raise OSError(f"{path}: cannot be read: {_one_line(oiio.geterror()) or 'no reader knows it'}")
    for number in count():
        if number and not reader.seek_subimage(number, 0):
            reader.geterror()  # that there is no further part is no fault
            break
        spec = reader.spec()
        # The library's own limit counts samples as stored: one-bit grey becomes 96 bits of colour a texel here.
        megabytes = spec.width * spec.height * max(spec.nchannels, 3) * 4 / 1e6
        if megabytes > FLOATS_PER_STORED * size_limit_mb:
            raise OSError(
                f"{path}: cannot be read: {spec.width} x {spec.height} texels are {megabytes:,.0f} MB as numbers, "
                f"at most {FLOATS_PER_STORED * size_limit_mb:,} MB are read; make it smaller"
            )
        pixels = reader.read_image(number, 0, 0, spec.nchannels, oiio.FLOAT)
        # A cut JPEG and a bad EXR chunk "succeed"; only the text says that the rest is grey.
        message = reader.geterror()
        if pixels is None or message:
            raise OSError(f"{path}: cannot be read: {_one_line(message) or 'the file is damaged'}")
        pixels = np.asarray(pixels, np.float32)
        yield (pixels[..., None] if pixels.ndim == 2 else pixels), spec
    reader.close()
