"""Collocation and Runge-Kutta methods, (10)-(23), in phase space (q, p) and in position-velocity form (q, v).

Spectral collocation at the nodes x_1 .. x_s is the collocation Runge-Kutta method (22)-(23) on the abscissae
c_i = (x_i + 1)/2, so the compiled form of all of them is a tableau (A, b, c). On Hamilton's equations, with stage
velocities V_i as unknowns,

    q_i = q0 + h sum_j a_ij V_j,     L_v(q_i, V_i) = p0 + h sum_j a_ij L_q(q_j, V_j),                   (22), (21)

and on (q, v), with v0 and z_i = h (acceleration at c_i) as unknowns,

    V_i = v0 + sum_j a_ij z_j,       q_i = q0 + h sum_j a_ij V_j,       E(q_i, V_i, z_i / h, t_i) = 0,    (18)

E the Euler-Lagrange residual. When the mass is not constant these are two different maps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from scvi_codegen.display.number_tables import Part
from scvi_codegen.errors import MethodError
from scvi_codegen.mechanics.forms import accelerations, forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.galerkin import (
    galerkin_system,
    position_block,
    resolve_nodes,
)
from scvi_codegen.methods.method import Method, Specification, check_count, lagrangian_scatters
from scvi_codegen.methods.stage_system import Block, Gather, PointFamily, Row, Scatter, StageSystem, Table
from scvi_codegen.tables import tableau as tableaux
from scvi_codegen.tables.basis import differentiation_matrix, identity_matrix, matrix_product, next_step
from scvi_codegen.tables.nodes import Nodes
from scvi_codegen.tables.precision import Matrix, Number, Vector, mp
from scvi_codegen.tables.tableau import Tableau

__all__ = [
    "ChebyshevGauss",
    "ChebyshevLobatto",
    "CollocationRK",
    "ExplicitEuler",
    "Gauss",
    "LobattoIIIA",
    "RadauIA",
    "RadauIIA",
    "RungeKutta",
    "SpectralCollocation",
    "acceleration_gathers",
    "acceleration_unknowns",
    "residual_family",
]

FORMS = ("phase-space", "position")
VELOCITY_BLOCK = Block(name="v_0", power=1, straight=(mp.zero, mp.one))


@dataclass(frozen=True, slots=True)
class RungeKutta(Method):
    """A Runge-Kutta method on Hamilton's equations (``form="phase-space"``) or on (q, v) (``form="position"``).

    Args:
        tableau: (A, b, c); its order, symmetry and symplecticity are computed from the coefficients (paper, Table 4).
        form: ``"phase-space"`` or ``"position"``; symplectic tableaux are symplectic in phase space only (and for
            constant mass).
    """

    tableau: Tableau
    form: str = "phase-space"

    def __post_init__(self) -> None:
        _check_form(self.form)

    @property
    def name(self) -> str:
        """``<tableau>`` or ``<tableau>-position``."""
        base = self.tableau.name.replace(":", "-")
        return base if self.form == "phase-space" else f"{base}-position"

    @property
    def title(self) -> str:
        """One line for people."""
        stages = len(self.tableau.b)
        return f"Runge-Kutta {self.tableau.name}, {stages} stage{'s' * (stages > 1)}, {self.form} form"

    @property
    def order(self) -> int | None:
        """From the simplifying conditions of the tableau."""
        return self.tableau.order

    @property
    def symmetric(self) -> bool:
        """From the tableau."""
        return self.tableau.is_symmetric

    @property
    def symplectic(self) -> bool:
        """From the tableau; never promised in position form, where p is not an unknown."""
        return self.form == "phase-space" and self.tableau.is_symplectic

    @property
    def needs_regular(self) -> bool:
        """In position form."""
        return self.form == "position"

    @property
    def parts(self) -> tuple[Part, ...]:
        """The tableau."""
        return (self.tableau,)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        family, _, stages = self.tableau.name.partition(":")
        if family in TABLEAU_METHODS:
            return {"method": family, "stages": int(stages), "form": self.form}
        if family == "explicit-euler":
            return {"method": family, "form": self.form}
        return {"method": "collocation", "abscissae": [float(c) for c in self.tableau.c], "form": self.form}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Symplectic tableaux by their generating function (exactly symplectic when rounded), others as they are."""
        tableau = self.tableau
        if self.form == "position":
            return position_system(system, tableau)
        if not self.symplectic:
            return phase_space_system(system, tableau)
        size = len(tableau.b)
        return galerkin_system(
            system,
            abscissae=tableau.c,
            weights=tableau.b,
            position=tableau.A,
            velocity=identity_matrix(size),
            end_position=tableau.b,
            extrapolation=next_step(tableau.c),
        )

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """The stage equations (22)-(23)."""
        return (position_system if self.form == "position" else phase_space_system)(system, self.tableau)


