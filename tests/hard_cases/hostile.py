"""Hostile stages and pictures, written into a folder by families; everything is made here, nothing is stored.

A case is a folder with a root file. What is expected of reading it: `refused` (one line), `noted` (the bad prim is
named and dropped or repaired, its good neighbour stays), `read` (nothing is wrong with it), `either` (damage at random
places: any of these) or `crash` (the same, and the USD library may die of it, in a process of its own).
"""

from __future__ import annotations

import os
import random
import struct
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import broken_pictures

REFUSED, NOTED, READ, EITHER, CRASH = "refused", "noted", "read", "either", "crash"
HEAD = '#usda 1.0\n(\n    upAxis = "Y"\n    metersPerUnit = 1\n    startTimeCode = 0\n    endTimeCode = 3\n)\n'
# The neighbour that must survive whatever is wrong beside it.
GOOD = """def Mesh "Good" {
    point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    uniform token subdivisionScheme = "none"
}
"""
POINTS = "[(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]"
HUGE = 1_000_000_000


CLIPS = """clips = {{ dictionary default = {{
    asset[] assetPaths = [{}]
    string primPath = "{}"
    double2[] active = [{}]
    double2[] times = [{}]
}} }}"""


@dataclass(frozen=True)
class Case:
    """One hostile input.

    Attributes:
        family: Which generator it comes from.
        name: Unique in its family.
        path: Root file.
        expect: One of the words above.
        culprit: Text that the refusal, or one of the notes, must contain.
        times: Time codes to read; None is the stage's first.
    """

    family: str
    name: str
    path: Path
    expect: str
    culprit: str
    times: tuple[float | None, ...] = (None,)


@dataclass
class Draft:
    """A case before it is written: file name -> content, or a function that makes the file there."""

    name: str
    files: dict[str, bytes | str | Callable[[Path], None]]
    expect: str
    culprit: str = ""
    times: tuple[float | None, ...] = (None,)
    root: str = "stage.usda"


FAMILIES: dict[str, Callable[[int], Iterator[Draft]]] = {}


def family(make):
    FAMILIES[make.__name__.replace("_", "-")] = make
    return make


def write(folder: Path, mutants: int, families: tuple[str, ...] = ()) -> list[Case]:
    """Write the corpus; `mutants` is the number of randomly damaged files a family of those has."""
    cases = []
    for kind, make in FAMILIES.items():
        if families and kind not in families:
            continue
        for draft in make(mutants):
            place = folder / kind / draft.name
            place.mkdir(parents=True)
            for file, content in draft.files.items():
                target = place / file
                target.parent.mkdir(parents=True, exist_ok=True)
                if callable(content):
                    content(target)
                else:
                    target.write_bytes(content.encode() if isinstance(content, str) else content)
            cases.append(Case(kind, draft.name, place / draft.root, draft.expect, draft.culprit, draft.times))
    return cases


def stage(body: str, head: str = HEAD) -> dict[str, str]:
    return {"stage.usda": head + GOOD + body}


def prim(kind: str, inside: str, name: str = "Bad", meta: str = "") -> str:
    return f'def {kind} "{name}" {f"({meta})" if meta else ""} {{\n    {inside}\n}}\n'


def mesh(points: str = POINTS, counts: str = "[4]", indices: str = "[0, 1, 2, 3]", more: str = "") -> str:
    inside = f"""point3f[] points = {points}
    int[] faceVertexCounts = {counts}
    int[] faceVertexIndices = {indices}
    uniform token subdivisionScheme = "none"
    {more}"""
    return prim("Mesh", inside)


# --- values of geometry


