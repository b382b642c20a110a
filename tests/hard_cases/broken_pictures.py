"""Pictures of a few texels, whole and broken, written byte by byte: nothing of the package, no image library.

A whole picture is the seed that `hostile` cuts and flips; a header may claim any size.
"""

from __future__ import annotations

import struct
import zlib

SIDE = 8  # texels of a whole picture


def png(width: int = SIDE, height: int = SIDE, rows: bytes | None = None, depth: int = 8, color: int = 2) -> bytes:
    """A PNG; `rows` is its uncompressed data (by default a ramp), which need not fit the size claimed."""
    if rows is None:
        rows = b"".join(b"\0" + bytes((x * 30 + y * 7) % 256 for x in range(3 * SIDE)) for y in range(SIDE))
    header = struct.pack(">IIBBBBB", width & 0xFFFFFFFF, height & 0xFFFFFFFF, depth, color, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*chunk) for chunk in chunks)


def png_bomb(side: int = 20_000) -> bytes:
    """A PNG of side x side one-bit texels, all black: some kilobytes that claim far more."""
    packer = zlib.compressobj(1)
    row = bytes(1 + side // 8)
    data = b"".join(packer.compress(row * 1000) for _ in range(side // 1000)) + packer.flush()
    header = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def hdr(width: int = 2 * SIDE, height: int = SIDE) -> bytes:
    """A Radiance picture, uncompressed."""
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    return head + bytes((k * 13) % 255 for k in range(4 * 2 * SIDE * SIDE))


def exr(
    width: int = 2 * SIDE,
    height: int = SIDE,
    channels: tuple[str, ...] = ("B", "G", "R"),
    first: int = 0,
    fill: float = 0.5,
    compression: int = 0,
) -> bytes:
    """An OpenEXR of float scanlines; the size is what its header claims, the data is that of a small picture.

    Args:
        width: Claimed.
        height: Claimed.
        channels: Names in the order of the file.
        first: Left edge of the data window.
        fill: Every sample; may be NaN or infinite.
        compression: Its code; 0 is none, those above 9 do not exist.
    """
    chlist = b"".join(name.encode() + b"\0" + struct.pack("<iB3xii", 2, 0, 1, 1) for name in channels) + b"\0"
    window = struct.pack("<4i", first, 0, _int32(first + width - 1), _int32(height - 1))
    head = b"\x76\x2f\x31\x01" + struct.pack("<I", 2)
    for name, kind, data in (
        ("channels", "chlist", chlist),
        ("compression", "compression", bytes([compression])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ):
        head += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data
    head += b"\0"
    rows = min(max(height, 0), SIDE)
    line = struct.pack("<f", fill) * (min(max(width, 0), 2 * SIDE) * len(channels))
    start = len(head) + 8 * rows
    offsets = b"".join(struct.pack("<Q", start + k * (8 + len(line))) for k in range(rows))
    return head + offsets + b"".join(struct.pack("<ii", k, len(line)) + line for k in range(rows))


def _int32(value: int) -> int:
    return (value + 2**31) % 2**32 - 2**31


def bmp(width: int = SIDE, height: int = SIDE) -> bytes:
    """A Windows bitmap of 24 bits."""
    data = bytes(range(3 * SIDE)) * SIDE
    return (
        struct.pack("<2sIHHI", b"BM", 54 + len(data), 0, 0, 54)
        + struct.pack("<IiiHHIIiiII", 40, _int32(width), _int32(height), 1, 24, 0, len(data), 2835, 2835, 0, 0)
        + data
    )


def ppm(width: int = SIDE, height: int = SIDE) -> bytes:
    """A portable pixmap."""
    return f"P6\n{width} {height}\n255\n".encode() + bytes(range(3 * SIDE)) * SIDE


def tga(width: int = SIDE, height: int = SIDE) -> bytes:
    """A Targa of 24 bits."""
    return struct.pack("<BBBHHBHHHHBB", 0, 0, 2, 0, 0, 0, 0, 0, width, height, 24, 0) + bytes(range(3 * SIDE)) * SIDE


def tiff(width: int = SIDE, height: int = SIDE, next_directory: int = 0) -> bytes:
    """A TIFF of one uncompressed strip; `next_directory` may point back at itself (8) for a loop."""
    data = bytes(range(3 * SIDE)) * SIDE
    tags = [
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (273, 4, 1, 8 + 2 + 12 * 9 + 4),
        (277, 3, 1, 3),
        (278, 4, 1, height),
        (279, 4, 1, len(data)),
    ]
    head = struct.pack("<2sHIH", b"II", 42, 8, len(tags))
    head += b"".join(struct.pack("<HHII", *tag) for tag in tags) + struct.pack("<I", next_directory)
    return head + data


WHOLE = {"png": png, "exr": exr, "hdr": hdr, "bmp": bmp, "ppm": ppm, "tga": tga, "tif": tiff}