@dataclass(frozen=True, slots=True)
class SpectralCollocation(Method):
    """Spectral collocation (SC): (18) in position form, (21) in phase space. Neither symplectic nor reversible.

    Args:
        degree: degree s of the collocation polynomial; the nodes 1 .. s carry equations, node 0 does not.
        nodes: of that degree, containing both ends; default Chebyshev-Lobatto.
        form: ``"position"`` collocates the Euler-Lagrange equations, ``"phase-space"`` Hamilton's equations.
    """

    degree: int
    nodes: Nodes | str | None = None
    form: str = "position"

    def __post_init__(self) -> None:
        check_count(self.degree, "the degree of spectral collocation")
        _check_form(self.form)
        object.__setattr__(self, "nodes", resolve_nodes(self.nodes, self.degree))

    @property
    def node_set(self) -> Nodes:
        """The nodes, resolved."""
        assert isinstance(self.nodes, Nodes)
        return self.nodes

    @property
    def tableau(self) -> Tableau:
        """The equivalent collocation Runge-Kutta tableau (23), on the nodes 1 .. s."""
        return tableaux.collocation_tableau(self.node_set.abscissae[1:])

    @property
    def name(self) -> str:
        """``sc-<degree>-<nodes>[-phase-space]``."""
        return f"sc-{self.degree}-{self.node_set.name}" + ("-phase-space" if self.form == "phase-space" else "")

    @property
    def title(self) -> str:
        """One line for people."""
        return f"Spectral collocation, degree {self.degree}, {self.node_set.name} nodes, {self.form} form"

    @property
    def order(self) -> int | None:
        """From the equivalent tableau."""
        return self.tableau.order

    @property
    def symmetric(self) -> bool:
        """From the equivalent tableau."""
        return self.tableau.is_symmetric

    @property
    def symplectic(self) -> bool:
        """From the equivalent tableau, in phase space."""
        return self.form == "phase-space" and self.tableau.is_symplectic

    @property
    def needs_regular(self) -> bool:
        """In position form."""
        return self.form == "position"

    @property
    def parts(self) -> tuple[Part, ...]:
        """The nodes; in phase space also the tableau, in which it is written."""
        return (self.node_set,) if self.form == "position" else (self.node_set, self.tableau)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        return {"method": "sc", "degree": self.degree, "nodes": self.node_set.name, "form": self.form}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """The equivalent Runge-Kutta stage equations."""
        return (position_system if self.form == "position" else phase_space_system)(system, self.tableau)

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """(18) with unknowns Q^1 .. Q^s and v0, or (21) with the stage velocities V_i as unknowns for H_p."""
        if self.form == "position":
            return nodal_collocation(system, self.node_set)
        return phase_space_system(system, self.tableau)


