"""Array systems: their form, their symmetries, and their unrolled systems."""

import pytest
import sympy
from notation import hamilton, lagrange

from scvi_codegen import LagrangianSystem, SystemDefinitionError, unroll_sums
from scvi_codegen.common.errors import SizesRequiredError
from scvi_codegen.systems.arrays.reading import arrays_from_text
from scvi_codegen.systems.arrays.symmetry import momentum_maps
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.system import MechanicalSystem

GRAVITY = "sum(i in N, m[i]*sum(a in 3, r_dot[i, a]**2)/2) + "
DISTANCE = "sqrt(sum(a in 3, (r[i, a] - r[j, a])**2))"


def system(coordinates: str, lagrangian: str, **extra: object) -> ArraySystem:
    """A system of one array."""
    return LagrangianSystem.from_text(name="system", coordinates=[coordinates], lagrangian=lagrangian, **extra)


def test_array_systems_answer_as_systems_of_named_coordinates() -> None:
    """An array is one coordinate, a list of neighbours has lengths, and there is no formula of all elements."""
    near = {"near": {"of": "r", "cutoff": "c", "skin": 0.5}}
    pairs = GRAVITY + f"sum(i < j in near, {DISTANCE})"
    bodies = system("r[N, 3]", pairs, parameters={"c": 2, "m[N]": 1}, neighbours=near, constraints=["r[0, 0] = 1"])
    assert isinstance(bodies, MechanicalSystem)
    assert (bodies.sizes, [*map(str, bodies.arrays)]) == (("N",), ["r[N, 3]", "m[N]"])
    assert [name for name, *_ in bodies.lengths] == ["near"] * len(bodies.lengths) != []
    assert bodies.with_parameters(c=3).constants == {sympy.Symbol("c", real=True): 3.0}
    assert (bodies.clock, bodies.is_prescribed, bodies.constrained_at_nodes) == (None, False, False)
    with pytest.raises(SizesRequiredError, match="no formula but those of its terms"):
        _ = bodies.formula


def test_momentum_maps_of_bodies_in_space() -> None:
    """Three shifts and three turns of isolated bodies; a field along z leaves two and one."""
    pairs = f"sum(i < j in N, m[i]*m[j]/{DISTANCE})"
    free = system("r[N, 3]", GRAVITY + pairs, parameters={"m[N]": 1})
    assert [each.name for each in momentum_maps(free)] == [
        "momentum of r[.., 0]",
        "momentum of r[.., 1]",
        "momentum of r[.., 2]",
        "angular momentum of r[.., 0], r[.., 1]",
        "angular momentum of r[.., 0], r[.., 2]",
        "angular momentum of r[.., 1], r[.., 2]",
    ]
    falling = system("r[N, 3]", f"{GRAVITY}{pairs} - sum(i in N, m[i]*r[i, 2])", parameters={"m[N]": 1})
    assert len(momentum_maps(falling)) == 3


def test_rotation_requires_equal_masses() -> None:
    """Rotation mixes two components."""
    kinetic = "sum(i in N, r_dot[i, 0]**2 + w*r_dot[i, 1]**2)"
    round_trap = " - sum(i in N, r[i, 0]**2 + r[i, 1]**2)"
    assert not momentum_maps(system("r[N, 2]", kinetic + round_trap, parameters={"w": 2}))
    assert momentum_maps(system("r[N, 2]", kinetic.replace("w*", "") + round_trap))


def test_a_chain_between_walls_has_no_momentum() -> None:
    """One of free or joined ends has."""
    kinetic, springs = "sum(i in N, q_dot[i]**2/2)", " - sum(i in 0..N-2, (q[i+1] - q[i])**4)"
    assert len(momentum_maps(system("q[N]", kinetic + springs))) == 1
    assert not momentum_maps(system("q[N]", f"{kinetic}{springs} - q[0]**2 - q[N-1]**2"))


def test_unrolled_system_has_one_coordinate_per_element() -> None:
    """Every element with its own coordinates, parameters and places."""
    text = "sum(i in N, q_dot[i]**2/2) - c*sum(b in B, k[b]*(q[bonds[b, 0]] - q[bonds[b, 1]])**2)"
    net = lagrange("net", "q[N]", text, parameters={"k[B]": 1, "c": 2}, tables=["bonds[B, 2]"])
    found = unroll_sums(net, {"N": 3, "B": 2}, tables={"bonds": [[0, 2], [2, 1]]}, parameters={"k": [5, 7], "c": 3})
    q, v, k = (sympy.symbols(f"{name}_:3{end}", real=True) for name, end in (("q", ""), ("q", "_dot"), ("k", "")))
    c = sympy.Symbol("c", real=True)
    springs = k[0] * (q[0] - q[2]) ** 2 + k[1] * (q[2] - q[1]) ** 2
    assert sympy.expand(found.formula - sum(x**2 for x in v) / 2 + c * springs) == 0
    assert found.constants == {c: 3.0, k[0]: 5.0, k[1]: 7.0}


