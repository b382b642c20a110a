"""Materials in .mtlx files, which the USD library's Python wheel cannot read: a document to UsdShade prims.

The file is read by the `MaterialX` package (the extra `materialx`), where a stage needs one of its materials. Its nodes
become shaders of an in-memory stage under the names that the USD library's own reader gives materials
(</MaterialX/Materials/NAME>), so that one reader understands both. Nothing is composed: opinions that a stage has about
such a material are not applied.
"""

from __future__ import annotations

import os
import re
import stat
import tempfile
from pathlib import Path

from pxr import Gf, Sdf, Tf, Usd, UsdShade

from warp_reflect.stage.guard import confinement_fault
from warp_reflect.stage.intake import Intake
from warp_reflect.stage.textures import unpacked

ENDING = ".mtlx"
BYTES_MAX = 64 * 2**20  # of a document; real ones hold kilobytes
EXTRA = "warp_reflect[materialx]"
DOCUMENT = Sdf.Path("/MaterialX")
MATERIALS = DOCUMENT.AppendChild("Materials")
NODES = DOCUMENT.AppendChild("NodeGraphs")
TYPES = Sdf.ValueTypeNames
VALUE_TYPES = {
    "float": (TYPES.Float, float),
    "integer": (TYPES.Int, int),
    "boolean": (TYPES.Bool, bool),
    "string": (TYPES.String, str),
    "color3": (TYPES.Color3f, lambda value: Gf.Vec3f(*value.asTuple())),
    "color4": (TYPES.Color4f, lambda value: Gf.Vec4f(*value.asTuple())),
    "vector2": (TYPES.Float2, lambda value: Gf.Vec2f(*value.asTuple())),
    "vector3": (TYPES.Float3, lambda value: Gf.Vec3f(*value.asTuple())),
    "vector4": (TYPES.Float4, lambda value: Gf.Vec4f(*value.asTuple())),
}


def is_materialx_error(text: str) -> bool:
    """Whether a composition error is only that a .mtlx file was met; what is needed of it is read here."""
    return f"{ENDING}@" in text and "Could not open asset" in text


def referenced_material(stage: Usd.Stage, path: Sdf.Path, intake: Intake) -> tuple[UsdShade.Material | None, bool]:
    """The material that a prim would be, were the .mtlx files referenced by it or above it composed.

    Args:
        stage: The stage.
        path: Of the material; there need not be such a prim.
        intake: The reading.

    Returns:
        (the material or None, whether a file was meant: then the reason is noted already).
    """
    meant = False
    for site in path.GetPrefixes()[::-1]:
        prim = stage.GetPrimAtPath(site)
        for file, inside in _arcs(prim) if prim else ():
            meant = True
            documents = _documents(file, intake)
            found = documents and documents.GetPrimAtPath(path.ReplacePrefix(site, inside))
            if found and found.IsA(UsdShade.Material):
                return UsdShade.Material(found), True
        if meant:
            files = ", ".join(f"@{file}@" for file, _ in _arcs(prim))
            if all(_documents(file, intake) for file, _ in _arcs(prim)):
                intake.note(path, f"no such material in {files}; displayColor is used")
            break
    return None, meant


def _arcs(prim: Usd.Prim):
    """(file, path in it) of the references and payloads to .mtlx files on a prim."""
    if prim.IsInstanceProxy():
        prim = prim.GetPrimInPrototype()
    for spec in prim.GetPrimStack():
        for arcs in (spec.referenceList, spec.payloadList):
            for arc in arcs.GetAppliedItems():
                if arc.assetPath.endswith(ENDING):
                    yield spec.layer.ComputeAbsolutePath(arc.assetPath), arc.primPath or DOCUMENT


def _documents(file: str, intake: Intake) -> Usd.Stage | None:
    """A .mtlx file as a stage; None, with a note, where it cannot be read."""
    key = "materialx", file
    if key not in intake.cache:
        intake.cache[key] = _read_document(file, intake)
    found = intake.cache[key]
    if isinstance(found, str):
        # Once for all files where the package is missing, once a file otherwise; again at every reading.
        (intake.note if EXTRA in found else intake.bad)("/", found)
        return None
    return found