def phase_space_system(system: MechanicalSystem, tableau: Tableau) -> StageSystem:
    """(22) on Hamilton's equations, momenta eliminated by p_i = L_v(q_i, V_i)."""
    size = len(tableau.b)
    family = PointFamily(
        name="stage",
        abscissae=tableau.c,
        weights=(mp.one,) * size,
        weight_names=("",) * size,
        gathers=(
            Gather(
                arguments=system.coordinates,
                table=Table.joined(Table.constant(size, 1, 1), Table.named("a", tableau.A)),
                power=0,
            ),
            Gather(
                arguments=system.velocities,
                table=Table.joined(Table.constant(size, 1), Table.identity(size)),
                power=-1,
            ),
        ),
        scatters=(),
    )
    b_column = Table(entries=tuple((x,) for x in tableau.b), names=tuple((f"b_{n + 1}",) for n in range(size)))
    return StageSystem(
        blocks=tuple(Block(name=f"V_{i}", power=1, straight=(mp.zero, mp.one)) for i in range(1, size + 1)),
        rows=tuple(Row(number="22", kind="stage", momentum=mp.one) for _ in range(size)),
        families=(
            lagrangian_scatters(
                family,
                system,
                Scatter(results=(), table=Table.joined(_transposed(tableau), b_column), power=1),
                Scatter(results=(), table=Table.joined(Table.identity(size, -1), Table.constant(size, 1)), power=0),
            ),
        ),
        end_position=Table.joined(Table.constant(1, 1, 1), _transposed_row(b_column)),
        end_momentum=mp.one,
        end_numbers=("22", "22"),
        extrapolation=next_step(tableau.c),
    )


def position_system(system: MechanicalSystem, tableau: Tableau) -> StageSystem:
    """(22) on (q, v): unknowns v0 and z_i = h a_i; v0 from p0 by the Legendre transform, p1 from v1."""
    b, size = tableau.b, len(tableau.b)
    momenta = forms_of(system).momentum
    ones, none = Table.constant(1, 1, 1), Table.constant(1, size)
    b_row = Table(entries=(b,), names=(tuple(f"b_{i}" for i in range(1, size + 1)),))
    end_row = Table.joined(ones, ones, Table.named("bA", matrix_product((b,), tableau.A)))
    start = _single_point(system, "start", mp.zero, Table.joined(ones, Table.constant(1, 1), none))
    end = _single_point(system, "end", mp.one, end_row)
    end_velocity = Gather(arguments=system.velocities, table=Table.joined(Table.constant(1, 1), ones, b_row), power=-1)
    end = replace(end, gathers=(end.gathers[0], end_velocity))
    minus = Table.constant(1, 1, -1)
    start_table = Table.joined(minus, none, minus)
    end_table = Table.joined(Table.constant(1, 1), none, ones)
    inner = Table.joined(Table.constant(size, 1), Table.identity(size), Table.constant(size, 1))
    collocation = residual_family(
        system, tableau.c, acceleration_gathers(system, tableau.A), Scatter(results=(), table=inner, power=1)
    )
    return StageSystem(
        blocks=acceleration_unknowns(size),
        rows=(
            Row(number="p0", kind="Legendre", momentum=mp.one),
            *(Row(number="18", kind="stage", momentum=mp.zero) for _ in range(size)),
        ),
        families=(
            _with_scatter(start, Scatter(results=momenta, table=start_table, power=0)),
            collocation,
            _with_scatter(end, Scatter(results=momenta, table=end_table, power=0)),
        ),
        end_position=end_row,
        end_momentum=mp.one,
        end_numbers=("22", "p1"),
        extrapolation=acceleration_extrapolation(tableau),
    )


def residual_family(
    system: MechanicalSystem,
    abscissae: Vector,
    gathers: tuple[Gather, ...],
    residual: Scatter,
    *others: Scatter,
) -> PointFamily:
    """Collocation nodes of weight 1 with the Euler-Lagrange residual as kernel, scattered as ``residual`` says."""
    return PointFamily(
        name="node",
        abscissae=abscissae,
        weights=(mp.one,) * len(abscissae),
        weight_names=("",) * len(abscissae),
        gathers=gathers,
        scatters=(replace(residual, results=forms_of(system).euler_lagrange), *others),
    )


def acceleration_unknowns(size: int) -> tuple[Block, ...]:
    """The blocks v0, z_1 .. z_s of a curve given by its initial velocity and scaled accelerations."""
    return (
        VELOCITY_BLOCK,
        *(Block(name=f"z_{i}", power=1, straight=(mp.zero, mp.zero)) for i in range(1, size + 1)),
    )


