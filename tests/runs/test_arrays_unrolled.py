"""Array systems against the same systems with unrolled sums, which are derived independently: motions x situations.

All that a run computes is that of the unrolled system, to round-off. Runs that are saved, pickled, divided or shared by
threads equal undivided runs bit by bit.
"""

import re
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS

import scvi_codegen as sc

RATTLE = "svi:1:gauss-lobatto:2"
KINETIC = "sum(i in N, q_dot[i]**2/2)"


def random(*shape):
    """Normal numbers, always the same."""
    return np.random.default_rng(7).normal(size=shape)


@dataclass(frozen=True, eq=False)
class Motion:
    """A system with sizes, data and an initial state; ``p`` are momenta, ``velocity`` velocities."""

    system: object
    q: object
    sizes: dict
    velocity: object = None
    p: object = None
    h: float = 0.1
    data: dict = field(default_factory=dict)
    events: tuple = ()
    inputs: dict | None = None

    def flat(self, values):
        if isinstance(values, dict):
            return np.concatenate([np.ravel(values[each.name]) for each in self.system.coordinates])
        return values if values is None else np.ravel(values)

    def start(self, flat=False):
        """Return q with momenta or velocities, of arrays or of the unrolled system."""
        given = {"p": self.p} if self.p is not None else {"velocity": self.velocity}
        given = {"q": self.q} | {name: values for name, values in given.items() if values is not None}
        if not flat:
            return given | self.data
        rest = {} if "p" in given else {"velocity": np.zeros(len(self.flat(self.q)))}
        return rest | {name: self.flat(each) for name, each in given.items()}

    @cache  # noqa: B019
    def stepper(self, method, solver="auto"):
        method = sc.SVI(1, "gauss-lobatto:2") if method == RATTLE else method
        return sc.compile_stepper(self.system, method, solver=solver, flags=QUICK_FLAGS)

    @cache  # noqa: B019
    def unrolled(self, method, solver="auto"):
        method = sc.SVI(1, "gauss-lobatto:2") if method == RATTLE else method
        system = sc.unroll_sums(self.system, self.sizes, **self.data)
        return sc.compile_stepper(system, method, solver=solver, flags=QUICK_FLAGS)


def lagrangian(
    coordinates, formula, q, sizes, velocity=None, *, declared=(), tables=(), rows=None, values=None, **more
):
    own = {name: more.pop(name) for name in ("h", "events", "inputs") if name in more}
    more |= {"inputs": ["F"]} if "inputs" in own else {}
    names = coordinates.split("; ")
    system = sc.LagrangianSystem.from_text("case", names, formula, parameters=dict(declared), tables=tables, **more)
    data = ({"tables": rows} if rows else {}) | ({"parameters": values} if values else {})
    return Motion(system, q, sizes, velocity, data=data, **own)


