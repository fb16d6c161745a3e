"""Lagrangian of a tree of rigid bodies in joint coordinates, and its kinetic energy as a function of momenta.

The frame of link i has the rotation A_i into the frame of its parent p, and its origin lies at r_i there. Angular
velocity and velocity of the origin, in the frame of the link, follow from the parent's,

    w_i = A_i^T w_p + a q_dot (hinge),    v_i = A_i^T (v_p + w_p x r_i) + a q_dot (slide),

the kinetic energy is the sum of m |v_i + w_i x c_i|^2/2 + w_i . I_i w_i/2, and the first moments of the subtrees are
S_i = m_i c_i + sum over children (m_subtree r_k + A_k S_k). A free base with position x and rotation R adds, with the
total mass M, and the first moment S of the tree and its momentum P for x_dot = 0 in the frame of the base,

    T = M |x_dot|^2/2 + x_dot . R P + T(x_dot = 0),    V = -g . (M x + R S),

where P_i = m_i (v_i + w_i x c_i) + sum over children A_k P_k.

The components of all these vectors are intermediate quantities (:mod:`scvi_codegen.systems.formulas.intermediates`), so
that the energies of n bodies have O(n) operations.

**Momenta.** The kinetic energy as a function of coordinates and momenta follows from articulated-body inertias. From
the leaves to the root each subtree is replaced by its articulated inertia A, a symmetric 6 x 6 matrix, and bias z,
what it would be if its joints were free, seen from the frame of its link (angular components first). For each degree of
freedom of a joint, along the unit vector S, with the momentum p,

    D = S^T A S + armature,    e = p - S^T z,    g = A S/D,
    A <- A - g (A S)^T,        z <- z + g e,

after which A and z are added to those of the parent, in its frame. The innovations e are independent, and

    T(q, p) = p^T M(q)^-1 p/2 = sum of e^2/(2 D),

in O(n) operations for n bodies. The derivatives by p are M^-1 p, in which gains g and pivots D depend on q only.

G. Rodriguez, A. Jain, K. Kreutz-Delgado, A spatial operator algebra for manipulator modeling and control, Int. J.
Robotics Research 10 (1991), 371-381; R. Featherstone, Rigid Body Dynamics Algorithms, Springer 2008, chapters 3, 4, 7.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice
from types import MappingProxyType
from typing import Any

import numpy as np
from sympy import Abs, Add, Expr, Matrix, Rational, S, Symbol, atan2, cos, eye, sin, sqrt, zeros

from scvi_codegen.api.formulas import DOT, Intermediate, Rotation, RotationNames, jacobian, parse_expression, symbol
from scvi_codegen.api.systems import system_from_sympy
from scvi_codegen.common.errors import SystemDefinitionError, SystemDefinitionWarning, closest, warn
from scvi_codegen.extras.robots.trees.tree import (
    SINGLE,
    DrawnLink,
    Joint,
    Link,
    Vector,
    aligned,
    impossible_inertias,
    without_fixed,
)
from scvi_codegen.systems.contact import Contact, Friction, contact, friction


class Tree:
    """Formulas of the links of a tree, from the root to the leaves and back.

    Args:
        links: with parents before their children.
        gravity: acceleration of gravity in the world frame.

    Raises:
        SystemDefinitionError: if nothing moves.
    """

    def __init__(self, links: Sequence[Link], gravity: Vector) -> None:
        links = self.links = aligned(without_fixed(links))
        self.gravity = exact_vector(gravity)
        self.joints = {link.joint.name: link.joint for link in links}
        self.leaders = {joint.name: self.leader(joint) for joint in self.joints.values() if joint.kind in SINGLE}
        self.turns = {link.joint.name: self.turns_of(link.joint) for link in links}
        self.masses = self.of_subtrees([exact_number(link.inertia.mass) for link in links])
        self.weights = self.of_subtrees([exact_number(link.inertia.mass - link.inertia.lift[0]) for link in links])
        self.moments = self.first_moments()

    def coordinate(self, joint: Joint) -> tuple[Expr, Expr]:
        """Return q and q_dot of a hinge or slide."""
        name, factor, offset = self.leaders[joint.name]
        return factor * symbol(name) + offset, factor * symbol(name + DOT)

    def leader(self, joint: Joint) -> tuple[str, Expr, Expr]:
        """Return the name of the joint that one follows, itself or through others, the factor, and the offset."""
        factor, offset = S.One, S.Zero
        while joint.follows is not None:
            other, *numbers = joint.follows
            factor, offset = factor * exact_number(numbers[0]), offset + factor * exact_number(numbers[1])
            joint = self.joints[other]
        return joint.name, factor, offset

    def displacement(self, joint: Joint) -> Expr:
        """Return the coordinate of a hinge or slide from the zero of the model."""
        return self.coordinate(joint)[0] - exact_number(joint.zero)

    def turns_of(self, joint: Joint) -> list[list[list[Expr]]]:
        """Return the factors of A, that of the frame of the parent first."""
        turns = [Matrix(3, 3, rotation_of(joint).entries)] if joint.kind in ("ball", "free") else []
        if joint.kind == "hinge":
            q = self.displacement(joint)
            turns = [Matrix([[cos(q), -sin(q), 0], [sin(q), cos(q), 0], [0, 0, 1]])]
        fixed = [] if joint.kind == "free" else [exact_matrix(joint.pose.rotation)]
        return [turn.tolist() for turn in (*fixed, *turns)]

    def turned(self, joint: Joint, vector: Matrix, *, back: bool = False) -> Matrix:
        """Return a vector turned by A, from the frame of the link to that of its parent; ``back``: by A^T."""
        return Matrix(3, 1, self.components(joint, vector.flat(), back=back))

    def components(self, joint: Joint, vector: Sequence[Expr], *, back: bool = False) -> Sequence[Expr]:
        """Return the components of a vector that is turned."""
        for matrix in self.turns[joint.name] if back else reversed(self.turns[joint.name]):
            rows = zip(*matrix, strict=True) if back else matrix
            vector = [Intermediate.named(Intermediate.sum_of_products(row, vector)) for row in rows]
        return vector

    def origin(self, joint: Joint) -> Matrix:
        """Return the origin of the link in the frame of its parent."""
        at = exact_vector(joint.pose.position)
        return at + exact_matrix(joint.pose.rotation)[:, 2] * self.displacement(joint) if joint.kind == "slide" else at

    def of_subtrees(self, masses: list[Expr]) -> list[Expr]:
        """Return the mass of each subtree from those of the links."""
        for i in reversed(range(len(masses))):
            if self.links[i].parent >= 0:
                masses[self.links[i].parent] += masses[i]
        return masses

    def without_mass(self) -> list[str]:
        """Return the names in the file of the joints that move neither a mass nor a rotor."""
        sizes = self.of_subtrees([exact_number(np.abs(link.inertia.matrix).sum()) for link in self.links])
        joints = [link.joint for link, *parts in zip(self.links, self.masses, sizes, strict=True) if not any(parts)]
        return [joint.label for joint in joints if not (joint.armature or joint.follows)]

    def first_moments(self) -> list[Matrix]:
        """Return the first moment of the weight of each subtree, in the frame of its root."""
        moments = [
            exact_number(inertia.mass) * exact_vector(inertia.center) - exact_vector(inertia.lift[1])
            for inertia in (link.inertia for link in self.links)
        ]
        for i in reversed(range(len(self.links))):
            parent, joint = self.links[i].parent, self.links[i].joint
            if parent >= 0:
                moments[parent] += self.weights[i] * self.origin(joint) + self.turned(joint, moments[i])
                moments[parent] = as_quantities(moments[parent])
        return moments

    def motions(self, *, free: bool) -> list[tuple[Matrix, Matrix]]:
        """Return angular velocities and velocities of the origins of links; ``free``: with those of free bases."""
        motions: list[tuple[Matrix, Matrix]] = []
        along = Matrix([0, 0, 1])
        for link in self.links:
            joint = link.joint
            outer, speed = motions[link.parent] if link.parent >= 0 else (zeros(3, 1), zeros(3, 1))
            w = self.turned(joint, outer, back=True)
            v = self.turned(joint, as_quantities(speed + outer.cross(self.origin(joint))), back=True)
            if joint.kind == "hinge":
                w += along * self.coordinate(joint)[1]
            elif joint.kind == "slide":
                v += along * self.coordinate(joint)[1]
            else:
                w += Matrix(rotation_of(joint).rates)
            if joint.kind == "free" and free:
                v = self.turned(joint, Matrix([symbol(name + DOT) for name in position_of(joint)]), back=True)
            motions.append((as_quantities(w), as_quantities(v)))
        return motions

    def kinetic_energy(self) -> Expr:
        """Return T; bases that are free contribute as in the docstring of the module."""
        terms: list[Expr] = []
        momenta: list[Matrix] = []
        for link, (w, v) in zip(self.links, self.motions(free=False), strict=True):
            velocity = as_quantities(v + w.cross(exact_vector(link.inertia.center)))
            momenta.append(exact_number(link.inertia.mass) * velocity)
            terms.append(velocity.dot(momenta[-1]) / 2)
            terms.append(times(times(w.T, exact_matrix(link.inertia.matrix)), w)[0] / 2)
            terms.append(self.of_rates(link.joint, (link.joint.armature,)))
        return Add(*terms, *self.free_bases(momenta))

    def free_bases(self, momenta: list[Matrix]) -> Iterator[Expr]:
        """Yield the kinetic energies of the velocities of free bases.

        Args:
            momenta: of the links, in their frames, where the bases do not move but turn.
        """
        for i in reversed(range(len(self.links))):
            parent, joint = self.links[i].parent, self.links[i].joint
            if joint.kind == "free":
                velocity = Matrix([symbol(name + DOT) for name in position_of(joint)])
                yield self.masses[i] * velocity.dot(velocity) / 2 + velocity.dot(self.turned(joint, momenta[i]))
            elif parent >= 0:
                momenta[parent] = as_quantities(momenta[parent] + self.turned(joint, momenta[i]))

    def rates(self, joint: Joint) -> list[Expr]:
        """Return the rate of a hinge or slide, and the angular velocity and the velocity of others."""
        if joint.kind in SINGLE:
            return [self.coordinate(joint)[1]]
        moved = position_of(joint) if joint.kind == "free" else ()
        return [*rotation_of(joint).rates, *(symbol(name + DOT) for name in moved)]

    def of_rates(self, joint: Joint, coefficients: Sequence[float]) -> Expr:
        """Return the sum of :func:`integral` over the magnitudes of the rates of a joint."""
        return Add(*(integral(coefficients, Abs(rate)) for rate in self.rates(joint)))

    def potential_energy(self) -> Expr:
        """Return V of gravity and springs."""
        terms: list[Expr] = []
        for i, link in enumerate(self.links):
            joint = link.joint
            if link.parent < 0:
                position = self.origin(joint)
                if joint.kind == "free":
                    position = Matrix([symbol(name) for name in position_of(joint)])
                place = self.weights[i] * position + self.turned(joint, self.moments[i])
                terms.append(-self.gravity.dot(place))
            if any(joint.stiffness):
                terms += [integral(joint.stiffness, x) for x in self.extensions(joint)]
        return Add(*terms)

    def extensions(self, joint: Joint) -> Iterator[Expr]:
        """Yield the displacements of springs, of a rotation its angle."""
        if joint.kind in SINGLE:
            yield self.coordinate(joint)[0] - exact_number(joint.rest)
            return
        turn = Matrix(3, 3, rotation_of(joint).entries)
        if joint.kind == "free":
            away = Matrix([symbol(name) for name in position_of(joint)]) - exact_vector(joint.pose.position)
            yield sqrt(away.dot(away) + TINY)
            turn = exact_matrix(joint.pose.rotation).T * turn
        yield rotation_vector(turn)[1]

    def dissipation(self) -> Expr:
        """Return Rayleigh's function of the damping of joints."""
        return Add(*(self.of_rates(joint, joint.damping) for joint in self.joints.values()))

    def loads_of_medium(self) -> Iterator[tuple[Expr, Expr]]:
        """Yield forces and torques of the medium, with the velocities along which they act."""
        at_rest = not any(link.inertia.drag for link in self.links)
        for link, (w, v) in zip(self.links, [] if at_rest else self.motions(free=True), strict=False):
            for pose, law in link.inertia.drag:
                axes = exact_matrix(pose.rotation).T
                spin, speed = (as_quantities(axes * x) for x in (w, v + w.cross(exact_vector(pose.position))))
                yield from zip(law(spin, speed), (*spin, *speed), strict=True)

    def contacts(self, law: Mapping[str, Any]) -> Iterator[Contact | Friction]:
        """Yield the contacts of joints with limits, and the dry friction of joints.

        A hinge or slide has the gaps q - low and high - q. A rotation R by an angle a <= high, with cos a = (tr R -
        1)/2, has the gap (cos a - cos high)/sin high, which is smooth at a = 0.
        """
        for joint in self.joints.values():
            low, high = joint.limits or (0.0, 0.0)
            of = f"limit of joint '{joint.label}' of the range {low:g} to {high:g}"
            if joint.limits is not None and joint.kind in SINGLE:
                yield from limits_of(self.coordinate(joint)[0], low, high, of, law)
            elif high and high < np.pi:
                cosine, edge = Matrix(3, 3, rotation_of(joint).entries).trace() / 2 - S.Half, exact_number(high)
                yield contact((cosine - cos(edge)) / sin(edge), name=of, **law)
            for rate in self.rates(joint) if joint.dry_friction else ():
                limit = exact_number(joint.dry_friction)
                yield friction(rate, limit=limit, name=f"dry friction of joint '{joint.label}'")

    def arguments(
        self, actuated: Collection[str] | bool, actuating: Iterable[tuple[Expr, Expr]] = ()
    ) -> dict[str, Any]:
        """Return arguments of :meth:`LagrangianSystem.from_sympy`: coordinates, rotations, lagrangian, forces.

        Args:
            actuated: names of the joints on which an input ``tau_NAME`` acts, or ``True`` for all hinges and slides.
            actuating: forces of actuators, with the rates along which they act.

        Raises:
            SystemDefinitionError: if a joint does not exist.
        """
        joints = [*self.joints.values()]
        singles = [joint.name for joint in joints if joint.kind in SINGLE and not joint.follows]
        driven = self._driven(actuated, singles)
        free = [joint for joint in joints if joint.kind == "free"]
        turning = [rotation_of(joint) for joint in joints if joint.kind in ("ball", "free")]
        names_of_q = [*chain.from_iterable(map(position_of, free)), *singles]
        rates = [*(symbol(name + DOT) for name in names_of_q), *chain(*(rotation.rates for rotation in turning))]
        pulls = {symbol(joint.name + DOT): joint.pull for joint in joints}
        acting = map(between, forces_on(rates, actuating), map(pulls.get, rates))
        loads = map(Add, forces_on(rates, self.loads_of_medium()), acting)
        forces = {name: next(loads) + (symbol(f"tau_{name}") if name in driven else 0) for name in names_of_q}
        return {
            "coordinates": [*map(symbol, names_of_q)],
            "rotations": {rotation.name: rotation.rate for rotation in turning},
            "lagrangian": self.kinetic_energy() - self.potential_energy(),
            "dissipation": self.dissipation(),
            "forces": {name: force for name, force in forces.items() if force != 0},
            "torques": {turn.name: load for turn in turning if any(load := [*islice(loads, 3)])},
            "inputs": [f"tau_{name}" for name in driven],
        }

    def _driven(self, actuated: Collection[str] | bool, singles: Sequence[str]) -> list[str]:
        """Return the names of the hinges and slides on which inputs act."""
        if isinstance(actuated, bool):
            return [*singles] * actuated
        names = {joint.label: joint.name for joint in self.joints.values()}
        driven = [names.get(name, name) for name in actuated]
        if unknown := [name for name in driven if name not in singles]:
            name = unknown[0]
            raise SystemDefinitionError(f"there is no hinge or slide '{name}' to act on{closest(name, singles)}")
        return driven


