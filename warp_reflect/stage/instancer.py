"""UsdGeomPointInstancer: which prototype goes where."""

from __future__ import annotations

import dataclasses

import numpy as np
from pxr import UsdGeom

from warp_reflect.scene import InstanceData
from warp_reflect.stage.intake import BadPrim, Intake, floats, integers


def read_instancer(prim, intake: Intake) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
    """The visible instances of a point instancer.

    Args:
        prim: The point instancer.
        intake: The reading; single instances that are bad are noted and left out.

    Returns:
        (targets, prototype, ids, transforms): prototype paths; per instance the index into targets int64
        [n], its id int64 [n] and its transform from the instancer's frame to the prototype's parent frame,
        float64 [n, 4, 4], columns. The prototype's own transform is left to whoever walks it (UsdGeom:
        ExcludeProtoXform there).

    Raises:
        BadPrim: no prototypes, or arrays whose lengths do not fit.
    """
    instancer = UsdGeom.PointInstancer(prim)
    time = intake.time
    targets = [str(t) for t in instancer.GetPrototypesRel().GetForwardedTargets()]
    prototype = integers(instancer.GetProtoIndicesAttr(), time)
    positions = floats(instancer.GetPositionsAttr(), time, 3)
    if not targets:
        raise BadPrim("prototypes: got no target, expected at least one")
    if prototype is None or positions is None:
        raise BadPrim(f"{'positions' if prototype is not None else 'protoIndices'}: got no value, expected an array")
    count = len(prototype)
    lengths = {"positions": len(positions)}
    for attribute in (
        instancer.GetOrientationsfAttr(),
        instancer.GetOrientationsAttr(),
        instancer.GetScalesAttr(),
    ):
        value = attribute.Get(time) if attribute and attribute.HasAuthoredValue() else None
        if value is not None and len(value):
            lengths[attribute.GetName()] = len(value)
    for name, length in lengths.items():
        if length != count:
            raise BadPrim(f"{name}: got {length} values, expected {count} as in protoIndices")
    if not count:
        return targets, prototype, prototype, np.zeros((0, 4, 4))
    authored_ids = integers(instancer.GetIdsAttr(), time)
    ids = authored_ids if authored_ids is not None and len(authored_ids) == count else np.arange(count)
    matrices = instancer.ComputeInstanceTransformsAtTime(
        time, time, UsdGeom.PointInstancer.ExcludeProtoXform, UsdGeom.PointInstancer.IgnoreMask
    )
    if len(matrices) != count:
        raise BadPrim(f"positions, orientations, scales: got {len(matrices)} transforms, expected {count}")
    transforms = np.array(matrices, np.float64).transpose(0, 2, 1)
    mask = instancer.ComputeMaskAtTime(time)
    shown = np.array(mask, bool) if mask is not None and len(mask) == count else np.ones(count, bool)
    known = (prototype >= 0) & (prototype < len(targets))
    if not known.all():
        first = int(np.argmin(known))
        intake.bad(
            prim.GetPath(),
            f"protoIndices[{first}]: got {prototype[first]}, expected 0 to {len(targets) - 1}; "
            f"{int(np.sum(~known))} instances dropped",
        )
    finite = np.isfinite(transforms).all(axis=(1, 2))
    if not finite[shown & known].all():
        first = int(np.argmax(~finite & shown & known))
        intake.bad(
            prim.GetPath(),
            f"positions[{first}]: got a transform that is not finite; {int(np.sum(~finite & shown))} instances dropped",
        )
    for k, target in enumerate(targets):
        if (prototype == k).any() and not prim.GetStage().GetPrimAtPath(target):
            intake.bad(prim.GetPath(), f"prototypes[{k}]: got <{target}>, expected a prim; its instances are dropped")
            known &= prototype != k
    kept = shown & known & finite
    return targets, prototype[kept], ids[kept], transforms[kept]


def expand(items: list[InstanceData], worlds: np.ndarray, ids: np.ndarray, path: str) -> list[InstanceData]:
    """Every item at every instance; `worlds` float64 [n, 4, 4] place the prototype's parent frame."""
    result = []
    names = [f"{path}:{i}" for i in ids.tolist()]
    for item in items:
        placed = worlds @ item.world_from_object
        for k, name in enumerate(names):
            inner = f"{name}/{item.instance}" if item.instance else name
            result.append(dataclasses.replace(item, world_from_object=placed[k], instance=inner))
    return result
