"""Source of integrators of array systems: strict C99, formatted, of the same length for any number of coordinates."""

import re
from pathlib import Path

import pytest
from either_system import either_system
from strict_c import STRICT, run
from style import check_style

from scvi_codegen.codegen.lowering.control import control_of
from scvi_codegen.codegen.lowering.program import lower_arrays
from scvi_codegen.codegen.native.compilers import find_compiler
from scvi_codegen.codegen.rendering.program_source import render_arrays
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.methods import as_method

FORMULAS = {
    "bodies": (
        ["r[N, 3]"],
        "sum(i in N, m[i]*sum(a in 3, r_dot[i, a]**2)/2)"
        "+ g*sum(i < j in N, m[i]*m[j]/sqrt(sum(a in 3, (r[i, a] - r[j, a])**2)))",
    ),
    "all forms": (
        ["u[NX, NY]", "q[N]"],
        "sum(i in NX periodic, j in NY, u_dot[i, j]**2/2 - u[i-1, j]*u[i+2, j]*cos(g*t)) + sum(i in N, q_dot[i]**2)"
        "- sum(b in B, exp(k[b]*(q[bonds[b, 0]] - q[bonds[b, 1]]))) - q[0]*q[N-1]**3"
        "- sum(i in 1..N-2, m[i]*q[i-1]*q[i+1])",
    ),
    "lattices": (
        ["u[NX, NY]", "q[N, 2]"],
        "sum(i in NX periodic, j in NY, u_dot[i, j]**2/2 - u[i, j]*u[i+2, j])"
        "+ sum(i in N, q_dot[i, 0]**2 + q_dot[i, 1]**2)"
        "- sum(i in N periodic, q[i-1, 0]*q[i+1, 0] + q[i, 1]**4)",
    ),
    "hamiltonian": (
        ["u[NX, NY]", "q[N]"],
        "sum(i in NX periodic, j in NY, p_u[i+1, j]*u[i, j]**2 + p_u[i, j]**2) - sum(i in N, m[i]*p_q[i]**4*q[i])",
    ),
    "calls": (
        ["u[NX, NY]"],
        "sum(i in NX periodic, j in NY periodic, u_dot[i, j]**2/2 + cos(u[i, j+1] - u[i, j])*exp(u[i, j+1] - u[i, j])"
        "- cos(g*t)*u[i, j] + g*sin(u[i+1, j]))",
    ),
    "free": (["q[N]"], "sum(i in N, q_dot[i]**2/2)"),
    "damped": (["q[N]"], "sum(i in N, q_dot[i]**2/2) - sum(i < j in N, q[i]*q[j])"),
}
EXPLICIT = ("damped", "stoermer-verlet")
"""Is refused."""
FORCES = {"damped": {"q[i]": "-m[i]*q_dot[i]*q[i]", "q[N-1]": "cos(t)"}}


def rendered(name: str, method: str, *, newton: bool = False) -> Source:
    """The text of an integrator."""
    coordinates, formula = FORMULAS[name]
    system = either_system(
        name=name,
        coordinates=coordinates,
        **{"hamiltonian" if name == "hamiltonian" else "lagrangian": formula},
        parameters={"m[N]": 1, "k[B]": 1, "g": 2},
        tables=["bonds[B, 2]"],
        forces=FORCES.get(name),
    )
    program = lower_arrays(system, as_method(method), prefix="arrays", solver="newton" if newton else "fixed-point")
    control = control_of(program)
    assert control is not None or method == "stoermer-verlet"
    return render_arrays(program, control)


@pytest.mark.tiers(0, 3)
@pytest.mark.sampled(5)
@pytest.mark.parametrize(
    ("name", "method"),
    [(name, method) for name in FORMULAS for method in ("svi:4", "stoermer-verlet") if (name, method) != EXPLICIT],
)
def test_generated_code_is_strict_c(name: str, method: str, tmp_path: Path) -> None:
    """No warnings, in the style of all C here, and nothing that is not declared in the header."""
    check_arrays(rendered(name, method), tmp_path)


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", ["bodies", "all forms", "lattices", "hamiltonian", "damped"])
def test_newton_iteration_is_strict_c(name: str, tmp_path: Path) -> None:
    """Newton's iteration compiles as strict C."""
    check_arrays(rendered(name, "svi:4", newton=True), tmp_path)


