"""The seams: what the developers' page adds in a file and a line works, and blocks may be of any size."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import sympy
from samples import QUICK_FLAGS
from scipy.integrate import solve_ivp

import scvi_codegen
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import MethodError
from scvi_codegen.exact.step import DerivedStep
from scvi_codegen.lowering.stage_groups import layout_of
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.galerkin_stages import nodal_quadrature_group, position_block
from scvi_codegen.methods.method import Method, Specification
from scvi_codegen.methods.stage_system import Block, Gather, Row, Scatter, StageGroup, StageSystem, Table
from scvi_codegen.tables.nodes import Nodes, nodes_by_name
from scvi_codegen.tables.precision import mp
from scvi_codegen.tables.quadrature import gauss_lobatto

ROOT = Path(scvi_codegen.__file__).parents[1]
PAGE = ROOT / "docs" / "extending.md"


# What the page adds.


def additions() -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Return the code of the page by the file named above it: new files, and changes of files."""
    new, changes = (
        re.findall(rf"^`([\w/.]+)`\n\n```{kind}\n(.*?)^```$", PAGE.read_text(), re.M | re.S)
        for kind in ("python", "diff")
    )
    return new, changes


def changed(text: str, change: str) -> str:
    """The text with the one place that a diff names changed."""
    lines = [(line[:1], line[1:]) for line in change.splitlines()]
    old, new = ("".join(f"{line}\n" for sign, line in lines if sign in saved) for saved in (" -", " +"))
    assert text.count(old) == 1, f"the page changes what is not there, or not once:\n{change}"
    return text.replace(old, new)


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package with all that the page adds."""
    folder = tmp_path_factory.mktemp("extended")
    for name in ("scvi_codegen", "templates"):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    new, changes = additions()
    for path, text in new:
        (folder / path).write_text(text)
    for path, change in changes:
        (folder / path).write_text(changed((folder / path).read_text(), change))
    return folder


def run(folder: Path, script: str) -> str:
    """Return the output of a script that uses the modified copy."""
    own = f"import sys\nsys.meta_path[:] = [f for f in sys.meta_path if 'editable' not in repr(f).lower()]\n{script}"
    own = own.replace("import sys\n", f"import sys\nsys.path.insert(0, {str(folder)!r})\n", 1)
    found = subprocess.run([sys.executable, "-c", own], capture_output=True, text=True, check=False, cwd=folder)
    assert found.returncode == 0, found.stderr
    return found.stdout


def test_documented_method_and_solver_need_one_file_and_one_line() -> None:
    new, changes = additions()
    lines = [line for _, change in changes for line in change.splitlines() if line[:1] in "+-"]
    assert len(new) == 2
    assert not any((ROOT / path).exists() for path, _ in new)
    assert all(line.startswith("+") for line in lines)
    assert sum("import" not in line for line in lines) == 2


def test_documented_method_is_the_midpoint_rule(extended: Path) -> None:
    script = """
import scvi_codegen, numpy as np
from scvi_codegen.methods import Gauss, method_from_specification
from scvi_codegen.models.problems import problem
from scvi_codegen.pipeline import program_of
assert scvi_codegen.__file__.startswith(sys.path[0])
system, method = problem("kepler").system, method_from_specification({"method": "midpoint"})
own, gauss = (program_of(system, each, prefix="p") for each in (method, Gauss(1)))
same = own.equations.stage_groups == gauss.equations.stage_groups, own.fixed_point == gauss.fixed_point
print(*same, *(each.exact for each in own.quantities.momentum_maps))
"""
    assert run(extended, script).split() == ["True", "True", "True"]


def test_documented_solver_agrees_with_newton(extended: Path) -> None:
    script = """
import numpy as np
from scvi_codegen import SCVI, compile_stepper
from scvi_codegen.pipeline import program_of
from scvi_codegen.models.problems import problem
given = problem("kepler")
method = SCVI(4, abscissae="gauss")
print(*(program_of(given.system, each).fixed_point.name for each in (method, SCVI(4))))
ends = []
for solver in ("fixed-point", "newton"):
    run = compile_stepper(given.system, method, solver=solver).integrate([1.0, 0.0], [0.0, 1.1], h=0.1, steps=50)
    ends.append(np.array([*run.q[-1], *run.p[-1]]))