def _read_document(file: str, intake: Intake) -> Usd.Stage | str:
    """The stage, or what is wrong."""
    try:
        import MaterialX as mx
    except ImportError:
        return (
            f"materials in {ENDING} files are not read: install {EXTRA}; displayColor is used in their place, or a "
            "default grey"
        )
    fault = confinement_fault(file, intake.limits.root)
    if fault:
        return f"@{file}@: {fault}; displayColor is used"
    faults = mx.Exception, mx.ExceptionParseError, mx.ExceptionFileMissing, mx.ExceptionFoundCycle
    document = mx.createDocument()
    options = mx.XmlReadOptions()

    def include(target, name, search_path, inner) -> None:
        included = search_path.find(name).asString()
        outside = confinement_fault(included, intake.limits.root)
        if outside:
            intake.bad("/", f"@{file}@: includes @{included}@, {outside}; not read")
            return
        mx.readFromXmlFile(target, name, search_path, inner)

    options.readXIncludeFunction = include
    try:
        if file.endswith("]"):
            with tempfile.TemporaryDirectory(prefix="warp_reflect_") as folder:
                mx.readFromXmlString(document, unpacked(file, folder).read_text(encoding="utf-8"))
        else:
            status = os.stat(file)
            if not stat.S_ISREG(status.st_mode) or status.st_size > BYTES_MAX:
                return f"@{file}@: no regular file of at most {BYTES_MAX} bytes; displayColor is used"
            mx.readFromXmlFile(document, file, mx.FileSearchPath(str(Path(file).parent)), options)
    except (OSError, ValueError, *faults) as problem:
        return f"@{file}@: cannot be read ({' '.join(str(problem).split())}); displayColor is used"
    return _Translation(file, document).stage


class _Translation:
    """A document as prims of a stage in memory; nodes are made when something asks for them, each once."""

    def __init__(self, file: str, document):
        self.file = file
        self.stage = Usd.Stage.CreateInMemory()
        self._made: dict[str, UsdShade.Shader] = {}
        for node in document.getMaterialNodes():
            material = UsdShade.Material.Define(self.stage, MATERIALS.AppendChild(_identifier(node.getName())))
            for given in node.getInputs():
                source = given.getConnectedNode()
                if given.getName() == "surfaceshader" and source is not None:
                    made = self._shader(source)
                    material.CreateSurfaceOutput("mtlx").ConnectToSource(made.CreateOutput("out", TYPES.Token))

    def _shader(self, node) -> UsdShade.Shader:
        name = node.getNamePath()
        if name not in self._made:
            path = NODES
            for part in name.split("/"):
                path = path.AppendChild(_identifier(part))
            shader = self._made[name] = UsdShade.Shader.Define(self.stage, path)
            shader.CreateIdAttr(f"ND_{node.getCategory()}_{node.getType()}")
            for given in node.getInputs():
                self._input(shader, given)
        return self._made[name]

    def _input(self, shader: UsdShade.Shader, given) -> None:
        name, kind = _identifier(given.getName()), given.getType()
        source = given.getConnectedNode()
        if source is not None:
            made = shader.CreateInput(name, VALUE_TYPES.get(kind, (TYPES.Token, None))[0])
            output = given.getOutputString() if source.isMultiOutputType() else ""
            made.ConnectToSource(self._shader(source).CreateOutput(output or "out", made.GetTypeName()))
            return
        # A node in a graph may take its value from the graph's own input.
        holder = given.getInterfaceInput() or given
        if kind == "filename":
            value = holder.getResolvedValueString()
            if value:
                made = shader.CreateInput(name, TYPES.Asset)
                made.Set(Sdf.AssetPath(self._anchored(value, holder)))
                made.GetAttr().SetColorSpace(holder.getActiveColorSpace())
            return
        value = holder.getValue()
        if value is not None and kind in VALUE_TYPES:
            value_type, convert = VALUE_TYPES[kind]
            shader.CreateInput(name, value_type).Set(convert(value))

    def _anchored(self, value: str, holder) -> str:
        """A file name relative to the document that has it, absolute."""
        package = re.fullmatch(r"(.*)\[(.*)\]", self.file)
        if package:
            inside = os.path.normpath(Path(package[2]).parent / value)
            return f"{package[1]}[{inside}]"
        return str((Path(holder.getActiveSourceUri() or self.file).parent / value).resolve())


def _identifier(name: str) -> str:
    return Tf.MakeValidIdentifier(name)
