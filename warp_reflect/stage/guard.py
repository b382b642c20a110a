"""What is refused before the USD library sees it, and how large a stage may be."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Limits:
    """Sizes above which a stage is refused (`ValueError`) or a prim dropped; generous for honest files."""

    prims: int = 2_000_000
    """Prims visited, prims in instances counted once per instance."""
    depth: int = 512
    """Namespace depth; the library itself fails near 10,000."""
    instances: int = 2_000_000
    """Placed meshes."""
    face_corners: int = 65_536
    """Corners of one face."""
    triangles: int = 200_000_000
    """Triangles of all placed meshes together."""
    root: str = ""
    """Folder that layers and pictures must lie in; empty: anywhere."""


def confinement_fault(file: str, root: str) -> str:
    """Why a file may not be read from a stage confined to the folder `root`; empty if it may."""
    if not root:
        return ""
    package = file.partition("[")[0] if file.endswith("]") else file
    real, inside = Path(package).resolve(), Path(root).resolve()
    return "" if real.is_relative_to(inside) else f"outside the folder {root}"
