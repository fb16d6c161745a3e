"""Meshes of fields from the section that recorded runs store."""

from collections.abc import Mapping
from typing import Any

from scvi_codegen.extras.fields.mesh import MeshSystem
from scvi_codegen.extras.fields.system import FieldSystem


def mesh_of(section: Mapping[str, Any], parameters: Mapping[str, Any]) -> MeshSystem:
    """Return the mesh of a section ``[field]`` (``Mesh.to_section``) with values of its parameters."""
    options = (arguments := dict(section)).pop("discretisation")
    return FieldSystem.from_text(**arguments, parameters=parameters).discretise(**options)
