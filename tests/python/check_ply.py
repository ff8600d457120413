#!/usr/bin/env python3
"""Opens a cloud.ply with a reader that is not ours and holds it against the public contract.

usage: check_ply.py CLOUD.ply        needs plyfile (pip install plyfile); prints one line, exit 0 when all holds
"""

import sys

import numpy as np
from plyfile import PlyData

PROPERTIES = [
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("nx", "f4"),
    ("ny", "f4"),
    ("nz", "f4"),
    ("intensity", "u1"),
    ("sigma_z", "f4"),
    ("flags", "u1"),
]


def faults(ply):
    """Every way in which the file breaks the contract."""
    if ply.text or ply.byte_order != "<":
        yield "not binary little endian"
    if [element.name for element in ply.elements] != ["vertex"]:
        yield "elements other than vertex"
        return
    vertex = ply["vertex"]
    if [(p.name, p.val_dtype) for p in vertex.properties] != PROPERTIES:
        yield f"properties are {[(p.name, p.val_dtype) for p in vertex.properties]}"
        return
    for comment in ("units mm", "frame "):
        if not any(text.startswith(comment) for text in ply.comments):
            yield f"no comment '{comment}'"
    floats = [name for name, kind in PROPERTIES if kind == "f4"]
    for name in floats:
        if not np.isfinite(vertex[name]).all():
            yield f"{name} holds numbers that are not finite"
    if len(vertex) and not (vertex["sigma_z"] > 0).all():
        yield "sigma_z is not positive everywhere"
    length = np.sqrt(sum(vertex[name].astype(float) ** 2 for name in ("nx", "ny", "nz")))
    if not ((length == 0) | (abs(length - 1) < 1e-5)).all():
        yield "normals are neither of unit length nor zero"
    if "frame camera frame" in " ".join(ply.comments):
        towards = sum(vertex[a].astype(float) * vertex[b] for a, b in (("nx", "x"), ("ny", "y"), ("nz", "z")))
        if (towards > 1e-6 * np.abs(vertex["z"])).any():
            yield "normals face away from the camera"
    if (vertex["flags"] > 31).any():
        yield "flags beyond bit 4"


def main():
    if len(sys.argv) != 2:
        print(__doc__, file=sys.stderr)
        return 2
    ply = PlyData.read(sys.argv[1])
    found = list(faults(ply))
    for fault in found:
        print(f"{sys.argv[1]}: {fault}", file=sys.stderr)
    if not found:
        print(f"{sys.argv[1]}: {len(ply['vertex'])} points, all as promised")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