print(abs(ends[0] - ends[1]).max() < 1e-13)
"""
    assert run(extended, script).split() == ["separable", "shooting", "True"]


# Blocks of another size than the coordinates: multipliers of constraints.


@dataclass(frozen=True, slots=True)
class Constrained(Method):
    """SVI with s + 1 Lobatto points and multipliers of g(q) = 0 at the first s of them; RATTLE's positions for s = 1.

    Unknowns Q^1 .. Q^s and lambda_0 .. lambda_(s-1), k components each; Jay, SIAM J. Numer. Anal. 33 (1996).
    """

    degree: int
    constraints: tuple[sympy.Expr, ...]

    name = title = "constrained"
    symmetric = symplectic = True

    @property
    def order(self) -> int:
        return 2 * self.degree

    def specification(self) -> Specification:
        return {"method": "constrained"}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        s, k = self.degree, len(self.constraints)
        nodes = nodes_by_name("legendre-lobatto", s)
        none, stationary = Table.constant(s + 1, s), [0, *range(1, s)]
        action = nodal_quadrature_group(system, nodes, gauss_lobatto(s + 1), other_blocks=s)
        rows = [
            Table.joined(gather.table.columns(stationary), none, gather.table.columns([s])) for gather in action.gathers
        ]
        return StageSystem(
            blocks=(
                *(position_block(v, nodes) for v in range(1, s + 1)),
                *(
                    Block(name=f"lambda_{n}", power=0, straight=(mp.zero, mp.zero), moves=False, size=k)
                    for n in range(s)
                ),
            ),
            rows=(
                Row(number="27a", kind="IDEL", momentum=mp.one),
                *(Row(number="27b", kind="stage", momentum=mp.zero) for _ in range(s - 1)),
                *(Row(number="g", kind="stage", momentum=mp.zero, size=k) for _ in range(s)),
            ),
            stage_groups=(action.to_stage_group(rows), self._reactions(system, nodes), self._surface(system, nodes)),
            end_position=Table.named("", [[0] * s + [1] + [0] * s]),
            end_momentum=mp.zero,
            end_numbers=("27", "27c"),
        )

    paper_form = stage_system

    def _reactions(self, system: MechanicalSystem, nodes: Nodes) -> StageGroup:
        """(lambda . g)_q at the nodes 0 .. s - 1, in the rows of their positions."""
        s, rule = self.degree, gauss_lobatto(self.degree + 1)
        product, multipliers = self._product()
        here = Table.joined(Table.identity(s), Table.constant(s, 1 + s))
        return StageGroup(
            name="reaction",
            abscissae=nodes.abscissae[:s],
            weights=rule.unit_weights[:s],
            weight_names=("",) * s,
            gathers=(
                Gather(arguments=system.coordinates, table=here, power=0),
                Gather(arguments=multipliers, table=Table.joined(Table.constant(s, 1 + s), Table.identity(s)), power=0),
            ),
            scatters=(Scatter(results=tuple(product.diff(q) for q in system.coordinates), table=here, power=1),),
        )

    def _product(self) -> tuple[sympy.Expr, tuple[sympy.Symbol, ...]]:
        """Multipliers times constraints, and the multipliers."""
        multipliers = sympy.symbols(f"lambda_:{len(self.constraints)}", real=True)
        return sympy.Add(*(x * g for x, g in zip(multipliers, self.constraints, strict=True))), multipliers

    def _surface(self, system: MechanicalSystem, nodes: Nodes) -> StageGroup:
        """g at the nodes 1 .. s, which must vanish."""
        s = self.degree
        places = Table.joined(Table.constant(s, 1), Table.identity(s), Table.constant(s, s))
        rows = Table.joined(Table.constant(s, s), Table.identity(s), Table.constant(s, 1))
        return StageGroup(
            name="surface",
            abscissae=nodes.abscissae[1:],
            weights=(mp.one,) * s,
            weight_names=("",) * s,
            gathers=(Gather(arguments=system.coordinates, table=places, power=0),),
            scatters=(Scatter(results=self.constraints, table=rows, power=0),),
        )


def rod() -> tuple[LagrangianSystem, sympy.Expr]:
    """A mass on a rod, in Cartesian coordinates: a pendulum."""
    system = LagrangianSystem.from_text(
        name="mass on a rod", coordinates=["x", "y"], lagrangian="(x_dot**2 + y_dot**2)/2 - y"
    )
    x, y = system.coordinates
    return system, (x**2 + y**2 - 1) / 2


def pendulum(angle: float, rate: float, time: float) -> np.ndarray:
    """The position of the mass by the pendulum's own equation."""
    found = solve_ivp(lambda t, u: [u[1], -np.sin(u[0])], (0, time), [angle, rate], rtol=1e-13, atol=1e-14)
    return np.array([np.sin(found.y[0, -1]), -np.cos(found.y[0, -1])])