def forces_on(rates: Sequence[Symbol], loads: Iterable[tuple[Expr, Expr]]) -> Iterator[Expr]:
    """Yield the force on each rate u, the sum of F dv/du over loads F and the velocities v along which they act."""
    held = {symbol(f"_load_{k}"): pair for k, pair in enumerate(loads)}
    power = Add(*(load * along for load, (_, along) in held.items()))
    values = {load: Intermediate.named(value) for load, (value, _) in held.items()}
    slopes = jacobian([power], rates)
    yield from (slopes.get((0, k), S.Zero).xreplace(values) for k in range(len(rates)))


def between(force: Expr, bounds: tuple[float, float] | None) -> Expr:
    """Return a force that is clamped to a range."""
    if bounds is None or force == 0:
        return force
    force, (low, high) = Intermediate.named(force), map(exact_number, bounds)
    return force + positive_part(low - force) - positive_part(force - high)


def rotation_of(joint: Joint) -> Rotation:
    """Return the rotation of a ball joint or free body: ``R_NAME`` with the angular velocity ``omega_NAME``."""
    return Rotation(f"R_{joint.name}", f"omega_{joint.name}")


def rotation_vector(turn: Matrix) -> tuple[Matrix, Expr]:
    """Return a n and a = atan2(|R - R^T|_F/8^(1/2), (tr R - 1)/2) of the rotation R by a about the unit vector n."""
    along = Matrix([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    sine = sqrt(along.dot(along) + TINY)
    angle = atan2(sine, (turn.trace() - 1) / 2)
    return along * Intermediate.named(angle / sine), angle


def position_of(joint: Joint) -> tuple[str, ...]:
    """Return the names of the position of a free body: ``x_NAME``, ``y_NAME``, ``z_NAME``."""
    return tuple(f"{axis}_{joint.name}" for axis in "xyz")


def integral(coefficients: Sequence[float], x: Expr) -> Expr:
    """Return c1 x^2/2 + c2 x^3/3 + ..: the energy of a spring with the force c1 x + c2 x^2 + .."""
    return Add(*(exact_number(c) * x**k / k for k, c in enumerate(coefficients, 2)))


def limits_of(length: Expr, low: float, high: float, name: str, law: Mapping[str, Any]) -> Iterator[Contact | Friction]:
    """Yield the contacts at the ends of the range of a coordinate or length."""
    yield contact(length - exact_number(low), name=f"lower {name}", **law)
    yield contact(exact_number(high) - length, name=f"upper {name}", **law)


def times(a: Matrix, b: Matrix) -> Matrix:
    """Return the product of matrices, faster than SymPy, which converts their entries."""
    columns = [*zip(*b.tolist(), strict=True)]
    return Matrix([[Intermediate.sum_of_products(row, column) for column in columns] for row in a.tolist()])


def positive_part(x: Expr) -> Expr:
    """Return x where it is positive, else 0."""
    return parse_expression("positive_part(x)", {"x": x})


def plus(*matrices: Matrix) -> Matrix:
    """Return the sum of matrices, faster than SymPy, too."""
    return Matrix(
        *matrices[0].shape,
        [Intermediate.sum_of_products(terms) for terms in zip(*(matrix.flat() for matrix in matrices), strict=True)],
    )


def as_quantities(vector: Matrix) -> Matrix:
    """Return a vector of intermediate quantities."""
    return vector.applyfunc(Intermediate.named)


def exact_number(value: float) -> Expr:
    """Return the rational number that a floating-point number is printed as."""
    return S(int(value)) if value == int(value) else Rational(repr(float(value)))


def exact_vector(values: Vector) -> Matrix:
    """Return a vector of such numbers."""
    return Matrix([exact_number(float(component)) for component in values])


def exact_matrix(values: Vector) -> Matrix:
    """Return a matrix of such numbers."""
    return Matrix([[exact_number(float(entry)) for entry in row] for row in values])


TINY = Rational(1, 10**60)  # of squares of lengths and angles, whose roots have derivatives everywhere
SMALLEST = 12
"""Smallest number of degrees of freedom for which the recursion is used; below, the mass matrix is factorised."""


def system_of_tree(
    kind: Any,
    name: str,
    links: Sequence[Link],
    gravity: Vector,
    actuated: Collection[str] | bool,
    constraints: Sequence[Expr] = (),
    check_inertias: bool = True,
    tendons: tuple[Expr, Expr, Expr] = (S.Zero, S.Zero, S.Zero),
    touching: Sequence[Contact | Friction] = (),
    law: Mapping[str, Any] = MappingProxyType({}),
    actuators: Sequence[Any] = (),
    **own: Any,
) -> Any:
    """Return the system of a tree, of class ``kind``, energies of tendons, contacts, actuators; see :class:`Tree`."""
    tree = Tree(links, gravity)
    for problem in impossible_inertias(tree.links):
        if check_inertias:
            raise SystemDefinitionError(f"{problem}, or integrate it as it is written by check_inertias=False")
        warn(problem, SystemDefinitionWarning)
    contacts = *tree.contacts(law), *touching

    def made(**fields: Any) -> Any:
        members = fields.get("rotations", ())
        pictures = tuple(DrawnLink.of(link, tree.leaders.get(link.joint.name)) for link in tree.links)
        ranges = tuple((name, *limits) for _, name, limits, _ in actuators if limits is not None)
        names = {label: name for label, name, *_ in actuators}
        fields |= {"links": pictures, "contacts": contacts, "input_ranges": ranges, "actuators": names, **own}
        if constraints or contacts or tendons[0] != 0 or len(fields["coordinates"]) - len(members) < SMALLEST:
            return kind(**fields)
        return kind(**fields, dual_energy=_in_quaternions(dual_energy(tree), **fields))

    arguments = tree.arguments(actuated, [acting for *_, acting in actuators])
    formula = arguments.pop("lagrangian") + tendons[0] - tendons[1]
    arguments["dissipation"] = Add(arguments["dissipation"], tendons[2]) or None
    arguments["inputs"] += [name for _, name, *_ in actuators]
    try:
        return system_from_sympy(made, "Lagrangian", formula, name=name, constraints=constraints, **arguments)
    except SystemDefinitionError as error:
        if idle := tree.without_mass():
            raise SystemDefinitionError(
                f"joint '{idle[0]}' moves no mass: give a link that it carries an <inertial>, or fix the joint"
            ) from error
        raise


def _in_quaternions(
    energy: Expr, *, parameters: Sequence[Symbol], rotations: Sequence[Any] = (), reduced: Any = None, **_: Any
) -> Expr:
    """Return the dual energy of the Lagrangian with these fields, with the energy of the lengths of quaternions."""
    names = RotationNames([replace(rotation, momentum=True) for rotation in rotations])
    if energy == 0 or not names.members:
        return energy
    gauge = names.gauge(lambda rotation: names.inertia(rotation, reduced.lagrangian, parameters))
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
            pivot = Intermediate.named(inertia[axis, axis] + exact_number(joint.armature))
            if joint.follows or pivot == 0:
                return S.Zero
            innovation = Intermediate.named(momentum - bias[axis])
            gain = as_quantities(inertia[:, axis] / pivot)
            terms.append(innovation**2 / (2 * pivot))
            inertia = as_quantities(_symmetric(plus(inertia, times(gain, -inertia[:, axis].T))))
            bias = as_quantities(bias + gain * innovation)
            if gain[axis] == 1:
                bias[axis] = momentum
        if parent >= 0:
            moved, pushed = _in_parent(tree, joint, inertia, bias)
            inertias[parent] = as_quantities(_symmetric(plus(inertias[parent], moved)))
            biases[parent] = as_quantities(plus(biases[parent], pushed))
    return Add(*terms)


def _degrees_of_freedom(tree: Tree, joint: Joint) -> Iterator[tuple[int, Expr]]:
    """Yield the axes of a joint, among three angular and three linear ones, with their momenta."""
    if joint.kind in ("hinge", "slide"):
        yield 2 if joint.kind == "hinge" else 5, symbol(f"p_{joint.name}")
    else:
        yield from enumerate(rotation_of(joint).rates)
    if joint.kind == "free":
        momentum = Matrix([symbol(f"p_{name}") for name in position_of(joint)])
        yield from enumerate(tree.turned(joint, momentum, back=True), 3)


def _in_parent(tree: Tree, joint: Joint, inertia: Matrix, bias: Matrix) -> tuple[Matrix, Matrix]:
    arm = tree.origin(joint).hat()
    angular, mixed, linear = (
        _turned_twice(tree, joint, block) for block in (inertia[:3, :3], inertia[:3, 3:], inertia[3:, 3:])
    )
    moved = as_quantities(plus(mixed, times(arm, linear)))
    angular = plus(angular, times(mixed, arm.T), times(arm, moved.T))
    torque, force = (tree.turned(joint, part) for part in (bias[:3, :], bias[3:, :]))
    return Matrix([[angular, moved], [moved.T, linear]]), Matrix([plus(torque, times(arm, force)), force])


def _turned_twice(tree: Tree, joint: Joint, block: Matrix) -> Matrix:
    """Return A X A^T, where A is the rotation of a joint."""
    rows = block.tolist()
    for _ in range(2):
        rows = [tree.components(joint, column) for column in zip(*rows, strict=True)]
    return Matrix(rows)


def _symmetric(matrix: Matrix) -> Matrix:
    """Return a symmetric matrix with the entries of its lower half in both."""
    return Matrix(*matrix.shape, lambda i, j: matrix[max(i, j), min(i, j)])