@pytest.mark.rotated
def test_single_file_with_a_list_of_neighbours_is_strict_c(tmp_path: Path) -> None:
    """Names of its functions differ from the fields of the lists, which its header declares."""
    liquid = either_system(
        name="liquid",
        coordinates=["r[N, 3]"],
        neighbours={"near": {"of": "r", "cutoff": 2.5, "skin": 0.3}},
        lagrangian="sum(i in N, sum(a in 3, r_dot[i, a]**2)/2) - sum(i < j in near, 1/(r[i, 0] - r[j, 0])**12)",
    )
    program = lower_arrays(liquid, as_method("svi:4"), prefix="arrays")
    render_arrays(program, control_of(program)).single_file().write(tmp_path)
    run([*find_compiler(), *STRICT, "-Wno-psabi", "-c", "arrays.c"], tmp_path)


def check_arrays(source: Source, folder: Path) -> None:
    """Compile as a library with strict flags."""
    check_style(source.code)
    check_style(source.header)
    source.write(folder)
    run([*find_compiler(), *STRICT, "-Wno-psabi", "-c", "arrays.c"], folder)


def test_terms_of_the_first_index_are_computed_once_per_pair() -> None:
    """Reads are before, and sums after, the loop over the second index."""
    code = rendered("bodies", "svi:4").code
    outer = code.index(
        "for (long long index_i = here->of.first; index_i < here->of.end; index_i++)",
        code.index("static void add_force_0"),
    )
    inner = code.index("for (long long index_j = between(index_i + 1, ", outer)
    end = code.index("\n}\n", inner)
    assert code[outer:inner].count("] = X[") == 3
    assert code[inner:end].count("] = X[") == 3
    assert code[inner:end].count("F[start_") == 6


def test_explicit_steps_on_lattices_call_functions_of_elements_in_loops_of_their_own() -> None:
    """Not those of time alone, or of longer arguments than sums and products."""
    called = re.compile(r"called\[\d\]\[\w+ - chunk\] = (\w+)\(value")
    assert sorted(called.findall(rendered("calls", "stoermer-verlet").code)) == ["cos", "cos", "exp", "sin"]
    assert not called.findall(rendered("calls", "svi:4").code + rendered("all forms", "stoermer-verlet").code)


def test_explicit_steps_on_lattices_add_the_value_of_another_row_at_once() -> None:
    """Others wait until all of a part are computed, as their targets are elements of the same row."""
    at_once = re.compile(r"F\[.*index_i \+ 1.*index_j\] \+= -?by \* value\[")
    assert len(at_once.findall(rendered("calls", "stoermer-verlet").code)) == 1


@pytest.mark.parametrize(
    ("method", "coupling", "targets"),
    [
        ("stoermer-verlet", "(u[i+1, j] - u[i, j])**2", ["u[i, j]"]),
        ("stoermer-verlet", "cos(u[i+1, j] - u[i, j])", ["u[i, j]", "u[i+1, j]"]),  # is not called twice
        ("stoermer-verlet", "(u[i+1, j] - u[i-1, j])**2", ["u[i+1, j]", "u[i-1, j]"]),  # which reach no farther
        ("stoermer-verlet", "(u[i, j+1] - u[i, j])**2", ["u[i, j+1]", "u[i, j]"]),  # are in one row
        ("svi:2", "(u[i+1, j] - u[i, j])**2", ["u[i+1, j]", "u[i, j]"]),
    ],
)
def test_explicit_steps_complete_cheap_forces_of_periodic_rows_at_once(
    method: str, coupling: str, targets: list[str]
) -> None:
    lagrangian = f"sum(i in N, j in M, u_dot[i, j]**2/2) - sum(i in N periodic, j in M periodic, {coupling})"
    system = either_system(name="plane", coordinates=["u[N, M]"], lagrangian=lagrangian)
    (force,) = lower_arrays(system, as_method(method), prefix="arrays").loops.forces
    assert sorted(map(str, force.writes)) == sorted(targets)


@pytest.mark.parametrize(("mass", "is_equal"), [("g", 1), ("m[i]", 0)])
def test_explicit_steps_store_opposite_forces_once_and_know_equal_masses(mass: str, is_equal: int) -> None:
    lagrangian = f"sum(i in N, {mass}*q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**4)"
    parameters = {"m[N]": 1, "g": 2}
    system = either_system(name="ring", coordinates=["q[N]"], lagrangian=lagrangian, parameters=parameters)
    program = lower_arrays(system, as_method("stoermer-verlet"), prefix="arrays", solver="fixed-point")
    code = render_arrays(program, control_of(program)).code
    assert "lanes values[1][CHUNK];" in code
    assert re.search(
        r"\{values\[0\] \+ \(.*- part_0.first\), -1.0\}, \{values\[0\] \+\s+\(.*- part_1.first\), \+1.0\}", code
    )
    assert f"EQUAL_MASSES = {is_equal} " in code