def acceleration_gathers(
    system: MechanicalSystem, A: Matrix, *, other_blocks: int = 0
) -> tuple[Gather, Gather, Gather]:
    """Position, velocity and acceleration at the stages from (q0, v0, z_1 .. z_s).

    V_i = v0 + sum_j a_ij z_j and q_i = q0 + h sum_j a_ij V_j; the coefficient of v0 is the row sum of A, which is c_i
    for collocation but not for every tableau.
    """
    size = len(A)
    ones, zeros, padding = Table.constant(size, 1, 1), Table.constant(size, 1), Table.constant(size, other_blocks)
    sums = Table.named("c", [(mp.fsum(line),) for line in A])
    drift = Table(entries=sums.entries, names=tuple((name.rpartition("_")[0],) for (name,) in sums.names))
    double = Table.named("aa", matrix_product(A, A))
    return (
        Gather(arguments=system.coordinates, table=Table.joined(ones, drift, double, padding), power=0),
        Gather(arguments=system.velocities, table=Table.joined(zeros, ones, Table.named("a", A), padding), power=-1),
        Gather(
            arguments=accelerations(system),
            table=Table.joined(zeros, zeros, Table.identity(size), padding),
            power=-2,
        ),
    )


def acceleration_extrapolation(tableau: Tableau) -> Matrix:
    """The guess for the next step: v0 <- v1 = v0 + sum b_i z_i, accelerations extrapolated."""
    inner = next_step(tableau.c)
    size = len(tableau.b)
    return ((mp.one, *tableau.b), *((mp.zero, *inner[i]) for i in range(size)))


def nodal_collocation(system: MechanicalSystem, nodes: Nodes) -> StageSystem:
    """(18) as printed: unknowns Q^1 .. Q^s and v0; v0 from p0, p1 from v1 = V_s by the Legendre transform."""
    size = nodes.degree
    momenta = forms_of(system).momentum
    none, last = Table.constant(size, size + 1), Table.named("", [[int(n == size - 1)] for n in range(size)])
    family = residual_family(
        system,
        nodes.abscissae[1:],
        nodal_gathers(system, nodes),
        Scatter(results=(), table=Table.joined(Table.identity(size), Table.constant(size, 2)), power=0),
        Scatter(results=momenta, table=Table.joined(none, last), power=0),
    )
    start = _single_point(
        system,
        "start",
        mp.zero,
        Table.joined(Table.constant(1, 1, 1), Table.constant(1, size + 1)),
        velocity_block=size,
    )
    start_table = Table.joined(Table.constant(1, size), Table.constant(1, 1, -1), Table.constant(1, 1))
    return StageSystem(
        blocks=nodal_blocks(nodes),
        rows=(
            *(Row(number="18", kind="stage", momentum=mp.zero) for _ in range(size)),
            Row(number="p0", kind="Legendre", momentum=mp.one),
        ),
        families=(family, _with_scatter(start, Scatter(results=momenta, table=start_table, power=0))),
        end_position=Table.joined(Table.constant(1, size), Table.constant(1, 1, 1), Table.constant(1, 1)),
        end_momentum=mp.zero,
        end_numbers=("15", "p1"),
    )


def nodal_blocks(nodes: Nodes) -> tuple[Block, ...]:
    """Q^1 .. Q^s and v0."""
    return (*(position_block(v, nodes) for v in range(1, nodes.degree + 1)), VELOCITY_BLOCK)


def nodal_gathers(system: MechanicalSystem, nodes: Nodes, *, other_blocks: int = 0) -> tuple[Gather, Gather, Gather]:
    """Q^i, V_i = (A Q + a0 q0)_i (15) and (A V + a0 v0)_i (16) at nodes 1 .. s, from (q0; Q^1 .. Q^s, v0)."""
    size = nodes.degree
    full = differentiation_matrix(nodes.points)[1:]
    first = tuple((line[0],) for line in full)
    inner = tuple(line[1:] for line in full)
    zeros = Table.constant(size, 1)
    padding = Table.constant(size, other_blocks)
    slope = Table.named("D", full, column=0)
    acceleration = Table.joined(
        Table.named("DD", matrix_product(inner, first), column=0),
        Table.named("DD", matrix_product(inner, inner)),
        Table(
            entries=tuple((x / 2,) for (x,) in first),
            names=tuple((f"D_{n}_0/2",) for n in range(1, size + 1)),
        ),
    )
    return (
        Gather(
            arguments=system.coordinates,
            table=Table.joined(zeros, Table.identity(size), zeros, padding),
            power=0,
        ),
        Gather(
            arguments=system.velocities,
            table=Table.joined(slope, zeros, padding),
            power=-1,
            scale=Fraction(2),
        ),
        Gather(
            arguments=accelerations(system),
            table=Table.joined(acceleration, padding),
            power=-2,
            scale=Fraction(4),
        ),
    )