BONDS = np.array([[0, 1], [1, 4], [3, 2], [0, 1], [2, 4]])
ROUND = {"bonds": [[0, 1], [1, 2], [2, 3], [0, 3]]}
ROD = "sum(a in 2, (r[bonds[b, 0], a] - r[bonds[b, 1], a])**2) = l[b]**2 for b in B"
PINS = [f"r[pins[p], {k}] = x[p, {k}] for p in P" for k in (0, 1)]
WEIGHT = "sum(i in N, m[i]*sum(a in 2, r_dot[i, a]**2)/2 - m[i]*g*r[i, 1])"
HANGING = np.cumsum([[0, 0], [0.6, -0.8], [0.8, -0.6], [1, 0]], axis=0) / 3
CHAIN = {
    "declared": {"m[N]": 1, "l[B]": 1, "g": 9.81, "x[P, 2]": 0, "c": 0.3, "w": 2},
    "tables": ["bonds[B, 2]", "pins[P]"],
    "rows": {"bonds": [[0, 1], [1, 2], [2, 3]], "pins": [0]},
    "values": {"l": np.full(3, 1 / 3), "m": np.array([0.35, 0.3, 0.2, 0.15])},
    "constraints": [*PINS, ROD],
    "h": 0.01,
}
SIZES = {"N": 4, "B": 3, "P": 1}
TIMES = np.linspace(0.0, 9.0, 12)
NLS = "sum(b in B, (q[bonds[b, 0]] - q[bonds[b, 1]])**2 + (p[bonds[b, 0]] - p[bonds[b, 1]])**2)/2"
MOTIONS = {
    "from rest at 0": lagrangian(
        "q[N]", f"{KINETIC} - sum(i in N, q[i]**2/2)", np.zeros(3), {"N": 3}, forces={"q[0]": "cos(t)"}
    ),
    "ring": lagrangian(
        "q[N]",
        f"{KINETIC} - sum(i in N periodic, (q[i+1] - q[i])**2/2 + (q[i+1] - q[i])**4/16 + q[i]*q[i+2]/9)",
        random(5),
        {"N": 5},
        random(2, 5)[1],
        events=(
            ("q[0]", {}),
            ("+".join(f"q[{i}]**2" for i in range(5)) + " - 2", {"direction": 1}),
            ("q_dot[4] + p_q[0]", {"terminal": 3}),
        ),
    ),
    "bodies": lagrangian(
        "r[N, 2]",
        "sum(i in N, m[i]*sum(a in 2, r_dot[i, a]**2)/2)"
        "+ sum(i < j in N, m[i]*m[j]/sqrt(sum(a in 2, (r[i, a] - r[j, a])**2) + e**2))",
        3 * random(4, 2),
        {"N": 4},
        random(4, 2),
        declared={"m[N]": 1, "e": 0.5},
        values={"m": [1, 2, 0.5, 1]},
    ),
    "net": lagrangian(
        "q[N]",
        f"{KINETIC} - sum(b in B, k[b]*(q[bonds[b, 0]] - q[bonds[b, 1]])**2/2 + q[bonds[b, 0]]**4)",
        random(5),
        {"N": 5, "B": 5},
        random(5),
        declared={"k[B]": 1},
        tables=["bonds[B, 2]"],
        rows={"bonds": BONDS},
        values={"k": [1, 2, 3, 4, 5]},
    ),
    "pinned": lagrangian(
        "q[N]",
        f"{KINETIC} - sum(p in P, q[pins[p]]**2/2)",
        np.ones(4),
        {"N": 4, "P": 2},
        tables=["pins[P]"],
        rows={"pins": [1, 3]},
    ),
    "field": lagrangian(
        "u[NX, NY]",
        "sum(i in NX periodic, j in NY, u_dot[i, j]**2/2 - (u[i+1, j] - u[i, j])**2 + cos(u[i, j]))"
        "- sum(i in NX, j in 1..NY-1, (u[i, j] - u[i, j-1])**2)",
        random(3, 2),
        {"NX": 3, "NY": 2},
        random(3, 2),
    ),
    "level": lagrangian(
        "q[N]",
        f"{KINETIC} - sum(i in N, q[i]**2/2) + 3*sin(t) + a**2 + sum(i in N, a*f[i]*cos(t))"
        "- sum(i in N, j in N, f[i]*f[j]) + sum(i in 0..N-2, 7*a)",
        random(3),
        {"N": 3},
        random(3),
        declared={"a": 2, "f[N]": 1},
        values={"a": 1.5, "f": [0.3, -0.7, 1.9]},
    ),
    "body on ring": lagrangian(
        "x; q[N]",
        "M*x_dot**2/2 + sum(i in N, m[i]*q_dot[i]**2/2) - k*x**2/2"
        "- sum(i in N periodic, (q[i+1] - q[i])**4/4) - k*sum(i in N, (q[i] - x)**2/2)",
        {"x": 0.3, "q": np.linspace(0.0, 1.0, 5)},
        {"N": 5},
        declared={"M": 2, "k": 1, "m[N]": 1},
        values={"m": np.arange(1.0, 6.0)},
        forces={"x": "cos(t)/10", "q[i]": "sin(t)*m[i]"},
    ),
    "friction": lagrangian(
        "r[N, 2]",
        "sum(i in N, m[i]*sum(a in 2, r_dot[i, a]**2)/2)"
        "- sum(b in B, sum(a in 2, (r[bonds[b, 1], a] - r[bonds[b, 0], a])**2))",
        random(2, 4, 2)[0],
        {"N": 4, "B": 4},
        random(2, 4, 2)[1],
        declared={"m[N]": 1, "c": 0.3, "w": 2},
        tables=["bonds[B, 2]"],
        rows=ROUND,
        values={"m": [1, 2, 3, 4]},
        forces={"r[i, a]": "-c*m[i]*r_dot[i, a]**3", "r[N-1, 0]": "cos(w*t)"},
        dissipation="sum(b in B, c*(r_dot[bonds[b, 1], 1] - r_dot[bonds[b, 0], 1])**2)",
        h=0.05,
    ),
    "data": lagrangian(
        "q[N]",
        f"{KINETIC} - sum(i in 0..N-2, (q[i+1] - q[i])**2/2) - q[0]**2/2",
        random(6),
        {"N": 6},
        random(2, 6)[1],
        declared={"c": 0.1},
        forces={"q[i]": "-c*q_dot[i]", "q[N-1]": "F"},
        inputs={"F": (TIMES, np.sin(TIMES), "cubic")},
    ),
    "stiff": lagrangian(
        "q[N]",
        "sum(i in N, m[i]*q_dot[i]**2/2 - w*q[i]**2/2 - q[i]**4/4) - sum(i in N periodic, (q[i+1] - q[i])**2/2)",
        random(5),
        {"N": 5},
        random(2, 5)[1],
        declared={"w": 400.0, "m[N]": 1},
        values={"m": np.linspace(1.0, 2.0, 5)},
        forces={"q[i]": "-sin(q[i])/3", "q[0]": "cos(t)"},
    ),
    "rods": lagrangian("r[N, 2]", WEIGHT, HANGING, SIZES, **CHAIN),
    "waves": Motion(
        sc.HamiltonianSystem.from_text(
            name="waves",
            coordinates=["q[N]"],
            momenta=["p[N]"],
            parameters={"g": 1},
            tables=["bonds[B, 2]"],
            hamiltonian=f"{NLS} - sum(i in N, g/4*(q[i]**2 + p[i]**2)**2)",
        ),
        0.5 * random(2, 4)[0],
        {"N": 4, "B": 4},
        p=0.5 * random(2, 4)[1],
        h=0.05,
        data={"tables": {"bonds": [[0, 1], [1, 2], [2, 0], [2, 3]]}},
    ),
    "driven waves": Motion(
        sc.HamiltonianSystem.from_text(
            name="driven waves",
            coordinates=["q[N]"],
            parameters={"c": 0.3},
            hamiltonian="sum(i in N, p_q[i]**2/2 + q[i]**2/2) + sum(i in 0..N-2, q[i]*q[i+1]*p_q[i])",
            forces={"q[i]": "-c*p_q[i] + cos(t)"},
        ),
        0.3 * random(2, 3)[0],
        {"N": 3},
        p=0.3 * random(2, 3)[1],
    ),
}
SITUATIONS = {
    "steps": {"steps": 40, "save_every": 10},
    "late": {"steps": 10, "t": 0.7},
    "shortened": {"t_end": 1.234},
    "backward": {"steps": 20, "h": -1},
    "adaptive": {"h": None, "t_end": 3.0, "save_every": 2},
    "tolerance": {"h": None, "t_end": 2.0, "tolerance": 1e-9},
}
CASES = [
    ("from rest at 0", "svi:4", "auto", "steps"),
    ("ring", "svi:6", "auto", "steps"),
    ("ring", "svi:6", "auto", "adaptive"),
    ("bodies", "sc:5", "auto", "steps"),
    ("net", "stoermer-verlet", "auto", "steps"),
    ("pinned", "svi:4", "auto", "shortened"),
    ("field", "composition:8", "auto", "steps"),
    ("level", "svi:2", "auto", "late"),
    ("body on ring", "svi:4", "auto", "steps"),
    ("friction", "svi:2", "auto", "steps"),
    ("data", "svi:6", "auto", "steps"),
    ("data", "svi:6", "auto", "adaptive"),
    ("stiff", "svi:4", "newton", "steps"),
    ("stiff", "svi:4", "newton", "tolerance"),
    ("rods", RATTLE, "auto", "steps"),
    ("waves", "gauss:3", "auto", "steps"),
    ("waves", "gauss:3", "auto", "adaptive"),
]
FULL = [
    *(("net", method, "auto", "steps") for method in ("svi:4", "svi:9", "composition:8")),
    *(("friction", method, "auto", "steps") for method in ("svi:1", "svi:5", "gauss:3", "sc:4")),
    *(("stiff", method, "newton", "steps") for method in ("svi:2", "svi:8", "gauss:3")),
    ("waves", "svi:9", "auto", "steps"),
    ("driven waves", "gauss:3", "auto", "steps"),
    *(("ring", "svi:6", "auto", situation) for situation in ("tolerance", "backward")),
    ("level", "stoermer-verlet", "auto", "late"),
    ("data", "svi:6", "auto", "shortened"),
]


