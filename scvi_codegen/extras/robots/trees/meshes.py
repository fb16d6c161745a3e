"""Inertias of meshes of triangles, by the four rules of ``inertia=`` of MJCF.

A triangle with the corners a, b, c and a point o (a, b, c from there) span a tetrahedron of the signed volume
V = a x b . c/6, over which the integral of x x^T is V/20 (a a^T + b b^T + c c^T + s s^T) with s = a + b + c; over the
triangle it is A/12 times the same sum. F. Tonon, Explicit exact formulas for the 3-D tetrahedron inertia tensor in
terms of its vertex coordinates, J. Math. Stat. 1 (2005), 8-11. "convex" is the hull, "shell" the surface, and "legacy"
takes all volumes as positive, first from the centroid of the surface, whence the center of mass, and then from there.
"""

from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element as Node

import numpy as np
import scipy
from numpy.typing import NDArray

from scvi_codegen.common.errors import imported
from scvi_codegen.extras.robots.trees.document import Element, bytes_of
from scvi_codegen.extras.robots.trees.tree import Inertia, Vector, rotation_by

LARGEST = 1e15
"""Bound of the coordinates of corners, beside which 1 is not lost to rounding."""
FLAT = 1e-7
"""Volumes that are smaller parts of the power 3/2 of the surface are due to the single precision of corners."""


def inertia_of(geom: Element, computed: dict[Node, Inertia]) -> Inertia:
    """Return the inertia of the ``<mesh>`` of a geom, of density 1, whose name is by default that of its file."""
    meshes = [mesh for assets in geom.document.children("asset") for mesh in assets.children("mesh")]
    names = {mesh.node.get("name", Path(mesh.node.get("file", "")).stem): mesh for mesh in meshes}
    mesh = geom.named_by("mesh", "mesh", names)
    computed[mesh.node] = computed.get(mesh.node) or _inertia(mesh)
    return computed[mesh.node]


def _inertia(mesh: Element) -> Inertia:
    rule, (corners, faces) = mesh.choice("inertia", "legacy", "convex", "exact", "shell"), _read(mesh)
    if rule == "convex" and mesh.number("maxhullvert", -1) > 0:
        mesh.refuse("has inertia='convex' and maxhullvert, a hull that is not computed: remove one")
    if rule == "convex" or not len(faces):
        try:
            rule, faces = "shell" if rule == "shell" else "convex", scipy.spatial.ConvexHull(corners).simplices
        except (scipy.spatial.QhullError, ValueError) as error:
            problem = "is flat or too narrow for a convex hull: give faces and inertia='shell'"
            mesh.refuse(f"{problem} ({str(error).strip().splitlines()[0]})")
    merged = np.unique(corners, axis=0, return_inverse=True)[1].reshape(-1)[faces]
    sides = np.concatenate([merged[:, [i, (i + 1) % 3]] for i in range(3)])
    if rule == "exact" and len(np.unique(sides, axis=0)) < len(sides):
        mesh.refuse("has triangles with opposite orientations: turn them, or use inertia='convex'")
    scale, turn = mesh.vector("scale", (1, 1, 1)), mesh.vector("refquat", (1, 0, 0, 0), (4,))
    with np.errstate(all="ignore"):
        corners = (corners - mesh.vector("refpos", (0, 0, 0))) @ rotation_by(turn) * scale
        triangles = corners[faces][:, :: -1 if np.prod(scale) < 0 else 1]
        inertia, surface = _integrals(triangles, rule), _integrals(triangles, "shell").mass
    if not (abs(inertia.mass) > FLAT * surface**1.5 or rule == "shell"):
        mesh.refuse("is flat, without a volume: use inertia='shell', or a thin box")
    if not inertia.mass > 0:
        mesh.refuse(f"has the volume {inertia.mass:g}: turn its triangles, or use inertia='convex' or 'shell'")
    return inertia


def _integrals(triangles: Vector, rule: str) -> Inertia:
    """Return the inertia of (n, 3, 3) corners of triangles."""
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas, middles = np.linalg.norm(across, axis=1) / 2, triangles.mean(axis=1)

    def sizes(point: Vector) -> Vector:
        volumes: Vector = ((middles - point) * across).sum(axis=1) / 6
        weights: Vector = {"shell": areas, "exact": volumes}.get(rule, np.abs(volumes))
        return weights

    center = areas @ middles / areas.sum()
    if rule != "shell":
        center = sizes(center) @ (3 * middles + center) / 4 / sizes(center).sum()
    corners = np.concatenate([triangles - center, 3 * (middles - center)[:, None]], axis=1)
    moments = np.einsum("n,nik,nil->kl", sizes(center), corners, corners) / (12 if rule == "shell" else 20)
    return Inertia(float(sizes(center).sum()), center, np.trace(moments) * np.eye(3) - moments)


def _read(mesh: Element) -> tuple[Vector, NDArray[np.intp]]:
    """Return the corners, in single precision as MuJoCo, and the triangles as indices of these."""
    if mesh.text("builtin", "none") != "none" or mesh.children("plugin"):
        mesh.refuse("is made by MuJoCo, and its inertia is not computed: give the bodies with it an <inertial>")
    corners, faces = (mesh.vector(key, (), range(2**31)) for key in ("vertex", "face"))
    if mesh.has("file"):
        file, settings = Path(mesh.text("file")), mesh.settings
        file = Path(file.name) if settings.choice("strippath", "false", "true") == "true" else file
        file = mesh.path(str(settings.text("meshdir", settings.text("assetdir", "")) / file))
        corners, faces = (_of_msh if file.suffix.lower() == ".msh" else _of_known_format)(mesh, file)
    if len(corners) < 12 or len(corners) % 3 or len(faces) % 3 or not set(faces) <= {*range(len(corners) // 3)}:
        mesh.refuse("needs at least 4 vertices, and faces of 3 of their numbers each")
    if not (np.abs(corners) < LARGEST).all():
        mesh.refuse(f"has vertices that are not finite or not smaller than {LARGEST:g}: use other units of length")
    return corners.astype(np.float32).astype(float).reshape(-1, 3), faces.astype(int).reshape(-1, 3)


def _of_known_format(mesh: Element, file: Path) -> tuple[Vector, NDArray[Any]]:
    data, trimesh = BytesIO(bytes_of(file)), imported("trimesh", "meshes")
    try:
        read = trimesh.load_scene(data, file_type=file.suffix[1:].lower(), process=False).to_geometry()
    except Exception as error:  # noqa: BLE001 - of the readers of many formats
        mesh.refuse(f"is in the file {file}, which cannot be read as STL, OBJ or another known format: {error}")
    return np.asarray(read.vertices).ravel(), np.ravel(getattr(read, "faces", ()))  # none: a point cloud


def _of_msh(mesh: Element, file: Path) -> tuple[Vector, NDArray[Any]]:
    """Return the numbers of MuJoCo's format: four counts, vertices, normals, texture coordinates, triangles.

    https://mujoco.readthedocs.io/en/stable/XMLreference.html#asset-mesh
    """
    data = bytes_of(file)
    counts = np.frombuffer(data[:16].ljust(16, b"\xff"), "<i4").astype(int)
    ends = 16 + 4 * np.cumsum(counts * (3, 3, 2, 3))
    if counts.min() < 0 or ends[3] != len(data):
        mesh.refuse(f"is in the file {file} of {len(data)} bytes, whose first numbers are not the counts of MSH files")
    return np.frombuffer(data[16 : ends[0]], "<f4"), np.frombuffer(data[ends[2] :], "<i4")