@pytest.mark.parametrize("degree", [1, 2])
def test_constraint_multipliers_are_separate_blocks(degree: int) -> None:
    system, surface = rod()
    step = DerivedStep(system, Constrained(degree, (surface,)).stage_system(system))
    assert step.unknowns == degree * (2 + 1)
    errors = []
    for steps in (4, 8):
        q, p = [np.sin(0.7), -np.cos(0.7)], [0.4 * np.cos(0.7), 0.4 * np.sin(0.7)]
        for _ in range(steps):
            end = step(q, p, 1 / mp.mpf(steps))
            q, p = end.q, end.p
            assert abs(q[0] ** 2 + q[1] ** 2 - 1) < 1e-15
        errors.append(np.abs(np.array(q, dtype=float) - pendulum(0.7, 0.4, 1.0)).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2 * degree, abs=0.4)


def test_without_constraints_the_method_is_the_svi() -> None:
    system, _ = rod()
    free = DerivedStep(system, Constrained(2, ()).stage_system(system))
    own = DerivedStep(system, SVI(2, "gauss-lobatto:3").paper_form(system))
    state = ([0.3, -0.9], [0.4, 0.1], 0.25)
    assert max(abs(a - b) for a, b in zip(free(*state).q, own(*state).q, strict=True)) < 1e-40


@dataclass(frozen=True, slots=True)
class ConstrainedIncrements(Constrained):
    """Equations with velocities as unknowns, as in compiled code."""

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        s, k = self.degree, len(self.constraints)
        own = SVI(s, f"gauss-lobatto:{s + 1}").stage_system(system)
        (action,) = own.stage_groups
        place, none = action.gathers[0].table, Table.constant(s + 1, s)
        rows = [_widened(scatter.table, none) for scatter in action.scatters]
        product, multipliers = self._product()
        first, last = range(s), range(1, s + 1)
        reaction = StageGroup(
            name="reaction",
            computes="(lambda . g)_q",
            abscissae=action.abscissae[:s],
            weights=action.weights[:s],
            weight_names=action.weight_names[:s],
            gathers=(
                Gather(arguments=system.coordinates, table=_lines(Table.joined(place, none), first), power=0),
                Gather(
                    arguments=multipliers, table=Table.joined(Table.constant(s, 1 + s), Table.identity(s)), power=-1
                ),
            ),
            scatters=(
                Scatter(
                    results=tuple(product.diff(q) for q in system.coordinates), table=_lines(rows[0], first), power=1
                ),
            ),
        )
        surface = StageGroup(
            name="surface",
            computes="g",
            abscissae=action.abscissae[1:],
            weights=(mp.one,) * s,
            weight_names=("",) * s,
            gathers=(Gather(arguments=system.coordinates, table=_lines(Table.joined(place, none), last), power=0),),
            scatters=(
                Scatter(
                    results=self.constraints,
                    table=Table.joined(Table.constant(s, s), Table.identity(s), Table.constant(s, 1)),
                    power=-1,
                ),
            ),
        )
        free = replace(
            action,
            in_action=False,
            gathers=tuple(replace(each, table=Table.joined(each.table, none)) for each in action.gathers),
            scatters=tuple(replace(each, table=table) for each, table in zip(action.scatters, rows, strict=True)),
        )
        still, zero = (mp.zero, mp.zero), (mp.zero,) * s
        return replace(
            own,
            blocks=(
                *own.blocks,
                *(Block(name=f"m_{n}", power=1, straight=still, moves=False, size=k) for n in range(s)),
            ),
            rows=(*own.rows, *(Row(number="g", kind="stage", momentum=mp.zero, size=k) for _ in range(s))),
            stage_groups=(free, reaction, surface),
            end_position=Table.joined(own.end_position, Table.constant(1, s)),
            extrapolation=(*((*line, *zero) for line in own.extrapolation or ()), *((*zero, *zero) for _ in zero)),
            shape=None,
        )

    paper_form = stage_system