@family
def mesh_points(_: int) -> Iterator[Draft]:
    for value in ("nan", "inf", "-inf", "1e39", "1e30", "-1e13"):
        for at, corner in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
            corners = [f"({x}, {y}, 0)" for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            corners[at] = f"({corner[0]}, {value}, 0)"
            yield Draft(f"{value}-at-{at}", stage(mesh(f"[{', '.join(corners)}]")), NOTED, "/Bad")


@family
def mesh_indices(_: int) -> Iterator[Draft]:
    for value in (-1, 4, 5, 99_999_999, 2**31 - 1, -(2**31)):
        for at in range(4):
            indices = [0, 1, 2, 3]
            indices[at] = value
            yield Draft(f"{value}-at-{at}", stage(mesh(indices=str(indices))), NOTED, "/Bad")


@family
def mesh_counts(_: int) -> Iterator[Draft]:
    for counts in (
        [-4],
        [8, -4],
        [2**31 - 1, 2**31 - 1, 6],
        [5],
        [3],
        [4, 1],
        [2**31 - 1],
        [-(2**31)],
        [3, 3],
        [0],
        [1, 3],
        [2, 2],
        [-1, -1, 6],
        [4, 4],
        [1, 1, 1, 1],
        [4, 0, 0],
        [4, -1, 1],
    ):
        expect = NOTED if counts != [4, 0, 0] else EITHER
        yield Draft("-".join(map(str, counts)).replace("--", "-m"), stage(mesh(counts=str(counts))), expect, "/Bad")


@family
def mesh_empty(_: int) -> Iterator[Draft]:
    for name, text in {
        "no-points": mesh("[]"),
        "points-none": mesh("None"),
        "counts-empty": mesh(counts="[]"),
        "counts-none": mesh(counts="None"),
        "indices-empty": mesh(indices="[]"),
        "indices-none": mesh(indices="None"),
        "all-empty": mesh("[]", "[]", "[]"),
        "nothing-authored": prim("Mesh", ""),
        "points-alone": prim("Mesh", f"point3f[] points = {POINTS}"),
        "one-point": mesh("[(0, 0, 0)]", "[3]", "[0, 0, 0]"),
    }.items():
        yield Draft(name, stage(text), EITHER if name == "one-point" else NOTED, "/Bad")


WRONG_VALUES = {
    "string": '"abc"',
    "int": "7",
    "double3[]": POINTS,
    "float[]": "[0, 1, 2, 3]",
    "token[]": '["a", "b"]',
    "asset": "@x.png@",
    "matrix4d": "((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))",
    "bool[]": "[1, 0, 1]",
    "int64[]": "[0, 1, 9223372036854775807, -9223372036854775808]",
    "uchar[]": "[0, 1, 255]",
}


@family
def mesh_types(_: int) -> Iterator[Draft]:
    plain = {
        "points": f"point3f[] points = {POINTS}",
        "faceVertexCounts": "int[] faceVertexCounts = [4]",
        "faceVertexIndices": "int[] faceVertexIndices = [0, 1, 2, 3]",
    }
    for attribute in (*plain, "normals", "holeIndices", "creaseIndices", "orientation", "primvars:displayColor"):
        for kind, value in WRONG_VALUES.items():
            lines = [line for name, line in plain.items() if name != attribute]
            lines.append(f"{kind} {attribute} = {value}")
            yield Draft(
                f"{attribute}-{kind}".replace(":", "-").replace("[]", "s"),
                stage(prim("Mesh", "\n    ".join(lines))),
                EITHER,
            )


@family
def mesh_degenerate(_: int) -> Iterator[Draft]:
    fan = ", ".join(f"({k % 97}, {k % 89}, 0)" for k in range(70_000))
    for name, text in {
        "zero-area": mesh("[(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]"),
        "all-equal": mesh("[(1, 1, 1), (1, 1, 1), (1, 1, 1), (1, 1, 1)]"),
        "repeated-corner": mesh(indices="[0, 1, 1, 0]"),
        "duplicate-faces": mesh(counts="[4, 4, 4]", indices="[0, 1, 2, 3, 0, 1, 2, 3, 3, 2, 1, 0]"),
        "three-faces-at-an-edge": mesh(counts="[3, 3, 3]", indices="[0, 1, 2, 0, 1, 3, 1, 0, 2]"),
        "crossing-quad": mesh(indices="[0, 2, 1, 3]"),
        "tiny": mesh("[(0, 0, 0), (1e-30, 0, 0), (1e-30, 1e-30, 0), (0, 1e-30, 0)]"),
        "denormal": mesh("[(0, 0, 0), (1e-44, 0, 0), (1e-44, 1e-44, 0), (0, 1e-44, 0)]"),
        "needle": mesh("[(0, 0, 0), (1e6, 0, 0), (1e6, 1e-6, 0), (0, 1e-6, 0)]"),
        "many-corners": mesh(f"[{fan}]", "[70000]", f"[{', '.join(map(str, range(70_000)))}]"),
        "catmull-clark-of-one-triangle": mesh(counts="[3]", indices="[0, 1, 2]").replace('"none"', '"catmullClark"'),
        "catmull-clark-non-manifold": mesh(counts="[3, 3, 3]", indices="[0, 1, 2, 0, 1, 3, 1, 0, 2]").replace(
            '"none"', '"catmullClark"'
        ),
        "unknown-scheme": mesh().replace('"none"', '"magic"'),
        "holes-out-of-range": mesh(more="int[] holeIndices = [-1, 7, 2147483647]"),
        "creases-out-of-range": mesh(
            more="int[] creaseIndices = [0, 99]\n    int[] creaseLengths = [2]\n    float[] creaseSharpnesses = [nan]"
        ).replace('"none"', '"catmullClark"'),
        "crease-lengths-negative": mesh(
            more="int[] creaseIndices = [0, 1]\n    int[] creaseLengths = [-2]\n    float[] creaseSharpnesses = [1]"
        ).replace('"none"', '"catmullClark"'),
        "wrong-extent": mesh(more="float3[] extent = [(nan, nan, nan), (-1, inf, 0)]"),
        "subset-out-of-range": mesh(
            more='def GeomSubset "S" {\n uniform token elementType = "face"\n int[] indices = [-1, 5, 2147483647]\n}'
        ),
        "subset-of-itself": mesh(
            more='def GeomSubset "S" {\n uniform token elementType = "point"\n int[] indices = [0]\n}'
        ),
    }.items():
        yield Draft(name, stage(text), EITHER)


@family
def primvars(_: int) -> Iterator[Draft]:
    for attribute, kind, value in (
        ("primvars:displayColor", "color3f[]", "[(nan, 0, 0), (inf, 1, 1)]"),
        ("primvars:st", "texCoord2f[]", "[(nan, 0), (1e38, -1e38), (inf, 0)]"),
        ("normals", "normal3f[]", "[(0, 0, 0), (nan, 0, 1)]"),
        ("primvars:displayOpacity", "float[]", "[nan, -1, 7]"),
        ("primvars:st:indices", "int[]", "[-1, 9, 2147483647]"),
    ):
        for interpolation in ("constant", "uniform", "vertex", "varying", "faceVarying", "sideways"):
            more = f'{kind} {attribute} = {value} (interpolation = "{interpolation}")'
            if attribute.endswith("indices"):
                st = "texCoord2f[] primvars:st = [(0, 0), (1, 1)]"
                more = f'{st} (interpolation = "{interpolation}")\n    {kind} {attribute} = {value}'
            yield Draft(f"{attribute.replace(':', '-')}-{interpolation}", stage(mesh(more=more)), EITHER)
    for size in (-1, 0, 2**31 - 1):
        more = f'texCoord2f[] primvars:st = [(0, 0)] (elementSize = {size}; interpolation = "vertex")'
        yield Draft(f"element-size-{size}", stage(mesh(more=more)), EITHER)


def xform(ops: dict[str, str], order: str | None = None) -> str:
    lines = [f"{name} = {value}" for name, value in ops.items()]
    names = order if order is not None else ", ".join(f'"{name.split()[1]}"' for name in ops)
    return prim(
        "Mesh",
        "\n    ".join([*lines, f"uniform token[] xformOpOrder = [{names}]"])
        + mesh().split("{", 1)[1].rsplit("}", 1)[0],
    )


@family
def transforms(_: int) -> Iterator[Draft]:
    bad = {
        "translate-nan": {"double3 xformOp:translate": "(nan, 0, 0)"},
        "translate-inf": {"double3 xformOp:translate": "(0, inf, 0)"},
        "translate-1e300": {"double3 xformOp:translate": "(1e300, 0, 0)"},
        "translate-1e39": {"double3 xformOp:translate": "(0, 1e39, 0)"},
        "scale-zero": {"float3 xformOp:scale": "(0, 0, 0)"},
        "scale-flat": {"float3 xformOp:scale": "(1, 0, 1)"},
        "scale-nan": {"float3 xformOp:scale": "(1, nan, 1)"},
        "scale-1e300": {"double3 xformOp:scale": "(1e300, 1e300, 1e300)"},
        "scale-1e-14-of-an-axis": {"double3 xformOp:scale": "(1, 1, 1e-14)"},
        "rotate-nan": {"float3 xformOp:rotateXYZ": "(nan, 0, 0)"},
        "rotate-inf": {"float xformOp:rotateX": "inf"},
        "orient-zero": {"quatf xformOp:orient": "(0, 0, 0, 0)"},
        "orient-nan": {"quatf xformOp:orient": "(nan, 0, 0, 0)"},
        "matrix-zero": {"matrix4d xformOp:transform": "((0,0,0,0),(0,0,0,0),(0,0,0,0),(0,0,0,0))"},
        "matrix-projective": {"matrix4d xformOp:transform": "((1,0,0,1),(0,1,0,0),(0,0,1,0),(0,0,0,1))"},
        "matrix-last-two": {"matrix4d xformOp:transform": "((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,2))"},
        "matrix-nan": {"matrix4d xformOp:transform": "((1,0,0,0),(0,nan,0,0),(0,0,1,0),(0,0,0,1))"},
        "matrix-rank-two": {"matrix4d xformOp:transform": "((1,1,0,0),(1,1,0,0),(0,0,1,0),(0,0,0,1))"},
    }
    for name, ops in bad.items():
        # The library itself turns a quaternion without a length into no rotation.
        still = name.startswith("orient-")
        yield Draft(name, stage(xform(ops)), READ if still else NOTED, "" if still else "/Bad")
    inverted = xform({"float3 xformOp:scale": "(0, 1, 1)"}, '"!invert!xformOp:scale"')
    yield Draft("inverse-of-zero", stage(inverted), NOTED, "/Bad")
    fine = {
        "mirrored": {"float3 xformOp:scale": "(-1, 1, 1)"},
        "sheared": {"matrix4d xformOp:transform": "((1,0,0,0),(5,1,0,0),(0,0,1,0),(0,0,0,1))"},
        "far": {"double3 xformOp:translate": "(1e7, -1e7, 1e7)"},
        "small": {"float3 xformOp:scale": "(1e-6, 1e-6, 1e-6)"},
    }
    for name, ops in fine.items():
        yield Draft(name, stage(xform(ops)), READ)
    odd = {
        "op-of-another-type": xform({"string xformOp:translate": '"far"'}),
        "op-missing": xform({}, '"xformOp:translate"'),
        "op-twice": xform({"double3 xformOp:translate": "(1, 2, 3)"}, '"xformOp:translate", "xformOp:translate"'),
        "op-unknown": xform({"double3 xformOp:jump": "(1, 2, 3)"}),
        "reset-in-the-middle": xform(
            {"double3 xformOp:translate": "(1, 2, 3)"}, '"xformOp:translate", "!resetXformStack!"'
        ),
        "order-of-another-type": prim("Mesh", "int xformOpOrder = 3" + mesh().split("{", 1)[1].rsplit("}", 1)[0]),
        "order-without-values": xform({}, '"xformOp:scale:", ":", "", "!invert!"'),
    }
    for name, text in odd.items():
        yield Draft(name, stage(text), EITHER)


@family
def gprims(_: int) -> Iterator[Draft]:
    sizes = {
        "Sphere": ("radius",),
        "Cube": ("size",),
        "Cylinder": ("radius", "height"),
        "Cone": ("radius", "height"),
        "Capsule": ("radius", "height"),
        "Plane": ("width", "length"),
    }
    for kind, attributes in sizes.items():
        for attribute in attributes:
            for value in ("nan", "inf", "-1", "0", "1e30", "1e-30"):
                expect = EITHER if value in ("1e-30", "0") else NOTED
                text = prim(kind, f"double {attribute} = {value}")
                yield Draft(f"{kind}-{attribute}-{value}", stage(text), expect, "/Bad" if expect is NOTED else "")
    for kind in ("Cylinder", "Cone", "Capsule", "Plane"):
        yield Draft(f"{kind}-axis-Q", stage(prim(kind, 'uniform token axis = "Q"')), NOTED, "/Bad")
    for kind, attribute in (("Sphere", "radius"), ("Cube", "size"), ("Cone", "height")):
        for wrong, value in (("string", '"big"'), ("int[]", "[1, 2]"), ("float3", "(1, 2, 3)")):
            name = f"{kind}-{attribute}-{wrong}".replace("[]", "s")
            yield Draft(name, stage(prim(kind, f"{wrong} {attribute} = {value}")), EITHER)


@family
def cameras(_: int) -> Iterator[Draft]:
    for attribute, values in {
        "float focalLength": ("0", "-50", "nan", "inf", "1e38", "1e-38"),
        "float horizontalAperture": ("0", "-1", "nan", "inf"),
        "float verticalAperture": ("0", "-1", "nan", "1e-38"),
        "float2 clippingRange": ("(0, 0)", "(-1, -10)", "(100, 1)", "(nan, 1)", "(1, inf)", "(1e-38, 1e38)", "(5, 5)"),
        "token projection": ('"fisheye"', '"orthographic"', '""'),
        "float horizontalApertureOffset": ("nan", "inf", "1e38"),
        "float fStop": ("nan", "-1", "inf"),
        "float focusDistance": ("nan", "-1"),
        "string clippingRange": ('"near"',),
        "double3 focalLength": ("(1, 2, 3)",),
    }.items():
        for k, value in enumerate(values):
            name = f"{attribute.split()[1]}-{attribute.split()[0]}-{k}"
            yield Draft(name, stage(prim("Camera", f"{attribute} = {value}")), EITHER)


@family
def lights(_: int) -> Iterator[Draft]:
    for kind, attribute, values in (
        ("DistantLight", "float inputs:intensity", ("nan", "inf", "-1", "1e38")),
        ("DistantLight", "float inputs:angle", ("nan", "-5", "1e9")),
        ("SphereLight", "float inputs:radius", ("nan", "0", "-1", "inf", "1e-30")),
        ("RectLight", "float inputs:width", ("nan", "0", "-1", "inf")),
        ("DiskLight", "float inputs:radius", ("nan", "0", "-2")),
        ("CylinderLight", "float inputs:length", ("nan", "0", "inf")),
        ("DomeLight", "color3f inputs:color", ("(nan, 1, 1)", "(-1, 0, 0)", "(1e38, 1e38, 1e38)")),
        ("DomeLight", "float inputs:exposure", ("nan", "1e6", "-1e6")),
        ("DomeLight", "float inputs:colorTemperature", ("0", "-3", "nan", "1e30")),
        ("DomeLight", "token inputs:texture:format", ('"angular-moebius"', '""')),
        ("DomeLight", "asset inputs:texture:file", ("@nowhere.exr@", "@.@", "@@", "@/dev/null@", "@/dev/zero@")),
        ("DistantLight", "string inputs:intensity", ('"bright"',)),
    ):
        for k, value in enumerate(values):
            inside = f"{attribute} = {value}\n    bool inputs:enableColorTemperature = 1"
            name = f"{kind}-{attribute.split()[1].replace(':', '-')}-{attribute.split()[0]}-{k}"
            yield Draft(name, stage(prim(kind, inside)), EITHER)


BOUND = f"""point3f[] points = {POINTS}
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    rel material:binding = </M>"""


def material(surface: str, more: str = "", output: str = "</M/S.outputs:surface>") -> str:
    return f"""def Material "M" {{
    token outputs:surface.connect = {output}
    def Shader "S" {{
        uniform token info:id = "UsdPreviewSurface"
        {surface}
        token outputs:surface
    }}
    {more}
}}
{prim("Mesh", BOUND, meta='prepend apiSchemas = ["MaterialBindingAPI"]')}"""


def texture(asset: str, source: str = "rgb") -> str:
    reader = f"""def Shader "T" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{asset}@
        float2 inputs:st.connect = </M/R.outputs:result>
        float3 outputs:rgb
        float outputs:r
    }}
    def Shader "R" {{
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }}"""
    text = material(f"color3f inputs:diffuseColor.connect = </M/T.outputs:{source}>", reader)
    st = 'texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")'
    return text.replace("rel material:binding", f"{st}\n    rel material:binding")


@family
def materials(_: int) -> Iterator[Draft]:
    for name, value in {
        "roughness-nan": "float inputs:roughness = nan",
        "roughness-negative": "float inputs:roughness = -4",
        "roughness-huge": "float inputs:roughness = 1e38",
        "metallic-inf": "float inputs:metallic = inf",
        "color-nan": "color3f inputs:diffuseColor = (nan, 0, 0)",
        "color-huge": "color3f inputs:diffuseColor = (1e38, 1e38, 1e38)",
        "ior-zero": "float inputs:ior = 0",
        "ior-nan": "float inputs:ior = nan",
        "emissive-inf": "color3f inputs:emissiveColor = (inf, 0, 0)",
        "opacity-nan": "float inputs:opacity = nan",
        "normal-zero": "normal3f inputs:normal = (0, 0, 0)",
        "metallic-string": 'string inputs:metallic = "much"',
        "color-matrix": "matrix4d inputs:diffuseColor = ((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1))",
        "workflow-huge": "int inputs:useSpecularWorkflow = 2147483647",
        "connected-to-itself": "float inputs:roughness.connect = </M/S.inputs:roughness>",
        "connected-to-nothing": "float inputs:roughness.connect = </Nowhere.outputs:r>",
        "connected-in-a-ring": "float inputs:roughness.connect = </M.inputs:a>\n"
        " float inputs:metallic.connect = </M/S.inputs:roughness>",
        "connected-to-a-prim": "float inputs:roughness.connect = </Good>",
        "connected-to-many": "float inputs:roughness.connect = [</M.inputs:a>, </M.inputs:b>, </Good.points>]",
    }.items():
        more = "float inputs:a.connect = </M.inputs:b>\n    float inputs:b.connect = </M.inputs:a>"
        yield Draft(name, stage(material(value, more)), EITHER)
    for name, output in {
        "output-to-itself": "</M.outputs:surface>",
        "output-to-nothing": "</Nowhere.outputs:surface>",
        "output-to-a-mesh": "</Good.points>",
        "output-to-the-root": "</>",
    }.items():
        yield Draft(name, stage(material("", output=output)), EITHER)
    for name, asset in {
        "texture-missing": "nowhere.png",
        "texture-is-a-folder": ".",
        "texture-is-the-stage": "stage.usda",
        "texture-escapes": "../../../../../../../../etc/passwd",
        "texture-is-absolute": "/etc/passwd",
        "texture-is-a-device": "/dev/zero",
        "texture-of-a-package": "stage.usda[inside.png]",
        "texture-without-a-name": "",
        "texture-with-a-long-name": "a" * 5000 + ".png",
        "texture-of-tiles": "missing.<UDIM>.png",
        "texture-of-an-address": "http://localhost:1/x.png",
    }.items():
        # No picture outside the stage's folder is opened when confined: noted, never shown.
        escapes = name in ("texture-escapes", "texture-is-absolute", "texture-is-a-device")
        yield Draft(name, stage(texture(asset)), NOTED if escapes else EITHER, "/M" if escapes else "")
    pipe = stage(texture("pipe.png")) | {"pipe.png": os.mkfifo}
    yield Draft("texture-is-a-pipe", pipe, NOTED, "pipe.png")
    empty = stage(texture("empty.png")) | {"empty.png": b""}
    yield Draft("texture-is-empty", empty, NOTED, "empty.png")
    for name, binding in {
        "bound-to-itself": "</Bad>",
        "bound-to-nothing": "</Nowhere>",
        "bound-to-a-property": "</Good.points>",
        "bound-to-many": "[</M>, </Good>, </Bad>]",
    }.items():
        text = material("").replace("material:binding = </M>", f"material:binding = {binding}")
        yield Draft(name, stage(text), EITHER)


@family
def metadata(_: int) -> Iterator[Draft]:
    def head(line: str) -> dict[str, str]:
        return stage("", f"#usda 1.0\n(\n    {line}\n)\n")

    for name, values in {
        "metersPerUnit": ("0", "-1", "nan", "inf", "1e300", "1e-300", '"one"'),
        "upAxis": ('"X"', '"Q"', '""', "3"),
        "timeCodesPerSecond": ("0", "-1", "nan", "inf", '"fast"'),
        "startTimeCode": ("nan", "inf", "1e300"),
        "endTimeCode": ("nan", "-1e300"),
        "defaultPrim": ('"Nowhere"', '""', '"/../.."'),
        "subLayers": ("[]", "[@@]", "[@.@]", "[@/@]"),
        "framesPerSecond": ("0", "nan"),
        "customLayerData": ('{\n dictionary warp_reflect = {\n string techniques = "none"\n }\n }',),
        "renderSettingsPrimPath": ('"/Nowhere"', '"not a path"'),
    }.items():
        for k, value in enumerate(values):
            yield Draft(f"{name}-{k}", head(f"{name} = {value}"), EITHER)


@family
def time_samples(_: int) -> Iterator[Draft]:
    times = (None, 0.0, 1.0, 1.5, 2.0, -1e300, 1e300)
    plain = mesh()
    for name, old, new in (
        (
            "points-of-other-lengths",
            f"points = {POINTS}",
            f"points.timeSamples = {{0: {POINTS}, 1: [(0, 0, 0)], 2: []}}",
        ),
        ("points-blocked", f"points = {POINTS}", f"points.timeSamples = {{0: {POINTS}, 1: None, 2: {POINTS}}}"),
        (
            "points-nan-later",
            f"points = {POINTS}",
            f"points.timeSamples = {{0: {POINTS}, 2: [(nan, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]}}",
        ),
        (
            "indices-out-of-range-later",
            "faceVertexIndices = [0, 1, 2, 3]",
            "faceVertexIndices.timeSamples = {0: [0, 1, 2, 3], 1: [0, 1, 2, 99], 2: [-1, 1, 2, 3]}",
        ),
        (
            "counts-negative-later",
            "faceVertexCounts = [4]",
            "faceVertexCounts.timeSamples = {0: [4], 1: [8, -4], 2: []}",
        ),
        (
            "indices-of-other-lengths",
            "faceVertexIndices = [0, 1, 2, 3]",
            "faceVertexIndices.timeSamples = {0: [0, 1, 2, 3], 1: [0, 1, 2], 2: [0, 1, 2, 3, 0]}",
        ),
        ("time-nan", f"points = {POINTS}", f"points.timeSamples = {{nan: {POINTS}, 1: {POINTS}}}"),
        ("time-inf", f"points = {POINTS}", f"points.timeSamples = {{0: {POINTS}, inf: {POINTS}, -inf: {POINTS}}}"),
        ("no-samples", f"points = {POINTS}", "points.timeSamples = {}"),
        (
            "ten-thousand-samples",
            f"points = {POINTS}",
            f"points.timeSamples = {{{', '.join(f'{k}: {POINTS}' for k in range(10_000))}}}",
        ),
    ):
        yield Draft(name, stage(plain.replace(old, new)), EITHER, times=times)
    moving = xform({"double3 xformOp:translate": "(0, 0, 0)"}).replace(
        "translate = (0, 0, 0)", "translate.timeSamples = {0: (0, 0, 0), 1: (nan, 0, 0), 2: (1e300, 0, 0), 3: None}"
    )
    yield Draft("transform-nan-later", stage(moving), EITHER, times=(*times, 3.0))
    growing = prim("Sphere", "double radius.timeSamples = {0: 1, 1: nan, 2: -3}")
    yield Draft("radius-nan-later", stage(growing), EITHER, times=times)
    clips = CLIPS.format("@nowhere.usda@, @stage.usda@", "/Bad", "(0, 9), (1, 1)", "(0, nan)")
    yield Draft("clips-out-of-range", stage(plain.replace('"Bad"', f'"Bad" ({clips})')), EITHER, times=times)


@family
def instancers(_: int) -> Iterator[Draft]:
    proto = 'def Sphere "P" {\n double radius = 0.1\n }'
    fields = {
        "prototypes": "rel prototypes = [</Bad/P>]",
        "protoIndices": "int[] protoIndices = [0, 0]",
        "positions": "point3f[] positions = [(0, 0, 0), (1, 0, 0)]",
    }
    for name, change in {
        "index-out-of-range": {"protoIndices": "int[] protoIndices = [0, 7]"},
        "index-negative": {"protoIndices": "int[] protoIndices = [-1, 0]"},
        "index-huge": {"protoIndices": "int[] protoIndices = [2147483647, -2147483648]"},
        "more-indices": {"protoIndices": "int[] protoIndices = [0, 0, 0]"},
        "no-indices": {"protoIndices": ""},
        "no-positions": {"positions": ""},
        "no-prototypes": {"prototypes": ""},
        "prototypes-missing": {"prototypes": "rel prototypes = [</Nowhere>]"},
        "prototype-is-itself": {"prototypes": "rel prototypes = [</Bad>]"},
        "prototype-is-the-root": {"prototypes": "rel prototypes = [</>]"},
        "prototype-is-a-property": {"prototypes": "rel prototypes = [</Good.points>]"},
        "positions-nan": {"positions": "point3f[] positions = [(nan, 0, 0), (1, inf, 0)]"},
        "positions-huge": {"positions": "point3f[] positions = [(1e38, 0, 0), (1, 1e30, 0)]"},
        "orientations-zero": {"orientations": "quath[] orientations = [(0, 0, 0, 0), (nan, 0, 0, 0)]"},
        "orientations-of-another-length": {"orientations": "quath[] orientations = [(1, 0, 0, 0)]"},
        "scales-zero": {"scales": "float3[] scales = [(0, 0, 0), (1, 0, 1)]"},
        "scales-nan": {"scales": "float3[] scales = [(nan, 1, 1), (inf, 1, 1)]"},
        "scales-of-another-length": {"scales": "float3[] scales = [(1, 1, 1)]"},
        "velocities-nan": {"velocities": "vector3f[] velocities = [(nan, 0, 0), (0, inf, 0)]"},
        "hidden-out-of-range": {"invisibleIds": "int64[] invisibleIds = [-1, 99, 9223372036854775807]"},
        "ids-twice": {"ids": "int64[] ids = [5, 5]\n int64[] invisibleIds = [5]"},
        "positions-of-strings": {"positions": 'string[] positions = ["a", "b"]'},
    }.items():
        inside = "\n    ".join([*(fields | change).values(), proto])
        yield Draft(name, stage(prim("PointInstancer", inside)), EITHER)


@family
def points_and_curves(_: int) -> Iterator[Draft]:
    for name, inside in {
        "points-nan": ("Points", "point3f[] points = [(nan, 0, 0), (1, 0, 0)]\n float[] widths = [1, 1]"),
        "widths-nan": ("Points", "point3f[] points = [(0, 0, 0), (1, 0, 0)]\n float[] widths = [nan, -1]"),
        "widths-of-another-length": (
            "Points",
            "point3f[] points = [(0, 0, 0), (1, 0, 0)]\n float[] widths = [1, 2, 3]",
        ),
        "widths-huge": ("Points", "point3f[] points = [(0, 0, 0)]\n float[] widths = [1e38]"),
        "widths-zero": ("Points", "point3f[] points = [(0, 0, 0)]\n float[] widths = [0]"),
        "no-points": ("Points", ""),
        "curves-negative": ("BasisCurves", "int[] curveVertexCounts = [-5]\n point3f[] points = [(0, 0, 0)]"),
        "patch": ("NurbsPatch", "int uOrder = -1\n int vOrder = 2147483647"),
        "volume": ("Volume", "rel field:density = </Nowhere>"),
    }.items():
        yield Draft(name, stage(prim(*inside)), EITHER)


# --- composition


@family
def cycles(_: int) -> Iterator[Draft]:
    for name, text in {
        "references-itself": 'def "Bad" (references = </Bad>) {\n}\n',
        "references-its-child": 'def "Bad" (references = </Bad/C>) {\n def "C" {\n }\n}\n',
        "references-its-parent": 'def "Bad" {\n def "C" (references = </Bad>) {\n }\n}\n',
        "references-in-a-ring": "".join(f'def "R{k}" (references = </R{(k + 1) % 9}>) {{\n}}\n' for k in range(9)),
        "inherits-itself": 'class "Bad" (inherits = </Bad>) {\n}\n',
        "inherits-in-a-ring": 'class "A" (inherits = </B>) {\n}\nclass "B" (inherits = </A>) {\n}\n'
        'def "C" (inherits = </A>) {\n}\n',
        "specializes-in-a-ring": 'def "A" (specializes = </B>) {\n}\ndef "B" (specializes = </A>) {\n}\n',
        "payload-of-itself": 'def "Bad" (payload = </Bad>) {\n}\n',
        "payload-of-the-file": 'def "Bad" (payload = @stage.usda@</Bad>) {\n}\n',
        "reference-of-the-file": 'def "Bad" (references = @./stage.usda@</Good>) {\n}\n',
        "instance-of-itself": 'def "Bad" (instanceable = true; references = </Bad>) {\n}\n',
        "instances-in-a-ring": "".join(
            f'def "I{k}" (instanceable = true; references = </I{(k + 1) % 5}>) {{\n}}\n' for k in range(5)
        ),
        "instances-within-each-other": 'def "A" {\n def "I" (instanceable = true; references = </B>) {\n }\n}\n'
        'def "B" {\n def "I" (instanceable = true; references = </A>) {\n }\n}\n',
        "variant-of-itself": 'def "Bad" (variants = { string v = "a" }; variantSets = "v") {\n variantSet "v" = {\n'
        ' "a" (references = </Bad>) {\n }\n }\n}\n',
        "collection-of-itself": 'def "Bad" (prepend apiSchemas = ["CollectionAPI:c"]) {\n rel collection:c:includes = '
        "[</Bad.collection:c>, </Bad>]\n}\n",
        "relationship-of-itself": prim(
            "Mesh", "rel proxyPrim = </Bad>\n rel material:binding = </Bad.material:binding>"
        ),
        "connection-of-itself": prim("Sphere", "double radius.connect = </Bad.radius>"),
        "relocates-in-a-ring": "",
    }.items():
        head = HEAD
        if name.startswith("relocates"):
            head = HEAD.replace("(\n", "(\n    relocates = { </Good>: </A>, </A>: </Good> }\n", 1)
        yield Draft(name, stage(text, head), EITHER)
    for count in (1, 2, 3, 20):
        names = ["stage.usda", *(f"s{k}.usda" for k in range(1, count))]
        files = {
            name: f"#usda 1.0\n(\n subLayers = [@{names[(k + 1) % count]}@]\n)\n" + (GOOD if k == 0 else "")
            for k, name in enumerate(names)
        }
        yield Draft(f"sublayers-in-a-ring-of-{count}", files, EITHER)
        files = {
            name: HEAD
            + (GOOD if k == 0 else "")
            + f'def "B{k}" (references = @{names[(k + 1) % count]}@</B{(k + 1) % count}>) {{\n}}\n'
            for k, name in enumerate(names)
        }
        yield Draft(f"files-in-a-ring-of-{count}", files, EITHER)


@family
def missing(_: int) -> Iterator[Draft]:
    for arc in ("references", "payload"):
        for name, target in {
            "file": "@nowhere.usda@",
            "prim": "@stage.usda@</Nowhere>",
            "folder": "@.@",
            "picture": "@picture.png@",
            "empty": "@empty.usda@",
            "pipe": "@pipe.usda@</A>",
            "device": "@/dev/zero@",
            "unknown-format": "@readme.txt@",
            "property-path": "@stage.usda@</Good.points>",
            "address": "@http://localhost:1/a.usd@",
        }.items():
            files = stage(f'def "Bad" ({arc} = {target}) {{\n}}\n') | {
                "picture.png": broken_pictures.png(),
                "empty.usda": b"",
                "readme.txt": b"hello",
                "pipe.usda": os.mkfifo,
            }
            yield Draft(f"{arc}-{name}", files, EITHER)
    for name, target in {"file": "nowhere.usda", "folder": ".", "device": "/dev/zero", "pipe": "pipe.usda"}.items():
        files = stage("", HEAD.replace("(\n", f"(\n    subLayers = [@{target}@]\n", 1)) | {"pipe.usda": os.mkfifo}
        yield Draft(f"sublayer-{name}", files, EITHER)


@family
def escapes(_: int) -> Iterator[Draft]:
    """Confined to its own folder a stage may name nothing outside: the secret lies one folder up, and in links."""
    secret = HEAD + GOOD.replace('"Good"', '"Secret"')

    def link(to: str) -> Callable[[Path], None]:
        return lambda path: path.symlink_to(to)

    for name, text in {
        "reference": 'def "Bad" (references = @../secret.usda@</Secret>) {\n}\n',
        "payload": 'def "Bad" (payload = @../secret.usda@</Secret>) {\n}\n',
        "reference-through-a-link": 'def "Bad" (references = @link.usda@</Secret>) {\n}\n',
        "reference-with-detours": 'def "Bad" (references = @./a/../../secret.usda@</Secret>) {\n}\n',
        "reference-by-a-variant": 'def "Bad" (variants = { string v = "a" }; variantSets = "v") {\n variantSet "v" = {\n'
        ' "a" (references = @../secret.usda@</Secret>) {\n }\n }\n}\n',
        "reference-of-a-reference": 'def "Bad" (references = @second.usda@</Second>) {\n}\n',
    }.items():
        files = {f"show/{key}": value for key, value in stage(text).items()} | {
            "secret.usda": secret,
            "show/link.usda": link("../secret.usda"),
            "show/a/keep": b"",
            "show/second.usda": HEAD + 'def "Second" (references = @../secret.usda@</Secret>) {\n}\n',
        }
        yield Draft(name, files, REFUSED, "outside the folder", root="show/stage.usda")
    head = HEAD.replace("(\n", "(\n    subLayers = [@../secret.usda@]\n", 1)
    files = {"show/stage.usda": head + GOOD, "secret.usda": secret}
    yield Draft("sublayer", files, REFUSED, "secret.usda", root="show/stage.usda")
    files = {"show/stage.usda": link("../secret.usda"), "secret.usda": secret}
    yield Draft("root-is-a-link", files, EITHER, root="show/stage.usda")
    for name, asset in {"texture": "../secret.png", "texture-through-a-link": "link.png"}.items():
        files = {f"show/{key}": value for key, value in stage(texture(asset)).items()} | {
            "secret.png": broken_pictures.png(),
            "show/link.png": link("../secret.png"),
        }
        yield Draft(name, files, NOTED, "outside the folder", root="show/stage.usda")
    dome = prim("DomeLight", "asset inputs:texture:file = @../secret.hdr@")
    files = {"show/stage.usda": HEAD + GOOD + dome, "secret.hdr": broken_pictures.hdr()}
    yield Draft("dome", files, NOTED, "outside the folder", root="show/stage.usda")
    clips = CLIPS.format("@../secret.usda@", "/Secret", "(0, 0)", "(0, 0)")
    files = {"show/stage.usda": HEAD + GOOD + prim("Mesh", "", meta=clips), "secret.usda": secret}
    yield Draft("clips", files, EITHER, root="show/stage.usda")


@family
def growth(_: int) -> Iterator[Draft]:
    """Small files that grow without bound."""

    def doubling(levels: int, instanced: bool) -> str:
        mark = "instanceable = true; " if instanced else ""
        lines = ['def Sphere "L0" {\n}\n']
        for k in range(1, levels + 1):
            inner = "".join(f' def "{side}" ({mark}references = </L{k - 1}>) {{\n }}\n' for side in "AB")
            lines.append(f'def "L{k}" {{\n{inner}}}\n')
        return "".join(lines)

    yield Draft("references-doubling-40-times", stage(doubling(40, False)), REFUSED, "stage.usda")
    yield Draft("references-doubling-24-times", stage(doubling(24, False)), REFUSED, "stage.usda")
    yield Draft("instances-doubling-30-times", stage(doubling(30, True)), REFUSED, "would place")
    for length in (300, 1000):
        chain = (
            "".join(f'def "C{k}" (references = </C{k + 1}>) {{\n}}\n' for k in range(length))
            + f'def "C{length}" {{\n}}\n'
        )
        yield Draft(f"chain-of-{length}", stage(chain), REFUSED, "references one behind the other")
    for depth in (600, 5000, 100_000):
        text = 'def "A" {\n' * depth + "}\n" * depth
        yield Draft(f"nested-{depth}", stage(text), REFUSED, f"nested {depth} deep")
    values = prim("Mesh", f"double[] x = {'(' * 10_000}1{')' * 10_000}")
    yield Draft("parentheses", stage(values), REFUSED, "nested")
    lists = prim("Mesh", f"double[] x = {'[' * 3000}{']' * 3000}")
    yield Draft("brackets", stage(lists), REFUSED, "nested")
    dictionary = prim("Mesh", "", meta="customData = " + "{ dictionary d = " * 2000 + "{}" + "}" * 2000)
    yield Draft("dictionaries", stage(dictionary), REFUSED, "nested")
    many = ", ".join("0" for _ in range(1500))
    places = ", ".join("(0, 0, 0)" for _ in range(1500))
    lists = f"int[] protoIndices = [{many}]\n point3f[] positions = [{places}]"
    inner = f'rel prototypes = [</Bad/I/P>]\n {lists}\n def Sphere "P" {{\n }}'
    outer = f'rel prototypes = [</Bad/I>]\n {lists}\n def PointInstancer "I" {{\n {inner}\n }}'
    yield Draft("instancer-of-an-instancer", stage(prim("PointInstancer", outer)), REFUSED, "/Bad")
    siblings = "".join(f'def "P{k}" {{\n}}\n' for k in range(3000))
    yield Draft("three-thousand-siblings", stage(siblings), READ)
    names = prim("Mesh", "", name="N" * 60_000)
    yield Draft("a-name-of-60000-letters", stage(names), EITHER)
    layers = HEAD.replace("(\n", f"(\n    subLayers = [{', '.join(f'@m{k}.usda@' for k in range(2000))}]\n", 1)
    yield Draft("two-thousand-missing-sublayers", stage("", layers), EITHER)


# --- damaged files

RICH = (
    HEAD
    + GOOD
    + prim(
        "Sphere",
        'double radius = 0.5\n double3 xformOp:translate = (0, 1, 0)\n uniform token[] xformOpOrder = ["xformOp:translate"]',
        "Ball",
    )
    + material("float inputs:metallic = 1\n        float inputs:roughness = 0")
    + prim("Camera", "float focalLength = 35\n float2 clippingRange = (0.1, 1000)", "Camera")
    + 'def "Twin" (references = </Ball>) {\n}\n'
    + prim("DomeLight", "float inputs:intensity = 1", "Sky")
)


def flipped(data: bytes, seed: int, most: int = 6) -> bytes:
    """Bytes replaced, bits flipped, a run doubled or dropped, at random places."""
    draw = random.Random(seed)
    out = bytearray(data)
    for _ in range(draw.randint(1, most)):
        at = draw.randrange(len(out))
        kind = draw.randrange(5)
        if kind == 0:
            out[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            out[at] = draw.choice((0, 1, 0x7F, 0x80, 0xFF))
        elif kind == 2:
            out[at : at + 4] = struct.pack("<I", draw.choice((0, 2**31 - 1, 2**31, 2**32 - 1, HUGE)))
        elif kind == 3:
            size = draw.randint(1, 40)
            out[at:at] = out[at : at + size]
        else:
            del out[at : at + draw.randint(1, 40)]
    return bytes(out)


def crate(text: str = RICH) -> bytes:
    """A binary layer of a text one."""
    from pxr import Sdf

    layer = Sdf.Layer.CreateAnonymous(".usdc")
    layer.ImportFromString(text)
    return _exported(layer)


def _exported(layer) -> bytes:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.usdc"
        layer.Export(str(path))
        return path.read_bytes()


@family
def text_truncated(_: int) -> Iterator[Draft]:
    data = RICH.encode()
    for k in range(40):
        yield Draft(f"{k}", {"stage.usda": data[: len(data) * k // 40]}, EITHER)


@family
def text_flipped(mutants: int) -> Iterator[Draft]:
    for seed in range(mutants):
        yield Draft(f"{seed}", {"stage.usda": flipped(RICH.encode(), seed)}, EITHER)


@family
def text_garbage(_: int) -> Iterator[Draft]:
    whole = RICH.encode()
    for name, data, expect in (
        ("empty", b"", REFUSED),
        ("magic-alone", b"#usda 1.0", EITHER),
        ("version-99", whole.replace(b"1.0", b"99.0", 1), EITHER),
        ("nul", whole.replace(b'"Ball"', b'"Ba\0l"', 1), REFUSED),
        ("byte-order-mark", b"\xef\xbb\xbf" + whole, REFUSED),
        ("utf-16", RICH.encode("utf-16"), REFUSED),
        ("line-ends-of-two", whole.replace(b"\n", b"\r\n"), EITHER),
        ("old-line-ends", whole.replace(b"\n", b"\r"), EITHER),
        ("invalid-utf-8", whole.replace(b"Ball", b"\xff\xfe\xc0\xaf", 1), EITHER),
        ("accents", whole.replace(b"Ball", "Möbius漢".encode()), READ),
        ("emoji", whole.replace(b"Ball", "\U0001f525".encode()), EITHER),
        ("digit-first", whole.replace(b'"Ball"', b'"1a"', 1), EITHER),
        ("space", whole.replace(b'"Ball"', b'"a b"', 1), EITHER),
        ("open-string", whole + b'def "A', REFUSED),
        ("open-comment", whole + b"/* never ends", EITHER),
        ("long-line", whole + b"# " + b"x" * 2_000_000, READ),
        ("random", random.Random(1).randbytes(4096), REFUSED),
        ("picture", broken_pictures.png(), REFUSED),
        ("python", b"#usda 1.0\nimport os\n", REFUSED),
        ("twice", whole + whole, EITHER),
        ("same-name-twice", whole + GOOD.encode(), EITHER),
        ("number-of-a-million-digits", whole + b'def "A" {\n double x = ' + b"9" * 1_000_000 + b"\n}\n", EITHER),
    ):
        yield Draft(name, {"stage.usda": data}, expect, "stage.usda" if expect is REFUSED else "")


@family
def crate_truncated(_: int) -> Iterator[Draft]:
    data = crate()
    for k in range(40):
        cut = data[: len(data) * k // 40]
        yield Draft(f"{k}", {"stage.usdc": cut}, REFUSED, "stage.usdc", root="stage.usdc")


@family
def crate_flipped(mutants: int) -> Iterator[Draft]:
    data = crate()
    for seed in range(mutants):
        yield Draft(f"{seed}", {"stage.usdc": flipped(data, 1000 + seed)}, CRASH, root="stage.usdc")


@family
def crate_headers(_: int) -> Iterator[Draft]:
    data = crate()
    (toc,) = struct.unpack_from("<q", data, 16)
    count = struct.unpack_from("<Q", data, toc)[0]
    starts = [struct.unpack_from("<q", data, toc + 8 + 32 * k + 16)[0] for k in range(count)]

    def put(at: int, value: int) -> bytes:
        return data[:at] + struct.pack("<q", value) + data[at + 8 :]

    for name, value in {"zero": 0, "negative": -1, "far": 10**12, "end": len(data), "huge": 2**62}.items():
        yield Draft(f"toc-{name}", {"stage.usdc": put(16, value)}, REFUSED, "stage.usdc", root="stage.usdc")
    for name, value in {"many": 2**26, "negative": -1, "huge": 2**62}.items():
        yield Draft(f"sections-{name}", {"stage.usdc": put(toc, value)}, REFUSED, "stage.usdc", root="stage.usdc")
    for k, start in enumerate(starts):
        for name, value in {"1e9": 10**9, "2e40": 2**40, "2e62": 2**62, "negative": -1}.items():
            yield Draft(f"section-{k}-count-{name}", {"stage.usdc": put(start, value)}, CRASH, root="stage.usdc")
        for name, value in {"negative": -1, "far": 10**12}.items():
            moved = put(toc + 8 + 32 * k + 16, value)
            yield Draft(f"section-{k}-start-{name}", {"stage.usdc": moved}, REFUSED, "stage.usdc", root="stage.usdc")
    for version in ((0, 0, 0), (0, 99, 0), (255, 255, 255)):
        changed = data[:8] + bytes(version) + data[11:]
        yield Draft(f"version-{version[0]}-{version[1]}", {"stage.usdc": changed}, CRASH, root="stage.usdc")


def package(entries: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    out = BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return out.getvalue()


@family
def packages(mutants: int) -> Iterator[Draft]:
    good = package({"a.usda": RICH.encode()})

    def draft(name: str, data: bytes, expect: str = REFUSED) -> Draft:
        return Draft(name, {"stage.usdz": data}, expect, "stage.usdz" if expect is REFUSED else "", root="stage.usdz")

    yield draft("bomb", package({"a.usda": HEAD.encode() + b"#" * 50_000_000}, zipfile.ZIP_DEFLATED))
    yield draft(
        "bomb-of-bombs", package({"a.usdz": package({"b.usda": b"#" * 9_000_000}, zipfile.ZIP_DEFLATED)}), EITHER
    )
    yield draft("leaves-the-package", package({"../../a.usda": RICH.encode()}))
    yield draft("absolute", package({"/etc/a.usda": RICH.encode()}))
    yield draft("backslashes", package({"..\\..\\a.usda": RICH.encode()}))
    yield draft("no-entries", package({}))
    yield draft("nothing-of-usd", package({"a.txt": b"hello"}), EITHER)
    yield draft("a-picture-first", package({"a.png": broken_pictures.png(), "b.usda": RICH.encode()}), EITHER)
    yield draft("within-itself", package({"a.usdz": good}), EITHER)
    yield draft("empty-layer", package({"a.usda": b""}), EITHER)
    yield draft("bad-layer", package({"a.usda": b"#usda 1.0\ndef {"}), EITHER)
    yield draft(
        "references-outside",
        package({"a.usda": (HEAD + 'def "A" (references = @../../secret.usda@</A>) {\n}\n').encode()}),
        EITHER,
    )
    lie = bytearray(good)
    lie[22:26] = struct.pack("<I", 2**31 - 1)
    yield draft("local-size-lies", bytes(lie), EITHER)
    directory = good.rfind(b"PK\x01\x02")
    for name, at in {"packed": 20, "size": 24, "offset": 42}.items():
        for k, value in enumerate((0, 7, 2**31 - 1, 2**32 - 1)):
            lie = bytearray(good)
            lie[directory + at : directory + at + 4] = struct.pack("<I", value)
            yield draft(f"directory-{name}-lies-{k}", bytes(lie), EITHER)
    locked = bytearray(good)
    locked[directory + 8] |= 1
    locked[6] |= 1
    yield draft("locked", bytes(locked), EITHER)
    for k in range(12):
        yield draft(f"truncated-{k}", good[: len(good) * k // 12])
    for seed in range(mutants // 2):
        yield Draft(f"flipped-{seed}", {"stage.usdz": flipped(good, 5000 + seed)}, CRASH, root="stage.usdz")


@family
def files(_: int) -> Iterator[Draft]:
    """Names that are no ordinary files, and names that are odd."""
    for suffix in ("usda", "usdc", "usd", "usdz"):
        name = f"stage.{suffix}"
        for kind, make in {
            "zero-length": lambda path: path.touch(),
            "folder": lambda path: path.mkdir(),
            "pipe": os.mkfifo,
            "device-zero": lambda path: path.symlink_to("/dev/zero"),
            "device-null": lambda path: path.symlink_to("/dev/null"),
            "dangling-link": lambda path: path.symlink_to("nowhere"),
            "link-to-itself": lambda path: path.symlink_to(path.name),
        }.items():
            yield Draft(f"{kind}-{suffix}", {name: make}, REFUSED, name, root=name)
    yield Draft("not-there", {"keep": b""}, REFUSED, "stage.usda")
    for k, name in enumerate(
        ("a b.usda", "näme.usda", "\U0001f525.usda", "a\nb.usda", "-f.usda", "a'\"$(id).usda", "100%.usda")
    ):
        yield Draft(f"odd-name-{k}", {name: RICH}, READ, root=name)
    yield Draft("text-called-crate", {"stage.usdc": RICH}, EITHER, root="stage.usdc")
    yield Draft("crate-called-text", {"stage.usda": crate()}, EITHER)
    yield Draft("crate-called-package", {"stage.usdz": crate()}, EITHER, root="stage.usdz")


# --- pictures


def textured(picture: str, data: bytes, expect: str) -> Draft:
    """A stage whose mesh and whose sky show one picture."""
    sky = prim("DomeLight", f"asset inputs:texture:file = @{picture}@", "Sky")
    return Draft("", stage(texture(picture) + sky) | {picture: data}, expect, picture if expect is NOTED else "")


def named(draft: Draft, name: str) -> Draft:
    draft.name = name
    return draft


@family
def pictures_truncated(_: int) -> Iterator[Draft]:
    for suffix, make in broken_pictures.WHOLE.items():
        data = make()
        for k in range(8):
            yield named(
                textured(f"p.{suffix}", data[: len(data) * k // 8], EITHER if k >= 6 else NOTED), f"{suffix}-{k}"
            )


@family
def pictures_whole(_: int) -> Iterator[Draft]:
    for suffix, make in broken_pictures.WHOLE.items():
        yield named(textured(f"p.{suffix}", make(), READ), suffix)
        yield named(textured("p.jpg", make(), EITHER), f"{suffix}-called-jpg")


@family
def pictures_flipped(mutants: int) -> Iterator[Draft]:
    for suffix, make in broken_pictures.WHOLE.items():
        for seed in range(mutants // 6):
            yield named(textured(f"p.{suffix}", flipped(make(), 9000 + seed), EITHER), f"{suffix}-{seed}")


@family
def pictures_headers(_: int) -> Iterator[Draft]:
    sizes = {
        "1e5": (100_000, 100_000),
        "none": (0, 0),
        "2e31": (2**31 - 1, 2**31 - 1),
        "wide": (2**31 - 1, 1),
        "minus": (-1, -1),
    }
    for suffix in ("png", "exr", "hdr", "bmp", "ppm", "tif", "tga"):
        for name, size in sizes.items():
            if suffix in ("tif", "tga") and name != "none":
                size = (65_535, 65_535)
            data = broken_pictures.WHOLE[suffix](*size)
            yield named(textured(f"p.{suffix}", data, NOTED), f"{suffix}-{name}")
    make = broken_pictures.exr
    for name, data, expect in (
        ("exr-nan", make(fill=float("nan")), NOTED),
        ("exr-inf", make(fill=float("inf")), NOTED),
        ("exr-negative", make(fill=-5.0), NOTED),
        ("exr-1e38", make(fill=1e38), EITHER),
        ("exr-odd-channels", make(channels=("Z", "foo", "bar")), EITHER),
        ("exr-no-channels", make(channels=()), NOTED),
        ("exr-500-channels", make(channels=tuple(sorted(f"c{k}" for k in range(500)))), EITHER),
        ("exr-window-far", make(first=2**31 - 40), EITHER),
        ("exr-window-minus", make(first=-(2**31)), EITHER),
        ("exr-compression-99", make(compression=99), EITHER),
    ):
        yield named(textured("p.exr", data, expect), name)
    yield named(textured("p.png", broken_pictures.png_bomb(), NOTED), "png-bomb")
    yield named(textured("p.png", broken_pictures.png(rows=b"\0" * 5_000_000), EITHER), "png-too-many-rows")
    yield named(textured("p.png", broken_pictures.png(depth=3), NOTED), "png-depth-3")
    yield named(textured("p.png", broken_pictures.png(color=7), NOTED), "png-color-7")
    yield named(textured("p.tif", broken_pictures.tiff(next_directory=8), EITHER), "tif-loop")