def assert_close(found, expected, error=2e-12):
    expected = np.asarray(expected)
    assert_allclose(np.reshape(found, expected.shape), expected, rtol=0, atol=error * np.abs(expected).max(initial=1.0))


def written(formula):
    """Return a formula in the names of unrolled systems."""
    return re.sub(
        r"(\w+)(_dot)?\[(\d+)\]", lambda m: f"{m[1].removesuffix('_dot')}_{m[3]}" + "_dot" * ("_dot" in m[0]), formula
    )


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("name", "method", "solver", "situation"), [*CASES, *(pytest.param(*each, marks=pytest.mark.full) for each in FULL)]
)
def test_array_system_equals_the_unrolled_system(name, method, solver, situation):
    motion, plan = MOTIONS[name], {"h": 1} | SITUATIONS[situation]
    plan = {
        key: value * motion.h if key == "h" and value else value for key, value in plan.items() if value is not None
    }
    plan |= {"inputs": motion.inputs} if motion.inputs else {}
    stepper, other = motion.stepper(method, solver), motion.unrolled(method, solver)
    events = [[sc.Event(change(text), **more) for text, more in motion.events] for change in (str, written)]
    own, expected = (
        each.integrate(**motion.start(flat), **plan, **({"events": named} if named else {}))
        for each, flat, named in ((stepper, False, events[0]), (other, True, events[1]))
    )
    assert own.steps == expected.steps or "h" not in plan
    rows = slice(None) if "h" in plan else slice(-1, None)  # adaptive steps may be a level of the grid apart
    error = 2e-12 if "tolerance" not in plan else 1e-7
    assert_close(own.t[rows], expected.t[rows])
    for quantity in ("q", "p", *(["velocity"] if motion.p is None else [])):
        assert_close(np.asarray(getattr(own, quantity))[rows], getattr(expected, quantity)[rows], error)
    assert_close(own.energy()[rows], expected.energy()[rows], error)
    if stepper.momentum_map_names and method.startswith(("svi", "gauss")):
        assert np.ptp(own.momentum_maps(), axis=0).max() < 1e-13
    if name in ("ring", "waves"):
        assert own.step_error == pytest.approx(expected.step_error, rel=2.0, nan_ok=True)  # compositions have none
    between = np.array([[0.3, 0.6], [0.9, 0.1]]) * (own.t[-1] - own.t[0]) + own.t[0]
    if method.startswith(("svi:2", "svi:4", "svi:6", "gauss")):
        for found, wanted in zip(own.at(between), expected.at(between), strict=True):
            assert_close(np.asarray(found), wanted, error)
    for found, wanted in zip(own.events or (), expected.events or (), strict=True):
        assert len(found) == len(wanted)
        assert_close(found.t, wanted.t, error)
        if len(found):
            assert_close(np.asarray(found.q), wanted.q, error)
    if name == "rods":
        end = stepper.start({"r": own.q["r"][-1]}, {"r": own.p["r"][-1]}, h=0.01, **motion.data)
        exact = other.multipliers(expected.q[-1], expected.p[-1])
        assert_close(np.concatenate([np.ravel(each) for each in end.multipliers]), exact, 1e-10)
        assert max(np.abs(each).max() for values in end.constraint_values for each in values) < 1e-12


@pytest.mark.second
def test_velocities_of_hamiltonians_are_unavailable():
    motion = MOTIONS["waves"]
    stepper = motion.stepper("gauss:3")
    assert stepper.momentum_map_names == ("norm of q",)
    with pytest.raises(sc.StateError, match="give momenta p"):
        stepper.start(motion.q, velocity=motion.p, h=0.05, **motion.data)
    run = stepper.start(**motion.start(), h=0.05)
    for each in (run, stepper.integrate(**motion.start(), h=0.05, steps=1)):
        with pytest.raises(sc.StateError, match="velocities are unavailable"):
            each.velocity  # noqa: B018  (the access is the point)