def _lines(table: Table, numbers: range) -> Table:
    """Some rows of a table."""
    part = slice(numbers.start, numbers.stop)
    return Table(entries=table.entries[part], names=table.names[part])


def _widened(table: Table, columns: Table) -> Table:
    """A scatter table with columns before the last one, that of p1."""
    last = len(table.entries[0]) - 1
    return Table.joined(table.columns(range(last)), columns, table.columns([last]))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_other_block_sizes_are_compiled(degree: int) -> None:
    system, surface = rod()
    method = ConstrainedIncrements(degree, (surface,))
    stepper = compile_stepper(system, method, solver="newton", flags=QUICK_FLAGS)
    start = [np.sin(0.7), -np.cos(0.7)], [0.4 * np.cos(0.7), 0.4 * np.sin(0.7)]
    run = stepper.integrate(*start, h=1 / 16, steps=16)
    exact = DerivedStep(system, method.stage_system(system))(*start, 1 / 16)
    np.testing.assert_allclose([*run.q[1], *run.p[1]], np.array([*exact.q, *exact.p], dtype=float), rtol=0, atol=1e-14)
    assert np.abs((run.q**2).sum(axis=1) - 1).max() < 1e-14
    assert np.abs(run.q[-1] - pendulum(0.7, 0.4, 1.0)).max() < 0.02 / 16 ** (2 * degree)
    assert run.iterations[1:].max() <= 8


def spherical(constraints: int) -> tuple[LagrangianSystem, tuple[sympy.Expr, ...]]:
    """A mass on a rod in space; with two constraints in the plane through x + 2 y = 0: a pendulum again."""
    system = LagrangianSystem.from_text(
        name="mass in space", coordinates=["x", "y", "z"], lagrangian="(x_dot**2 + y_dot**2 + z_dot**2)/2 - z"
    )
    x, y, z = system.coordinates
    return system, ((x**2 + y**2 + z**2 - 1) / 2, x + 2 * y)[:constraints]


@pytest.mark.parametrize("constraints", [1, 2])
@pytest.mark.parametrize("degree", [1, 2])
def test_one_and_two_constraints_on_three_coordinates(degree: int, constraints: int) -> None:
    system, surfaces = spherical(constraints)
    method = ConstrainedIncrements(degree, surfaces)
    stepper = compile_stepper(system, method, solver="newton", flags=QUICK_FLAGS)
    plane = np.array([2.0, -1.0, 0.0]) / np.sqrt(5)  # the motion stays there by symmetry, or by the constraint
    down = np.array([0.0, 0.0, -1.0])
    start = np.sin(0.7) * plane + np.cos(0.7) * down, 0.4 * (np.cos(0.7) * plane - np.sin(0.7) * down)
    run = stepper.integrate(*start, h=1 / 16, steps=16)
    exact = DerivedStep(system, method.stage_system(system))(*map(list, start), 1 / 16)
    np.testing.assert_allclose([*run.q[1], *run.p[1]], np.array([*exact.q, *exact.p], dtype=float), rtol=0, atol=1e-14)
    values = sympy.lambdify(system.coordinates, surfaces)(*run.q.T)
    assert max(np.abs(value).max() for value in values) < 1e-14
    angle = pendulum(0.7, 0.4, 1.0)
    assert np.abs(run.q[-1] - (angle[0] * plane - angle[1] * down)).max() < 0.02 / 16 ** (2 * degree)


def test_two_block_sizes_need_blocks_and_rows_of_each() -> None:
    system, surface = rod()
    stages = ConstrainedIncrements(2, (surface,)).stage_system(system)
    with pytest.raises(MethodError, match="2 blocks and 1 rows of 1"):
        layout_of(replace(stages, rows=stages.rows[:-1]), 2)
