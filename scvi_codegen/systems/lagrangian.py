"""Lagrangian systems, built from text, from SymPy expressions, or from sympy.physics.mechanics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal

from scvi_codegen.common.atomic import naming_folders
from scvi_codegen.common.collection import without_collection
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.common.registry import part
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import FORMULAS, MAPPED, NAMES, NUMBERS, TEXTS, ArgumentType, checks_arguments
from scvi_codegen.systems.contact import Impacts
from scvi_codegen.systems.formulas.table import tables_of
from scvi_codegen.systems.system import MechanicalSystem, tables_of_contacts, zero

if TYPE_CHECKING:
    from os import PathLike

    from sympy import Expr, Symbol
    from sympy.physics.mechanics import KanesMethod, LagrangesMethod, System

    from scvi_codegen.systems.contact import ContactLike
    from scvi_codegen.systems.formulas.rotations import Reduced
    from scvi_codegen.systems.formulas.table import Table

LAGRANGES_METHOD = ArgumentType("a LagrangesMethod of sympy.physics.mechanics", lambda value: hasattr(value, "lam_vec"))
KANES_METHOD = ArgumentType("a KanesMethod of sympy.physics.mechanics", lambda value: hasattr(value, "kindiffdict"))
JOINTS = ArgumentType(
    "a list of names of joints, or True for all", lambda value: value in (True, False) or NAMES.accepts(value)
)
PART = ArgumentType("'contact' or 'ignore'", lambda value: value in ("contact", "ignore"))
RESTITUTION = ArgumentType("a number from 0 to 1", lambda value: isinstance(value, Real) and 0 <= float(value) <= 1)
PLANES = ArgumentType("'planes' or 'ignore'", lambda value: value in ("planes", "ignore"))
LAWS = ArgumentType("'sequential' or 'simultaneous'", lambda value: value in [*Impacts])
ROBOT = {"actuated": JOINTS, "limits": PART, "friction": PART, "restitution": RESTITUTION, "impacts": LAWS}
BODIES = ArgumentType("a System of sympy.physics.mechanics", lambda value: hasattr(value, "actuators"))


@dataclass(frozen=True, slots=True, kw_only=True)
class LagrangianSystem(MechanicalSystem):
    """Lagrangian L(q, q_dot, t; parameters) in m coordinates, validated on construction.

    Build one with ``from_text``, ``from_sympy``, or from SymPy's mechanics with ``from_lagranges_method``,
    ``from_kanes_method`` and ``from_system``, or from a robot's file with ``from_urdf`` and ``from_mjcf``. Equality is
    structural.

    Attributes:
        name, coordinates, time, parameters, defaults: see :class:`~scvi_codegen.systems.system.MechanicalSystem`.
        lagrangian: L, exact: it contains no floating-point numbers.
        reduced: of a system with rotations or directions, its formulas in the names of these.
        dual_energy: the kinetic energy as a function of coordinates and momenta if that takes fewer operations than the
            mass matrix, which then is not computed, else 0.
        links: of a robot from a file, the geometry of its moving links.
        actuators, keys: names of the inputs of its actuators, and its keyframes, by their names in the file.
        gauge: energy of the rates of constraints that determine the velocities of massless coordinates, else 0
            (:mod:`scvi_codegen.systems.checks.definition`).

    Raises:
        SystemDefinitionError: naming the symbol at fault, if a name is invalid or used twice, L contains an unknown
            symbol or an unsupported function, a default value is not a finite number, a velocity does not occur in L,
            or the mass matrix d2L/dv2 is singular at every sampled point, and constraints do not make up for it.
    """

    lagrangian: Expr
    reduced: Reduced | None = None
    dual_energy: Expr = field(default_factory=zero)
    gauge: Expr = field(default_factory=zero, init=False, compare=False, repr=False)
    links: tuple[Any, ...] = field(default=(), compare=False, repr=False)
    actuators: Mapping[str, str] = field(default_factory=dict, compare=False, repr=False)
    keys: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, compare=False, repr=False)

    __repr__ = summary("name", "coordinates")

    def __post_init__(self) -> None:
        from scvi_codegen.systems.checks.definition import checked_gauge

        object.__setattr__(self, "gauge", checked_gauge(self))
        if self.bath:
            from scvi_codegen.systems.bath import check_bath

            check_bath(self)

    auxiliaries = ()

    @property
    def drawn_links(self) -> tuple[Any, ...]:
        """Links of a robot from a file, for pictures; those that were read from text have none."""
        return self.links if self._text is None else ()

    @property
    def joint_names(self) -> dict[str, str]:
        """Names of the joints of a robot in this system by their names in the file."""
        return {link.label: link.name for link in self.links}

    @property
    def keyframes(self) -> dict[str, dict[str, Any]]:
        """States of a robot as arguments of ``integrate``: ``"qpos0"``, at rest at its reference, and its file's."""
        keyframe = part("readers", "keyframe")
        return {name: keyframe(self.links, self.inputs, key) for name, key in {"qpos0": {}, **self.keys}.items()}

    @property
    def formula(self) -> Expr:
        """L."""
        return self.lagrangian

    @classmethod
    @checks_arguments(SystemDefinitionError, constraints=TEXTS)
    def from_text(
        cls,
        name: str,
        coordinates: Sequence[str] = (),
        lagrangian: str = "",
        *,
        rotations: Mapping[str, str] | None = None,
        directions: Sequence[str] = (),
        parameters: Mapping[str, float] | None = None,
        forces: Mapping[str, Any] | None = None,
        torques: Mapping[str, Sequence[str]] | None = None,
        torques_space: Mapping[str, Sequence[str]] | None = None,
        point_forces: Sequence[Mapping[str, Any]] = (),
        dissipation: str | None = None,
        damping: str | float | None = None,
        temperature: str | float | None = None,
        noise: Mapping[str, Any] | None = None,
        constraints: Sequence[str] = (),
        inputs: Sequence[str] = (),
        tables: Sequence[str] | Mapping[str, Any] = (),
        neighbours: Mapping[str, Mapping[str, Any]] | None = None,
        functions: Mapping[str, Table | Mapping[str, Any]] | None = None,
        contacts: Sequence[ContactLike | Mapping[str, Any]] = (),
    ) -> LagrangianSystem | Any:
        """Read L from text of the grammar in :mod:`scvi_codegen.systems.formulas.grammar`.

        With arrays the grammar is that of :mod:`scvi_codegen.systems.formulas.arrays`. If all their sizes are numbers,
        their entries are coordinates q_0, q_1, .. like all others. Otherwise the sizes follow from the arrays of a run,
        or from ``sizes`` of :func:`~scvi_codegen.compile_stepper`, and the result is an
        :class:`~scvi_codegen.systems.arrays.system.ArrayLagrangian`.

        Args:
            name: name of the system.
            coordinates: names of the coordinates, and declarations of arrays, ``["x", "q[N]", "r[N, 3]"]``, whose sizes
                are names or whole numbers; the velocity of ``q`` is written ``q_dot``, time ``t``.
            lagrangian: the formula; it may span several lines.
            rotations: name of the angular velocity in the body frame by name of the rotation: ``{"R": "omega"}``
                declares the entries ``R_11`` to ``R_33`` of the matrix from body to space, ``omega_1`` to ``omega_3``,
                ``rotate_k(R, a, b, c)``, component k of R (a, b, c), and ``unrotate_k`` of its inverse
                (:mod:`scvi_codegen.systems.formulas.rotations`). Arrays, ``{"R[8]": "omega"}``, have indices as other
                arrays: ``sum(i in 8, omega_1[i]**2 - R_33[i])``.
            directions: names of unit vectors: ``n`` has components ``n_1`` to ``n_3`` and velocities ``n_1_dot`` ...
            parameters: default value by name, or of all entries by declaration of an array, ``{"k": 1, "m[N]": 1}``.
            forces: formula by coordinate, in coordinates, velocities and time (:mod:`scvi_codegen.systems.forces`).
            torques, torques_space: three formulas by rotation, components in the body frame and in the space frame.
            point_forces: forces at points, which act on coordinates and rotations by virtual work: ``{"point": [..],
                "force": [..]}``, three formulas each in space, or of a point of a body, ``{"body": "R", "point": [0, 0,
                "l"], "origin": ["x", "y", "z"], "force": [..], "frame": "body"}``.
            dissipation: Rayleigh's function D(q, q_dot, t), whose forces -dD/dq_dot are added to them.
            damping: damping rate of all momenta, a number or a formula of parameters
                (:mod:`scvi_codegen.systems.forces`).
            temperature: kT of a heat bath, a formula of parameters, inputs and t, of which damping and dissipation then
                are the friction: noise keeps the system at this temperature (:mod:`scvi_codegen.systems.bath`).
            noise: strength sigma by coordinate, a formula of coordinates and t, of further noise dp = sigma dW.
            constraints: formulas in coordinates and time that are 0, or equations ``"x**2 + y**2 = l**2"``;
                formulas linear in velocities are nonholonomic (:mod:`scvi_codegen.systems.forces`).
            inputs: names of functions of time whose values are passed to each run
                (:mod:`scvi_codegen.systems.formulas.symbols`).
            tables: declarations of index tables with their columns, ``["bonds[B, 2]", "pins[P]"]``.
            neighbours: lists of the pairs of points closer than a cutoff, over which ``sum(i < j in near, ..)`` runs:
                ``{"near": {"of": "r", "cutoff": "c", "box": "L", "skin": 0.3}}``. Lengths are numbers or formulas of
                parameters; ``box`` is one length or one per component, and absent without a periodic boundary;
                ``skin`` is by default an eighth of the cutoff (:mod:`scvi_codegen.systems.formulas.neighbours`).
            functions: tables by name, ``{"F": Table(x, y)}``, which formulas, events and contacts call as ``F(x - 1)``.
            contacts: contacts and dry friction, made by :func:`~scvi_codegen.contact` and
                :func:`~scvi_codegen.friction`, or tables of their arguments.

        >>> oscillator = LagrangianSystem.from_text(
        ...     name="oscillator", coordinates=["x"], lagrangian="m*x_dot**2/2 - k*x**2/2",
        ...     parameters={"m": 1, "k": 2, "c": 0.1}, forces={"x": "cos(t)"}, dissipation="c*x_dot**2/2")
        >>> oscillator.lagrangian, oscillator.forces
        (-k*x**2/2 + m*x_dot**2/2, (-c*x_dot + cos(t),))
        >>> chain = LagrangianSystem.from_text(
        ...     name="chain", coordinates=["q[N]"], parameters={"k": 2},
        ...     lagrangian="sum(i in N, q_dot[i]**2/2) - k*sum(i in N periodic, (q[i+1] - q[i])**2/2)")
        >>> print(chain)
        chain: L(q[N]) = sum(i in N, q_dot[i]**2/2) + sum(i in N periodic, -k*(q[i+1] - q[i])**2/2)
        """
        arguments = {key: value for key, value in locals().items() if key != "cls"}
        return cls._of_text({**arguments, "contacts": tables_of_contacts(contacts), "functions": tables_of(functions)})

    @classmethod
    @checks_arguments(SystemDefinitionError, inputs=FORMULAS, torques=MAPPED, torques_space=MAPPED)
    def from_sympy(
        cls,
        *,
        name: str,
        lagrangian: Expr,
        coordinates: Sequence[Expr | str] = (),
        rotations: Mapping[Any, Any] | None = None,
        directions: Sequence[str] = (),
        velocities: Sequence[Expr] | None = None,
        time: Symbol | None = None,
        parameters: Mapping[Any, float] | None = None,
        forces: Mapping[Expr | str, Any] | None = None,
        torques: Mapping[str, Sequence[Expr]] | None = None,
        torques_space: Mapping[str, Sequence[Expr]] | None = None,
        point_forces: Sequence[Mapping[str, Any]] = (),
        dissipation: Expr | None = None,
        damping: Expr | float | None = None,
        temperature: Expr | float | None = None,
        noise: Mapping[Any, Any] | None = None,
        constraints: Sequence[Expr] = (),
        inputs: Sequence[Any] = (),
        tables: Sequence[str] | Mapping[str, Any] = (),
        neighbours: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> LagrangianSystem | Any:
        """Create the system from a SymPy expression in plain symbols or in functions of time.

        Floating-point numbers become the rationals of their shortest decimal form (``0.1`` is 1/10); symbols become
        canonical as described in :mod:`scvi_codegen.systems.formulas.symbols`.

        Args:
            name, torques, torques_space, point_forces, directions, tables, neighbours: as of :meth:`from_text`; names
                of components are symbols, ``Symbol("R_33")``, ``Symbol("omega_1")``.
            lagrangian: L.
            coordinates: symbols, or functions of time such as ``dynamicsymbols`` returns.
            rotations: as of :meth:`from_text`. A frame ``B.orient_quaternion(N, ..)`` is declared by
                ``{B: N}``: its rotation is called as the frame, and its angular velocity ``omega``, or ``omega_B`` if
                there are several frames.
            velocities: parallel to ``coordinates``; by default ``Derivative(q(t), t)`` for a function of time, the
                symbol called ``q_dot`` for a symbol ``q``.
            time: the symbol for time; by default the argument of the coordinates, or the symbol called ``t``.
            parameters: default value by symbol, by name, or by a function of time that is constant.
            forces: expression by coordinate, which is a symbol, a function of time or a name.
            dissipation, damping, temperature, noise: as of :meth:`from_text`, expressions.
            constraints: expressions in coordinates, time and, linearly, velocities that are 0, or equations ``Eq``.
            inputs: functions of time, symbols or names whose values are passed to each run.

        With arrays, ``coordinates`` and ``parameters`` are as of :meth:`from_text`, and the Lagrangian consists of
        ``Sum`` and ``Indexed``: a periodic index is ``Mod(i + 1, N)``, pairs are ``(j, i + 1, N - 1), (i, 0, N - 2)``,
        a table entry is ``q[bonds[b, 0]]``, the velocity of ``q[i]`` is that of ``IndexedBase("q_dot")``.

        >>> from sympy import IndexedBase, Sum, symbols
        >>> q, v, (i, N) = IndexedBase("q"), IndexedBase("q_dot"), symbols("i N", integer=True)
        >>> kinetic, springs = Sum(v[i] ** 2 / 2, (i, 0, N - 1)), Sum((q[i + 1] - q[i]) ** 2 / 2, (i, 0, N - 2))
        >>> LagrangianSystem.from_sympy(name="chain", coordinates=["q[N]"], lagrangian=kinetic - springs)
        LagrangianSystem(name='chain', coordinates=(q[N]))
        """
        arguments = {key: value for key, value in locals().items() if key not in ("cls", "lagrangian")}
        from scvi_codegen.systems.first_order import system_of
        from scvi_codegen.systems.reading import system_from_sympy

        system: LagrangianSystem = system_from_sympy(partial(system_of, cls), "Lagrangian", lagrangian, **arguments)
        return system

    @classmethod
    @checks_arguments(SystemDefinitionError, method=LAGRANGES_METHOD)
    def from_lagranges_method(
        cls,
        method: LagrangesMethod,
        *,
        name: str = "mechanism",
        parameters: Mapping[Any, float] | None = None,
        inputs: Sequence[Any] = (),
    ) -> LagrangianSystem:
        """Create the system from a ``sympy.physics.mechanics.LagrangesMethod``, with its forces and constraints.

        Forces and torques of its ``forcelist`` are projected on the coordinates by the velocities of their points and
        the angular velocities of their frames: f_i = sum F . dv/dq_dot_i. As in SymPy its ``bodies`` are not used:
        their energies are part of its Lagrangian.
        """
        from sympy import sympify

        holonomic = [sympify(g) for g in method._hol_coneqs]  # private attribute: SymPy has no public one
        rolling = list(method.coneqs)[len(holonomic) :]  # coneqs begins with the rates of the holonomic constraints
        lagrangian = method._L[0]  # private attribute: SymPy has no public one
        return cls.from_sympy(
            name=name,
            lagrangian=lagrangian,
            coordinates=list(method.q),
            parameters=parameters,
            forces=part("readers", "of_lagranges_method")(method),
            constraints=[*holonomic, *rolling],
            inputs=inputs,
        )

    @classmethod
    @checks_arguments(SystemDefinitionError, method=KANES_METHOD)
    def from_kanes_method(
        cls,
        method: KanesMethod,
        *,
        name: str = "mechanism",
        parameters: Mapping[Any, float] | None = None,
        inputs: Sequence[Any] = (),
    ) -> LagrangianSystem:
        """Create the system from a ``sympy.physics.mechanics.KanesMethod``, by its bodies and loads.

        Generalised speeds are expressed by the rates of the coordinates. Loads that depend only on coordinates and have
        a potential become a potential energy; all others are generalised forces, as are the terms of Kane's equations
        beyond Lagrange's if constraints are built into velocities (a rolling disc). Potential energies of bodies are
        not used, as in Kane's equations; accelerations follow from velocities, and those set by hand are ignored.
        Holonomic constraints, and velocity constraints that they do not imply, become constraints. A speed without a
        coordinate, which nothing depends on, gets one, ``integral_u``.

        Args:
            method: with bodies and kinematic equations; its equations need not have been formed.
            name: of the system.
            parameters: default value by symbol, by function of time that is constant, or by name.
            inputs: functions of time, such as ``dynamicsymbols("F")``, whose values are passed to each run.

        Raises:
            SystemDefinitionError: if generalised speeds are not an invertible combination of the rates of the
                coordinates, bodies are missing, or a symbol has no value.
        """
        formulas = part("readers", "of_kanes_method")(method).formulas()
        return cls.from_sympy(name=name, parameters=parameters, inputs=inputs, **formulas)

    @classmethod
    @checks_arguments(SystemDefinitionError, system=BODIES)
    def from_system(
        cls,
        system: System,
        *,
        name: str = "mechanism",
        parameters: Mapping[Any, float] | None = None,
        inputs: Sequence[Any] = (),
    ) -> LagrangianSystem:
        """Create the system from a ``System`` of ``sympy.physics.mechanics``: bodies, joints, loads, constraints.

        Like :meth:`from_kanes_method`, but with the potential energies of its bodies, unless its equations were formed
        by Kane's method, which does not use them.

        A spherical joint becomes a rotation ``R_JOINT`` of the child's frame in the parent's, with the angular velocity
        ``omega_JOINT`` in the child's frame, unless loads, constraints or energies contain its angles. A rigid body
        that is not connected to the inertial frame has the position ``x_BODY``, ``y_BODY``, ``z_BODY`` of its mass
        center, the rotation ``R_BODY`` and the angular velocity ``omega_BODY``.

        Args:
            system: its equations need not have been formed.
            name, parameters, inputs: see :meth:`from_kanes_method`.
        """
        formulas = part("readers", "of_system")(system).formulas()
        return cls.from_sympy(name=name, parameters=parameters, inputs=inputs, **formulas)

    @classmethod
    @checks_arguments(SystemDefinitionError, gravity=NUMBERS, **ROBOT)
    @without_collection
    def from_urdf(
        cls,
        path: str | PathLike[str],
        *,
        floating: bool = False,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
        actuated: Sequence[str] | bool = False,
        limits: Literal["contact", "ignore"] = "ignore",
        friction: Literal["contact", "ignore"] = "ignore",
        restitution: float = 0.0,
        impacts: str = Impacts.SEQUENTIAL,
        check_inertias: bool = True,
        name: str | None = None,
    ) -> LagrangianSystem:
        """Create the system from a URDF file, in joint coordinates: kinetic energy, gravity and damping of joints.

        Revolute, continuous and prismatic joints are coordinates with the name of the joint. A floating base has the
        position ``x_BASE``, ``y_BASE``, ``z_BASE`` of its frame, the rotation ``R_BASE`` and the angular velocity
        ``omega_BASE`` in its frame, where ``BASE`` is the name of its link. Links of fixed joints are merged. Joints
        with ``mimic`` follow theirs. A warning lists what is not part of the motion: limits, dry friction, collisions,
        actuators. Angles ``rpy`` that differ from a multiple of pi/2 by less than 5e-6 are this multiple, since files
        print them with few digits.

        Args:
            path: the file.
            floating: whether the base moves freely; otherwise it is fixed to the world.
            gravity: acceleration of gravity in the world frame, in the units of the file (m/s^2).
            actuated: names of the joints on which an input ``tau_JOINT``, a torque or force, acts; ``True`` for all.
            limits, friction: ``"contact"`` for limits and dry friction of joints that are part of the motion, as
                ``contacts`` of the system, with the restrictions of these (:func:`~scvi_codegen.contact`);
                ``"ignore"``: the warning lists them.
            restitution: coefficient of impacts at limits, 0 to 1.
            impacts: law of those at the same time, ``"sequential"`` or ``"simultaneous"``, see
                :func:`~scvi_codegen.contact`.
            check_inertias: whether moments of inertia that no body has are an error; otherwise they are integrated as
                they are written, with a warning.
            name: name of the system; by default that of the robot.

        Raises:
            SystemDefinitionError: naming file and element, if something is malformed, unknown or not read.
        """
        read: LagrangianSystem = part("readers", "of_urdf")(
            cls,
            path,
            parts={"limits": limits, "friction": friction},
            law=(restitution, impacts),
            floating=floating,
            gravity=gravity,
            actuated=actuated,
            check_inertias=check_inertias,
            name=name,
        )
        return read

    @classmethod
    @checks_arguments(SystemDefinitionError, contacts=PLANES, **ROBOT)
    @without_collection
    def from_mjcf(
        cls,
        path: str | PathLike[str],
        *,
        actuated: Sequence[str] | bool = False,
        limits: Literal["contact", "ignore"] = "ignore",
        friction: Literal["contact", "ignore"] = "ignore",
        contacts: Literal["planes", "ignore"] = "ignore",
        restitution: float = 0.0,
        impacts: str = Impacts.SEQUENTIAL,
        actuators: bool = False,
        check_inertias: bool = True,
        folders: Iterable[str | PathLike[str]] = (),
        name: str | None = None,
    ) -> LagrangianSystem:
        """Create the system from an MJCF file of MuJoCo: kinetic energy, gravity, springs and damping of joints.

        Hinges and slides are coordinates with the name of the joint. A ball joint is a rotation ``R_JOINT`` relative to
        the parent with the angular velocity ``omega_JOINT`` in the frame of the body; a free joint has the position
        ``x_JOINT``, ``y_JOINT``, ``z_JOINT`` as well. A joint without a name has that of its body. Inertias of bodies
        follow from their ``inertial`` or geoms. Equalities of bodies, sites and joints are constraints. A warning lists
        what is not part of the motion: limits, dry friction, contacts, actuators.

        Args:
            path, actuated, limits, friction, impacts, check_inertias: see :meth:`from_urdf`; limits are rigid.
            contacts: ``"planes"`` for contacts of spheres, capsules and boxes with planes, rigid and with sliding
                friction; the warning has the number of other pairs of geoms that may touch. ``"ignore"``: none.
            restitution: coefficient of impacts of limits and geoms, 0 to 1.
            actuators: whether motors and servos act; their controls are inputs of their names, or ``ctrl_NAME``.
            folders: those with files that the file may name (meshes, includes, models), besides its own.
            name: name of the system; by default that of the model.

        Raises:
            SystemDefinitionError: naming file and element, if something is malformed or unknown, or changes the motion
                and is not read: equalities of flexible bodies, tendons around geoms; or if it names a file that
                is neither in its folder nor in ``folders``.
        """
        with naming_folders(folders):
            read: LagrangianSystem = part("readers", "of_mjcf")(
                cls,
                path,
                parts={"limits": limits, "friction": friction, "contacts": contacts},
                law=(restitution, impacts),
                actuators=actuators,
                actuated=actuated,
                check_inertias=check_inertias,
                name=name,
            )
        return read

    @classmethod
    def _read(cls, arguments: Mapping[str, Any]) -> tuple[Any, bool]:
        from scvi_codegen.systems.first_order import system_of
        from scvi_codegen.systems.reading import system_from_text

        system, warned = system_from_text(partial(system_of, cls), arguments)
        return system, warned or type(system) is not cls

    def _repr_latex_(self) -> str:
        from sympy import latex

        dotted = {
            velocity: rf"\dot{{{latex(coordinate)}}}"
            for coordinate, velocity in zip(self.coordinates, self.velocities, strict=True)
        }
        return rf"$\displaystyle L = {latex(self._shown_formula, symbol_names=dotted)}$"
