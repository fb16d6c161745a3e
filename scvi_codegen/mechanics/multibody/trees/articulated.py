"""Kinetic energy of a tree of rigid bodies as a function of coordinates and momenta, by articulated-body inertias.

From the leaves to the root each subtree is replaced by its articulated inertia A, a symmetric 6 x 6 matrix, and bias z,
what it would be if its joints were free, seen from the frame of its link (angular components first). For each degree of
freedom of a joint, along the unit vector S, with the momentum p,

    D = S^T A S + armature,    e = p - S^T z,    g = A S/D,
    A <- A - g (A S)^T,        z <- z + g e,

after which A and z are added to those of the parent, in its frame. The innovations e are independent, and

    T(q, p) = p^T M(q)^-1 p/2 = sum of e^2/(2 D),

in O(n) operations for n bodies. The derivatives by p are M^-1 p, in which gains g and pivots D depend on q only.

G. Rodriguez, A. Jain, K. Kreutz-Delgado, A spatial operator algebra for manipulator modeling and control, Int. J.
Robotics Research 10 (1991), 371-381; R. Featherstone, Rigid Body Dynamics Algorithms, Springer 2008, chapter 7.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any

from sympy import Add, Expr, Matrix, S, Symbol, eye, zeros

from scvi_codegen.formulas.intermediates import intermediate
from scvi_codegen.formulas.rotations import RotationNames
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.mechanics.multibody.trees.energies import (
    Tree,
    as_quantities,
    exact_matrix,
    exact_number,
    exact_vector,
    position_of,
    rotation_of,
)
from scvi_codegen.mechanics.multibody.trees.tree import DrawnLink, Joint, Link, Vector
from scvi_codegen.mechanics.reading import default_momenta, system_from_sympy

SMALLEST = 12
"""Smallest number of degrees of freedom for which the recursion is used; below, the mass matrix is factorised."""


def system_of_tree(
    kind: Any,
    name: str,
    links: Sequence[Link],
    gravity: Vector,
    actuated: Collection[str] | bool,
    constraints: Sequence[Expr] = (),
) -> Any:
    """Return the system of a tree, of class ``kind``; other arguments as of :class:`Tree` and its ``arguments``."""
    tree = Tree(links, gravity)

    def made(**fields: Any) -> Any:
        members, fields = fields.get("rotations", ()), fields | {"links": tuple(map(DrawnLink.of, tree.links))}
        if constraints or len(fields["coordinates"]) - len(members) < SMALLEST:
            return kind(**fields)
        return kind(**fields, dual_energy=_in_quaternions(dual_energy(tree), **fields))

    arguments = tree.arguments(actuated)
    formula = arguments.pop("lagrangian")
    return system_from_sympy(made, "Lagrangian", formula, name=name, constraints=constraints, **arguments)


def _in_quaternions(
    energy: Expr, *, parameters: Sequence[Symbol], rotations: Sequence[Any] = (), reduced: Any = None, **_: Any
) -> Expr:
    """Return the dual energy of the Lagrangian with these fields, with the energy of the lengths of quaternions."""
    names = RotationNames([replace(each, momentum=True) for each in rotations])
    if energy == 0 or not names.members:
        return energy
    gauge = names.gauge(lambda each: names.inertia(each, reduced.lagrangian, parameters))
    return names.in_coordinates(energy) + gauge


def dual_energy(tree: Tree) -> Expr:
    """Return T(q, p), with the body momenta of rotations by the names of their angular velocities; 0 if unknown.

    It is unknown if a joint follows another one, or a joint moves no mass.
    """
    inertias, biases = [], [zeros(6, 1) for _ in tree.links]
    for link in tree.links:
        m, c = exact_number(link.inertia.mass), exact_vector(link.inertia.center).hat()
        matrix = exact_matrix(link.inertia.matrix)
        inertias.append(Matrix([[matrix - m * c * c, m * c], [-m * c, m * eye(3)]]))
    terms: list[Expr] = []
    for i in reversed(range(len(tree.links))):
        parent, joint = tree.links[i].parent, tree.links[i].joint
        inertia, bias = inertias[i], biases[i]
        for axis, momentum in _degrees_of_freedom(tree, joint):
            pivot = intermediate(inertia[axis, axis] + exact_number(joint.armature))
            if joint.follows or pivot == 0:
                return S.Zero
            innovation = intermediate(momentum - bias[axis])
            gain = as_quantities(inertia[:, axis] / pivot)
            terms.append(innovation**2 / (2 * pivot))
            inertia = as_quantities(_symmetric(inertia - gain * inertia[:, axis].T))
            bias = as_quantities(bias + gain * innovation)
            if gain[axis] == 1:
                bias[axis] = momentum
        if parent >= 0:
            moved, pushed = _in_parent(tree, joint, inertia, bias)
            inertias[parent] = as_quantities(_symmetric(inertias[parent] + moved))
            biases[parent] = as_quantities(biases[parent] + pushed)
    return Add(*terms)


def _degrees_of_freedom(tree: Tree, joint: Joint) -> Iterator[tuple[int, Expr]]:
    """Yield the axes of a joint, among three angular and three linear ones, with their momenta."""
    if joint.kind in ("hinge", "slide"):
        yield 2 if joint.kind == "hinge" else 5, symbol(*default_momenta([joint.name]))
    else:
        yield from enumerate(rotation_of(joint).rates)
    if joint.kind == "free":
        momentum = Matrix([symbol(name) for name in default_momenta(position_of(joint))])
        yield from enumerate(tree.turned(joint, momentum, back=True), 3)


def _in_parent(tree: Tree, joint: Joint, inertia: Matrix, bias: Matrix) -> tuple[Matrix, Matrix]:
    arm = tree.origin(joint).hat()
    angular, mixed, linear = (
        _turned_twice(tree, joint, block) for block in (inertia[:3, :3], inertia[:3, 3:], inertia[3:, 3:])
    )
    moved = as_quantities(mixed + arm * linear)
    angular += mixed * arm.T + arm * moved.T
    torque, force = (tree.turned(joint, part) for part in (bias[:3, :], bias[3:, :]))
    return Matrix([[angular, moved], [moved.T, linear]]), Matrix([torque + arm * force, force])


def _turned_twice(tree: Tree, joint: Joint, block: Matrix) -> Matrix:
    """Return A X A^T, where A is the rotation of a joint."""
    for _ in range(2):
        block = Matrix.hstack(*(tree.turned(joint, block[:, k]) for k in range(3))).T
    return block


def _symmetric(matrix: Matrix) -> Matrix:
    """Return a symmetric matrix with the entries of its lower half in both."""
    return Matrix(*matrix.shape, lambda i, j: matrix[max(i, j), min(i, j)])
