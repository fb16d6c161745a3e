"""Validation of method arguments: nodes, quadrature and space of trial curves, given as objects or names."""

from __future__ import annotations

from scvi_codegen.errors import MethodError
from scvi_codegen.tables.nodes import Nodes, nodes_by_name
from scvi_codegen.tables.quadrature import Quadrature, gauss_legendre, quadrature_by_name
from scvi_codegen.tables.spaces import CurveSpace, Polynomials, space_by_name


def resolve_quadrature(quadrature: Quadrature | str | None, degree: int) -> Quadrature:
    """Return a quadrature from an object or a name; by default ``degree`` Gauss points."""
    if quadrature is None:
        return gauss_legendre(degree)
    if isinstance(quadrature, str):
        return quadrature_by_name(quadrature)
    if not isinstance(quadrature, Quadrature):
        raise MethodError(
            f"quadrature must be a Quadrature, or a name such as 'gauss-legendre:{degree}', not {quadrature!r}"
        )
    return quadrature


def resolve_space(space: CurveSpace | str | None) -> CurveSpace:
    """Return a space of trial curves from an object or a name; by default polynomials."""
    if space is None:
        return Polynomials()
    if isinstance(space, str):
        return space_by_name(space)
    if not isinstance(space, CurveSpace):
        raise MethodError(f"space must be a CurveSpace, or a name such as 'splines:2', not {space!r}")
    return space


def resolve_nodes(nodes: Nodes | str | None, degree: int) -> Nodes:
    """Return nodes from an object or a name, checked to contain both ends; by default Chebyshev-Lobatto nodes."""
    if nodes is None:
        nodes = "chebyshev-lobatto"
    if isinstance(nodes, str):
        nodes = nodes_by_name(nodes, degree)
    if not isinstance(nodes, Nodes):
        raise MethodError(f"nodes must be Nodes, or a name such as 'chebyshev-lobatto', not {nodes!r}")
    if nodes.degree != degree:
        raise MethodError(
            f"nodes of degree {nodes.degree} do not match a curve of degree {degree}: give nodes of degree {degree}"
        )
    if not nodes.contains_ends:
        raise MethodError(
            f"the nodes '{nodes.name}' lack an end point of the step, but Q^0 = q0 and Q^s = q1 must be node values; "
            "use chebyshev-lobatto, legendre-lobatto or equispaced"
        )
    return nodes