def test_sympy_sums_are_read() -> None:
    """Rings, pairs, tables, several indices and decimals, as from text."""
    q, v, bonds, k = map(sympy.IndexedBase, ("q", "q_dot", "bonds", "k"))
    i, j, b, N, B = sympy.symbols("i j b N B", integer=True)
    e = sympy.Symbol("e")
    pairs = sympy.Sum(1 / sympy.sqrt((q[i] - q[j]) ** 2 + e**2), (j, i + 1, N - 1), (i, 0, N - 2))
    ring = sympy.Sum(sympy.cos(q[sympy.Mod(i - 1, N)] - q[i]), (i, 0, N - 1))
    net = sympy.Sum(k[b] * (q[bonds[b, 0]] - q[bonds[b, 1]]) ** 2, (b, 0, B - 1))
    found = LagrangianSystem.from_sympy(
        name="system",
        coordinates=["q[N]"],
        parameters={"e": 1, "k[B]": 1},
        tables=["bonds[B, 2]"],
        lagrangian=sympy.Sum(0.5 * v[i] ** 2, (i, 0, N - 1)) - e * pairs - ring - net / 2,
    )
    expected = system(
        "q[N]",
        "sum(i in N, q_dot[i]**2/2) - e*sum(i < j in N, 1/sqrt((q[i] - q[j])**2 + e**2))"
        "- sum(i in N periodic, cos(q[i-1] - q[i])) - sum(b in B, k[b]*(q[bonds[b, 0]] - q[bonds[b, 1]])**2)/2",
        parameters={"e": 1, "k[B]": 1},
        tables=["bonds[B, 2]"],
    )
    assert set(map(str, found.terms)) == set(map(str, expected.terms))


@pytest.mark.parametrize(
    ("index", "limits"),
    [
        ("Mod(2*i, N)", "(i, 0, N - 1)"),
        ("Mod(i + 1, 2*N)", "(i, 0, N - 1)"),
        ("Mod(i + 1, N)", "(i, 0, N - 2)"),
        ("i", "(i, 0, N)"),
        ("i", "(j, i + 1, N - 1), (i, 1, N - 2)"),
    ],
)
def test_unsupported_sympy_sums_are_rejected(index: str, limits: str) -> None:
    """Other rings, other limits, and what leaves its array."""
    q, v = map(sympy.IndexedBase, ("q", "q_dot"))
    i, j, N = sympy.symbols("i j N", integer=True)
    names = {"i": i, "j": j, "N": N, "Mod": sympy.Mod}
    place, spans = sympy.sympify(index, locals=names), sympy.sympify(f"[{limits}]", locals=names)
    kinetic = sympy.Sum(v[i] ** 2 / 2, (i, 0, N - 1))
    with pytest.raises(SystemDefinitionError):
        LagrangianSystem.from_sympy(
            name="x", coordinates=["q[N]"], lagrangian=kinetic - sympy.Sum(q[place] ** 2, *map(tuple, spans))
        )


def test_periodic_sympy_index_outside_a_sum_is_rejected() -> None:
    """Mod(7, N) is no place of an array whose size is known only in a run."""
    q, v = map(sympy.IndexedBase, ("q", "q_dot"))
    i, N = sympy.symbols("i N", integer=True)
    kinetic = sympy.Sum(v[i] ** 2 / 2, (i, 0, N - 1))
    with pytest.raises(SystemDefinitionError, match=r"Mod\(7, N\) is not an index of a periodic axis"):
        LagrangianSystem.from_sympy(name="x", coordinates=["q[N]"], lagrangian=kinetic - q[sympy.Mod(7, N)] ** 2)


def test_momentum_maps_of_a_hamiltonian() -> None:
    """Shifts, turns of positions with their momenta, and phases."""
    text = (
        "sum(i in N, (p_r[i, 0] + B*r[i, 1]/2)**2 + (p_r[i, 1] - B*r[i, 0]/2)**2)/2"
        f"- sum(i < j in N, 1/{DISTANCE.replace('3', '2', 1)})"
    )
    bodies = hamilton("charges", ["r[N, 2]"], text, B=1)
    assert [each.name for each in momentum_maps(bodies)] == ["angular momentum of r[.., 0], r[.., 1]"]
    oscillators = hamilton("oscillators", "q[N]", "sum(i in N, (q[i]**2 + p_q[i]**2)**2)")
    assert [each.name for each in momentum_maps(oscillators)] == ["norm of q"]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "give exactly one of lagrangian and hamiltonian"),
        ({"lagrangian": "sum(i in N, q_dot[i]**2)", "hamiltonian": "sum(i in N, q[i])"}, "give exactly one"),
        ({"lagrangian": "sum(i in N, q_dot[i]**2)", "momenta": ["p[N]"]}, "a Lagrangian, which has velocities"),
        ({"hamiltonian": "sum(i in N, q[i])", "momenta": ["p[K]"]}, "momenta must be arrays"),
        ({"hamiltonian": "sum(i in N, q[i])", "momenta": ["q[N]"]}, "'q'"),
        ({"hamiltonian": "sum(i in N, q_dot[i]**2)"}, "'q_dot' is not an array"),
    ],
)
def test_exactly_one_of_lagrangian_and_hamiltonian_is_required(given: dict[str, object], message: str) -> None:
    """One of both, with what belongs to it."""
    with pytest.raises(SystemDefinitionError, match=message):
        arrays_from_text({"name": "x", "coordinates": ["q[N]"], **given})


KINETIC = "sum(i in N, q_dot[i]**2/2)"


def test_forces_and_conserved_quantities() -> None:
    """Friction between neighbours leaves the momentum of a ring alone, friction against the ground does not."""
    ring = f"{KINETIC} - sum(i in N periodic, (q[i+1] - q[i])**2)"
    between = system("q[N]", ring, dissipation="sum(i in N periodic, (q_dot[i+1] - q_dot[i])**2)")
    assert [each.name for each in momentum_maps(between)] == ["momentum of q"]
    assert between.changes_energy == "forces act"
    assert momentum_maps(system("q[N]", ring, forces={"q[i]": "-q_dot[i]"})) == ()
    assert [array.name for array in between.velocities] == ["q_dot"]
    assert system("q[N]", ring, forces={"q[0]": "cos(t)"}).velocities == ()