def _single_point(
    system: MechanicalSystem, name: str, abscissa: Number, position: Table, *, velocity_block: int = 0
) -> PointFamily:
    """One point whose velocity is the block ``velocity_block`` alone; scatters are added by the caller."""
    columns = len(position.entries[0])
    velocity = Table.named("", [[int(b == velocity_block + 1) for b in range(columns)]])
    return PointFamily(
        name=name,
        abscissae=(abscissa,),
        weights=(mp.one,),
        weight_names=("",),
        gathers=(
            Gather(arguments=system.coordinates, table=position, power=0),
            Gather(arguments=system.velocities, table=velocity, power=-1),
        ),
        scatters=(),
    )


def _with_scatter(family: PointFamily, scatter: Scatter) -> PointFamily:
    return replace(family, scatters=(scatter,))


def _transposed(tableau: Tableau) -> Table:
    size = len(tableau.b)
    table = Table.named("a", tableau.A)
    return Table(
        entries=tuple(tuple(table.entries[i][j] for i in range(size)) for j in range(size)),
        names=tuple(tuple(table.names[i][j] for i in range(size)) for j in range(size)),
    )


def _transposed_row(column: Table) -> Table:
    return Table(entries=(tuple(x for (x,) in column.entries),), names=(tuple(name for (name,) in column.names),))


def _check_form(form: str) -> None:
    if form not in FORMS:
        raise MethodError(f"form must be 'phase-space' or 'position', not {form!r}")


def CollocationRK(abscissae: Sequence[float], *, form: str = "phase-space") -> RungeKutta:
    """Collocation Runge-Kutta method (22)-(23) on any distinct abscissae c_1 < .. < c_s, usually in [0, 1]."""
    return RungeKutta(tableaux.collocation_tableau(tuple(abscissae)), form)


def Gauss(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Gauss collocation: order 2 stages, symplectic, symmetric, A-stable (paper, Tables 1-3)."""
    return RungeKutta(tableaux.gauss(stages), form)


def RadauIIA(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Radau IIA collocation: order 2 stages - 1, A-stable, stiffly accurate."""
    return RungeKutta(tableaux.radau_iia(stages), form)


def RadauIA(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Radau IA: order 2 stages - 1, A-stable; not a collocation method."""
    return RungeKutta(tableaux.radau_ia(stages), form)


def LobattoIIIA(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Lobatto IIIA collocation: order 2 stages - 2, symmetric, A-stable."""
    return RungeKutta(tableaux.lobatto_iiia(stages), form)


def ChebyshevGauss(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Collocation at the Chebyshev points of the first kind: order s (even s) or s + 1 (odd s), symmetric."""
    return RungeKutta(tableaux.chebyshev_gauss(stages), form)


def ChebyshevLobatto(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Collocation at the Chebyshev-Lobatto points, both ends stages: order s (even s) or s + 1 (odd s), symmetric."""
    return RungeKutta(tableaux.chebyshev_lobatto(stages), form)


def ExplicitEuler(*, form: str = "phase-space") -> RungeKutta:
    """Explicit Euler: order 1, neither symplectic nor symmetric; a baseline."""
    return RungeKutta(tableaux.explicit_euler(), form)


TABLEAU_METHODS: dict[str, Callable[..., RungeKutta]] = {
    "gauss": Gauss,
    "radau-iia": RadauIIA,
    "radau-ia": RadauIA,
    "lobatto-iiia": LobattoIIIA,
    "chebyshev-gauss": ChebyshevGauss,
    "chebyshev-lobatto": ChebyshevLobatto,
}
"""Runge-Kutta families by the name of their tableau; each takes ``stages`` and ``form``."""
