"""The layers of an untrusted stage, looked at one by one before they are composed.

Composition can take exponential time and memory on a file of 2 kB (references that double at every level), and opens
whatever a layer names. Both are found here in time linear in the layers. This runs in the child process only: the
layer library itself can crash on damaged files.
"""

from __future__ import annotations

from collections.abc import Iterator

from pxr import Ar, Sdf, Tf

from warp_reflect.stage.guard import Limits, UnknownFormat, check_file, confinement_fault
from warp_reflect.stage.intake import library_message

# Prims placed by instances may outnumber those composed, and the walk stops at its own count; far beyond it the walk
# would only take its time to refuse (2 M prims: 100 s).
PLACED_SHARE = 100
LIST_OPERATIONS = ("explicitItems", "prependedItems", "appendedItems", "addedItems")


def check_layers(path: str, limits: Limits) -> None:
    """Refuse a stage by what its layers would compose to.

    Args:
        path: The root layer.
        limits: `root`, `layers`, `arcs`, `depth` and `prims` are looked at.

    Raises:
        ValueError: a layer outside the root folder, too many layers, prims or nested references, or too deep.
    """
    layers = _Layers(limits)
    root = layers.open(path)
    if root is None:
        return  # told by whoever opens the stage
    try:
        total = _composed_prims(layers, root, limits)
    except (Tf.ErrorException, UnicodeDecodeError) as fault:  # a damaged file fails where it is looked at
        raise ValueError(f"cannot read {path}: {library_message(fault)}") from None
    if total > limits.prims:
        raise ValueError(f"{path}: would compose to {total} prims, more than {limits.prims}")


class _Layers:
    """Layers by identifier, each checked as a file before it is opened."""

    def __init__(self, limits: Limits):
        self.limits = limits
        self.opened: dict[str, Sdf.Layer | None] = {}
        self._stacks: dict[str, list[Sdf.Layer]] = {}

    def open(self, identifier: str) -> Sdf.Layer | None:
        """A layer; None where it is missing or unreadable, which composition notes by itself."""
        if identifier not in self.opened:
            if len(self.opened) >= self.limits.layers:
                raise ValueError(f"{identifier}: more than {self.limits.layers} layers")
            self.opened[identifier] = self._open(identifier)
        return self.opened[identifier]

    def _open(self, identifier: str) -> Sdf.Layer | None:
        file = str(Ar.GetResolver().Resolve(identifier))
        if not file:
            return None
        fault = confinement_fault(file, self.limits.root)
        if fault:
            raise ValueError(f"{file}: {fault}; give --root to allow it")
        try:
            check_file(file.partition("[")[0] if file.endswith("]") else file, self.limits)
            return Sdf.Layer.FindOrOpen(identifier)
        except (UnknownFormat, Tf.ErrorException):
            return None

    def stack(self, layer: Sdf.Layer) -> list[Sdf.Layer]:
        """A layer and all its sublayers, each once."""
        if layer.identifier not in self._stacks:
            found, queue = [], [layer]
            while queue:
                each = queue.pop()
                if each in found:
                    continue
                found.append(each)
                for name in each.subLayerPaths:
                    below = self.open(Sdf.ComputeAssetPathRelativeToLayer(each, name)) if name else None
                    if below is not None:
                        queue.append(below)
            self._stacks[layer.identifier] = found
        return self._stacks[layer.identifier]


def _composed_prims(layers: _Layers, root: Sdf.Layer, limits: Limits) -> int:
    """An upper bound of the prims a stage composes to: every arc adds what lies below its target.

    What lies below an instanceable prim is shared, and counted once for all of its instances.
    """
    start = (root.identifier, "/")
    counts: dict[tuple[str, str], int] = {}
    placed: dict[tuple[str, str], int] = {}  # the same with what instances share counted for each
    arcs: dict[tuple[str, str], int] = {}  # the longest chain of references from a prim on
    waiting: list[tuple[tuple[str, str], bool]] = [(start, False)]
    below: dict[tuple[str, str], list[tuple[tuple[str, str], bool, bool]]] = {}
    shared: set[tuple[str, str]] = set()
    while waiting:
        node, ready = waiting.pop()
        if ready:
            total, everywhere, longest = 1, 1, 0
            for child, is_arc, instanced in below.pop(node):
                longest = max(longest, is_arc + arcs.get(child, 0))
                everywhere += max(placed.get(child, 0) - is_arc, 0)
                if instanced:
                    shared.add(child)
                else:
                    total += max(counts.get(child, 0) - is_arc, 0)  # the target itself merges into the prim
            if longest > limits.arcs:
                raise ValueError(f"<{node[1]}> in {node[0]}: more than {limits.arcs} references one behind the other")
            counts[node], arcs[node] = min(total, 2 * limits.prims), longest
            placed[node] = min(everywhere, 2 * PLACED_SHARE * limits.prims)
        elif node not in counts and node not in below:  # else known, or a cycle, which composition refuses
            below[node] = list(_below(layers, *node, limits))
            waiting.append((node, True))
            waiting.extend((child, False) for child, _, _ in below[node])
    total = counts[start] + sum(counts.get(node, 0) for node in shared)
    if total <= limits.prims and placed[start] > PLACED_SHARE * limits.prims:
        raise ValueError(
            f"{root.identifier}: would place {placed[start]} prims, more than {PLACED_SHARE * limits.prims}"
        )
    return total


def _below(layers: _Layers, identifier: str, path: str, limits: Limits) -> Iterator[tuple[tuple[str, str], bool, bool]]:
    """((layer, prim path), is an arc, is instanced) of a prim's children and the targets of its arcs."""
    layer = layers.open(identifier)
    if layer is None:
        return
    for each in layers.stack(layer):
        spec = each.pseudoRoot if path == "/" else each.GetPrimAtPath(path)
        if not spec:
            continue
        if Sdf.Path(path).pathElementCount > limits.depth:
            raise ValueError(f"<{path}> in {identifier}: deeper than {limits.depth} levels")
        for child in spec.nameChildren:
            if child is None:
                raise ValueError(f"<{path}> in {identifier}: a child that is listed and not there; the file is damaged")
            yield (identifier, str(child.path)), False, False
        if path == "/":
            continue
        for variant_set in spec.variantSets.values() if spec.HasInfo("variantSetNames") else ():
            for variant in variant_set.variants.values():
                yield (identifier, str(variant.primSpec.path)), False, False
        instanced = bool(spec.HasInfo("instanceable") and spec.instanceable)
        for arc in (*_items(spec.referenceList), *_items(spec.payloadList)):
            target = (
                each if not arc.assetPath else layers.open(Sdf.ComputeAssetPathRelativeToLayer(each, arc.assetPath))
            )
            if target is None:
                continue
            inside = arc.primPath or (Sdf.Path("/" + target.defaultPrim) if target.defaultPrim else None)
            if inside:
                # An internal reference sees the whole layer stack it stands in.
                owner = identifier if not arc.assetPath else target.identifier
                yield (owner, str(inside)), True, instanced
        for inherited in (*_items(spec.inheritPathList), *_items(spec.specializesList)):
            yield (identifier, str(inherited.MakeAbsolutePath(spec.path))), True, instanced


def _items(listing) -> list:
    return [item for name in LIST_OPERATIONS for item in getattr(listing, name)]
