"""Integrators of array systems, compared with those of the unrolled systems, which are derived independently."""

import pickle
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import scvi_codegen as sc

KINETIC = "sum(i in N, q_dot[i]**2/2)"


@dataclass(frozen=True)
class Case:
    """A system with sizes, data and a state."""

    system: sc.LagrangianSystem
    q: Any
    velocity: Any
    h: float
    tables: Any = None
    parameters: Any = None

    @property
    def sizes(self) -> dict[str, int]:
        """Return the sizes from the shape of the only array and the rows of the only table."""
        found = dict(zip(self.system.coordinates[0].names, self.q.shape, strict=False))
        return found | {table.names[0]: len(self.tables[table.name]) for table in self.system.tables}


def random(*shape: int) -> Any:
    """Normal numbers, always the same."""
    return np.random.default_rng(7).normal(size=shape)


def case(coordinates: str, lagrangian: str, q: Any, velocity: Any, h: float, **extra: Any) -> Case:
    """A system of one array."""
    declared = {key: extra.pop(key) for key in ("declared", "places") if key in extra}
    system = sc.LagrangianSystem.from_text(
        name="case",
        coordinates=[coordinates],
        lagrangian=lagrangian,
        parameters=declared.get("declared"),
        tables=declared.get("places", ()),
    )
    return Case(system, q, velocity, h, **extra)


CASES = {
    "from rest at 0": case("q[N]", f"{KINETIC} - sum(i in N, q[i]**2/2)", np.zeros(3), np.ones(3), 0.1),
    "ring": case(
        "q[N]", f"{KINETIC} - sum(i in N periodic, (q[i+1] - q[i])**4/4 + q[i-1]*q[i+2])", random(5), None, 0.1
    ),
    "driven chain": case(
        "q[N]",
        "sum(i in N, m[i]*q_dot[i]**2/2) - k*sum(i in 0..N-2, cosh(q[i+1] - q[i])) - q[0]**2 + q[N-1]*sin(t)",
        random(4),
        -random(4),
        0.1,
        declared={"m[N]": 1, "k": 1},
        parameters={"m": [1, 2, 3, 4], "k": 1.5},
    ),
    "bodies": case(
        "r[N, 2]",
        "sum(i in N, m[i]*sum(a in 2, r_dot[i, a]**2)/2)"
        "+ sum(i < j in N, m[i]*m[j]/sqrt(sum(a in 2, (r[i, a] - r[j, a])**2) + e**2))",
        3 * random(4, 2),
        random(4, 2),
        0.05,
        declared={"m[N]": 1, "e": 0.5},
        parameters={"m": [1, 2, 0.5, 1]},
    ),
    "net": case(
        "q[N]",
        f"{KINETIC} - sum(b in B, k[b]*(q[bonds[b, 0]] - q[bonds[b, 1]])**2/2 + q[bonds[b, 0]]**4)",
        random(5),
        random(5),
        0.1,
        declared={"k[B]": 1},
        places=["bonds[B, 2]"],
        tables={"bonds": np.array([[0, 1], [1, 4], [3, 2], [0, 1], [2, 4]])},
        parameters={"k": [1, 2, 3, 4, 5]},
    ),
    "field": case(
        "u[NX, NY]",
        "sum(i in NX periodic, j in NY, u_dot[i, j]**2/2 - (u[i+1, j] - u[i, j])**2 + cos(u[i, j]))"
        "- sum(i in NX, j in 1..NY-1, (u[i, j] - u[i, j-1])**2)",
        random(3, 2),
        random(3, 2),
        0.1,
    ),
}


@pytest.mark.sampled(3)
@pytest.mark.covering
@pytest.mark.parametrize("method", ["svi:4", "gauss:2", "sc:5", "svi:9", "stoermer-verlet", "composition:8"])
@pytest.mark.parametrize("name", CASES)
def test_array_system_equals_the_unrolled_system(name: str, method: str) -> None:
    """States, energies, momentum maps and errors of steps are those of the system written out, to round-off."""
    each = CASES[name]
    own = sc.compile_stepper(each.system, method).integrate(
        each.q,
        velocity=each.velocity,
        h=each.h,
        steps=40,
        save_every=10,
        tables=each.tables,
        parameters=each.parameters,
    )
    written = sc.unroll_sums(each.system, each.sizes, tables=each.tables, parameters=each.parameters)
    stepper = sc.compile_stepper(written, method)
    velocity = np.zeros(each.q.size) if each.velocity is None else each.velocity.reshape(-1)
    other = stepper.integrate(each.q.reshape(-1), velocity=velocity, h=each.h, steps=40, save_every=10)
    array = each.system.coordinates[0].name
    assert own.t == pytest.approx(other.t, abs=1e-15)
    assert own.q[array].reshape(5, -1) == pytest.approx(other.q, rel=1e-12, abs=1e-12)
    assert own.p[array].reshape(5, -1) == pytest.approx(other.p, rel=1e-12, abs=1e-12)
    assert own.energy() == pytest.approx(other.energy(), rel=1e-12, abs=1e-12)
    if method.startswith(("svi", "gauss")):
        assert own.step_error == pytest.approx(other.step_error, rel=2.0)


@pytest.mark.parametrize("method", ["svi:4", "gauss:3", "svi:9"])
def test_hamiltonian_array_system_equals_the_unrolled_system(method: str) -> None:
    """Discrete nonlinear Schroedinger equation on a net; its norm, the angular momentum of all phases, is conserved."""
    field = sc.HamiltonianSystem.from_text(
        name="field",
        coordinates=["q[N]"],
        momenta=["p[N]"],
        parameters={"g": 1},
        tables=["bonds[B, 2]"],
        hamiltonian="sum(b in B, (q[bonds[b, 0]] - q[bonds[b, 1]])**2 + (p[bonds[b, 0]] - p[bonds[b, 1]])**2)/2"
        "- sum(i in N, g/4*(q[i]**2 + p[i]**2)**2)",
    )
    bonds = {"bonds": [[0, 1], [1, 2], [2, 0], [2, 3]]}
    q, p = 0.5 * random(2, 4)
    stepper = sc.compile_stepper(field, method)
    run = stepper.integrate(q, p, h=0.05, steps=100, save_every=25, tables=bonds)
    written = sc.unroll_sums(field, {"N": 4, "B": 4}, tables=bonds)
    other = sc.compile_stepper(written, method).integrate(q, p, h=0.05, steps=100, save_every=25)
    assert run.q["q"] == pytest.approx(other.q, abs=1e-13)
    assert run.p["q"] == pytest.approx(other.p, abs=1e-13)
    assert run.energy() == pytest.approx(other.energy(), abs=1e-13)
    assert stepper.momentum_map_names == ("norm of q",)
    assert np.ptp(run.momentum_maps()) < 1e-14
    with pytest.raises(sc.StateError, match="give momenta p"):
        stepper.start(q, velocity=p, h=0.05, tables=bonds)
    with pytest.raises(sc.StateError, match="velocities are unavailable"):
        stepper.start(q, p, h=0.05, tables=bonds).velocity  # noqa: B018  (the access is the point)
    with pytest.raises(sc.StateError, match="velocities are unavailable"):
        run.velocity  # noqa: B018  (the access is the point)


@pytest.mark.parametrize("count", [2, 3, 64, 1000])
def test_one_library_is_used_for_every_size(count: int) -> None:
    """A ring of coupled oscillators against its normal modes; momentum to round-off."""
    stepper = sc.compile_stepper(
        sc.LagrangianSystem.from_text(
            name="ring", coordinates=["q[N]"], lagrangian=f"{KINETIC} - sum(i in N periodic, (q[i+1] - q[i])**2/2)"
        ),
        "svi:6",
    )
    q, velocity = random(count), random(2, count)[1]
    run = stepper.integrate(q, velocity=velocity, h=0.25, steps=40, save_every=40)
    frequencies = 2 * np.abs(np.sin(np.pi * np.arange(count) / count))
    modes, rates, phase = np.fft.fft(q), np.fft.fft(velocity), 10.0 * frequencies
    slow = np.where(frequencies > 1e-12, np.sin(phase) / np.maximum(frequencies, 1e-12), 10.0)
    expected = np.fft.ifft(modes * np.cos(phase) + rates * slow).real
    assert run.q["q"][-1] == pytest.approx(expected, abs=1e-12)
    assert np.ptp(run.momentum_maps()[:, 0]) < 1e-14 * np.sqrt(count)


def test_energy_does_not_drift() -> None:
    """Over 20 000 steps of a variational method; an explicit one of its order oscillates."""
    each = CASES["ring"]
    ring = sc.LagrangianSystem.from_text(
        name="ring",
        coordinates=["q[N]"],
        lagrangian=f"{KINETIC} - sum(i in N periodic, (q[i+1] - q[i])**2/2 + (q[i+1] - q[i])**4/4)",
    )
    run = sc.compile_stepper(ring, "svi:6").integrate(each.q, h=0.05, steps=20_000, save_every=200)
    changes = run.energy() - run.energy()[0]
    assert run.energy_error() < 1e-13
    assert abs(changes[-20:].mean() - changes[:20].mean()) < 3e-14


@pytest.mark.parametrize("method", ["svi:2", "stoermer-verlet"])
def test_energy_has_the_terms_without_coordinates(method: str) -> None:
    """Terms of parameters, fields and time, of one sum or two, as of the system written out; they are no forces."""
    extra = "3*sin(t) + a**2 + sum(i in N, a*f[i]*cos(t)) - sum(i in N, j in N, f[i]*f[j]) + sum(i in 0..N-2, 7*a)"
    system = sc.LagrangianSystem.from_text(
        name="level",
        coordinates=["q[N]"],
        parameters={"a": 2, "f[N]": 1},
        lagrangian=f"{KINETIC} - sum(i in N, q[i]**2/2) + {extra}",
    )
    written = sc.compile_stepper(sc.unroll_sums(system, {"N": 3}), method)
    f = {"f_0": 0.3, "f_1": -0.7, "f_2": 1.9}
    start = {"velocity": random(3), "h": 0.1, "steps": 4, "t": 0.7}
    own = sc.compile_stepper(system, method).integrate(random(3), parameters={"a": 1.5, "f": list(f.values())}, **start)
    other = written.integrate(random(3), parameters={"a": 1.5, **f}, **start)
    assert np.abs(own.q["q"] - other.q).max() < 1e-15
    assert np.abs(own.energy() - other.energy()).max() < 1e-14 * np.abs(other.energy()).max()
    assert np.ptp(other.energy()) > 0.05


def test_consecutive_runs_equal_one_run() -> None:
    """Steps in one or several calls are bitwise equal; a stepper survives pickling."""
    each = CASES["bodies"]
    stepper = pickle.loads(pickle.dumps(sc.compile_stepper(each.system, "svi:4")))
    runs = [stepper.start(each.q, velocity=each.velocity, h=0.05, parameters=each.parameters) for _ in range(2)]
    runs[0].advance(30)
    for _ in range(30):
        runs[1].advance(1)
    assert np.array_equal(runs[0].q["r"], runs[1].q["r"])
    assert runs[0].t == runs[1].t
    assert runs[0].steps == 30
    assert runs[0].iterations == runs[1].iterations


@pytest.mark.parametrize("method", ["svi:4", "composition:8"])
def test_restored_run_continues_bitwise(method: str) -> None:
    """Tables and parameters are restored bitwise; other bytes are rejected."""
    each = CASES["net"]
    stepper = sc.compile_stepper(each.system, method)
    run = stepper.start(each.q, velocity=each.velocity, h=0.1, tables=each.tables, parameters=each.parameters)
    run.advance(7)
    again = stepper.from_checkpoint(run.checkpoint())
    for one in (run, again):
        one.advance(5)
    assert np.array_equal(run.q["q"], again.q["q"])
    assert np.array_equal(run.p["q"], again.p["q"])
    assert (run.t, run.steps, run.iterations, run.energy) == (again.t, again.steps, again.iterations, again.energy)
    for wrong in (b"", b"no run", run.checkpoint()[:200]):
        with pytest.raises(sc.StateError, match="invalid saved run"):
            stepper.from_checkpoint(wrong)
    with pytest.raises(sc.StateError, match="the saved run is one of"):
        sc.compile_stepper(each.system, "svi:2").from_checkpoint(run.checkpoint())


def test_observed_runs_save_the_requested_quantities() -> None:
    """The first and the last state are saved."""
    each = CASES["ring"]
    stepper = sc.compile_stepper(each.system, "svi:2")
    run = stepper.integrate(each.q, h=0.01, steps=25, save_every=10, observe=lambda run: run.q["q"][:2])
    assert run.observed is not None
    assert run.observed.shape == (3, 2)
    assert run.q["q"].shape == (2, 5)
    assert run.t == pytest.approx([0.0, 0.1, 0.2])
    assert np.array_equal(run.observed[-1], run.q["q"][-1, :2])


@pytest.mark.parametrize(
    ("observe", "message"),
    [
        (lambda run: None, "the result of observe must be real numbers, not None"),
        (lambda run: {"a": 1.0}, "the result of observe must be real numbers"),
        (lambda run: np.zeros(run.steps), r"keep its shape: \(1,\) at t = 0.1, \(0,\) before"),
    ],
)
def test_unsupported_observations_are_rejected(observe: Any, message: str) -> None:
    """Errors name the observation; they are neither NumPy errors nor NaN."""
    each = CASES["ring"]
    with pytest.raises(sc.StateError, match=message):
        sc.compile_stepper(each.system, "svi:2").integrate(each.q, h=0.1, steps=2, observe=observe)


def test_velocities_depend_on_masses() -> None:
    """Velocities of saved states and of a run; representations fit one line."""
    each = CASES["bodies"]
    stepper = sc.compile_stepper(each.system, "svi:2")
    given = {"velocity": each.velocity, "h": 0.05, "parameters": each.parameters}
    run, going = stepper.integrate(each.q, steps=3, **given), stepper.start(each.q, **given)
    assert run.velocity["r"].shape == (4, 4, 2)
    assert run.velocity["r"][0] == pytest.approx(each.velocity, rel=1e-15)
    assert run.p["r"][0, 2] == pytest.approx(0.5 * each.velocity[2], rel=1e-15)
    ones = {"r": np.ones((4, 2))}
    assert going.stepper.velocity(each.q, ones, 0.0, going.parameters)["r"][:, 0] == pytest.approx([1, 0.5, 2, 1])
    going.advance(3)
    assert np.array_equal(going.velocity["r"], run.velocity["r"][-1])
    shown = [repr(one) for one in (run, going, each.system)]
    assert shown[0] == "<Trajectory of case, svi-2-gauss-legendre-2; 4 states from t = 0 to 0.15, 3 steps of 0.05>"
    assert shown[1].endswith("; t = 0.15 after 3 steps of 0.05, solver fixed-point>")
    assert shown[2] == "LagrangianSystem(name='case', coordinates=(r[N, 2]))"


def test_table_with_one_column_may_be_a_list() -> None:
    """For example, fixed positions."""
    constrained = sc.LagrangianSystem.from_text(
        name="held",
        coordinates=["q[N]"],
        tables=["pins[P, 1]"],
        lagrangian=f"{KINETIC} - sum(p in P, q[pins[p, 0]]**2/2)",
    )
    stepper = sc.compile_stepper(constrained, "svi:4")
    runs = [stepper.integrate(random(4), h=0.1, steps=5, tables={"pins": pins}) for pins in ([1, 3], [[1], [3]])]
    assert np.array_equal(runs[0].q["q"], runs[1].q["q"])
    assert np.array_equal(runs[0].q["q"][-1, ::2], random(4)[::2])
    assert not np.any(runs[0].q["q"][-1, 1::2] == random(4)[1::2])


def test_energies_are_drawn() -> None:
    """The energies may share axes with other trajectories."""
    pytest.importorskip("matplotlib")
    each = CASES["ring"]
    run = sc.compile_stepper(each.system, "svi:2").integrate(each.q, h=0.1, steps=20)
    line = sc.plot_energy([run, run]).get_lines()[0]
    assert line.get_ydata()[1:] == pytest.approx(abs(run.energy() / run.energy()[0] - 1)[1:], abs=1e-15)


@pytest.mark.parametrize(
    ("q", "given", "message"),
    [
        (np.zeros((3, 3)), {}, "'bonds' is missing in tables"),
        (np.zeros((3, 3)), {"tables": {"bonds": [[0, 3]]}}, r"runs from 3 to 3, but r\[N, 3\] has N = 3 entries"),
        (np.zeros((3, 3)), {"tables": {"bonds": [[0, -1]]}}, "not -1 to 0"),
        (np.zeros((3, 3)), {"tables": {"bonds": [[0.0, 1.0]]}}, "must be whole numbers"),
        (np.zeros((3, 3)), {"tables": {"bonds": [0, 1]}}, r"not \(2,\)"),
        (np.zeros((3, 2)), {"tables": {"bonds": [[0, 1]]}}, r"must have the shape of r\[N, 3\], not \(3, 2\)"),
        (np.full((3, 3), np.nan), {"tables": {"bonds": [[0, 1]]}}, r"is not at the index \[0, 0\]"),
        (
            np.zeros((3, 3)),
            {"tables": {"bonds": [[0, 1]]}, "parameters": {"k": [1, 2]}},
            "B must be the same in all arrays: it is 2 in k",
        ),
        (np.zeros((3, 3)), {"tables": {"bonds": [[0, 1]]}, "parameters": {"kk": 1}}, "did you mean 'k'"),
        (np.zeros((3, 3)), {"tables": {"bonds": [[0, 1]]}, "parameters": {"k": np.inf}}, "must be finite"),
        (
            np.zeros((3, 3)),
            {"tables": {"bonds": [[0, 1]]}, "velocity": np.zeros((2, 3))},
            r"velocity must have shape \(9,\)",
        ),
        (
            np.zeros((3, 3)),
            {"tables": {"bonds": [[0, 1]]}, "parameters": {"k": [[1.0]]}},
            r"'k' must have the shape .*, not \(1, 1\)",
        ),
        (np.zeros((3, 3)), {"tables": {"bonds": [[0, 1]]}, "h": 0.0}, "the step size h is 0"),
        ({"x": np.zeros((3, 3))}, {"tables": {"bonds": [[0, 1]]}}, "there is no 'x' in positions"),
    ],
)
def test_incompatible_arrays_are_rejected(q: Any, given: dict[str, Any], message: str) -> None:
    """Arrays are checked before the run."""
    net = sc.LagrangianSystem.from_text(
        name="net",
        coordinates=["r[N, 3]"],
        parameters={"k[B]": 1},
        tables=["bonds[B, 2]"],
        lagrangian="sum(i in N, sum(a in 3, r_dot[i, a]**2)/2) - sum(b in B, k[b]*r[bonds[b, 0], 0]*r[bonds[b, 1], 1])",
    )
    with pytest.raises(sc.StateError, match=message):
        sc.compile_stepper(net, "svi:2").start(q, **{"h": 0.1, **given})


def test_failures_of_array_runs() -> None:
    """A too large step fails and the preceding states are saved; a coordinate without mass is reported."""
    each = CASES["ring"]
    with pytest.raises(sc.StepFailedError, match="Use a smaller h") as caught:
        sc.compile_stepper(each.system, "svi:4").integrate(each.q, h=1.5, steps=3)
    assert len(caught.value.trajectory.t) == 1
    bare = sc.LagrangianSystem.from_text(
        name="bare", coordinates=["q[N]"], lagrangian="sum(i in 0..N-2, q_dot[i]**2/2) - sum(i in N, q[i]**2)"
    )
    with pytest.raises(sc.StateError, match="coordinate 2 of 3 has no positive mass"):
        sc.compile_stepper(bare, "svi:2").start(np.ones(3), h=0.1)
    with pytest.raises(sc.MethodError, match=r"3000 coordinates are too many .* scvi-4.* is not supported for array"):
        sc.compile_stepper(bare, "scvi:4").integrate(np.ones(3000), h=0.1, steps=1)
    with pytest.warns(sc.AccuracyWarning):
        sc.compile_stepper(CASES["field"].system, "svi:2").integrate(CASES["field"].q, h=0.4, steps=5)


def test_index_out_of_range_of_a_table_is_rejected() -> None:
    """A loop over another size than the table's rows, found before a row is read."""
    system = sc.LagrangianSystem.from_text(
        name="x",
        coordinates=["q[N]"],
        tables=["bonds[B, 2]"],
        lagrangian="sum(i in N, q_dot[i]**2/2 - q[bonds[i, 0]]**2)",
    )
    message = r"bonds\[i, 0\] runs from 0 to 4, but bonds\[B, 2\] has B = 1 entries"
    with pytest.raises(sc.StateError, match=message):
        sc.compile_stepper(system, "svi:2").start(np.ones(5), h=0.1, tables={"bonds": [[0, 1]]})
    with pytest.raises(sc.SystemDefinitionError, match="out of bounds"):
        sc.unroll_sums(system, {"N": 5, "B": 1}, tables={"bonds": [[0, 1]]})


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("method", "most"), [("svi:1", 1.3), ("svi:2", 1.6), ("svi:4", 2.2), ("svi:8", 3.4)])
@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian"])
def test_fixed_point_converges_up_to_the_documented_step_size(form: str, method: str, most: float) -> None:
    """For an oscillator, also where positions or momenta pass through 0; the energy is conserved."""
    formulas = {
        "lagrangian": "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)",
        "hamiltonian": "sum(i in N, (p_q[i]**2 + q[i]**2)/2)",
    }
    kind = sc.LagrangianSystem if form == "lagrangian" else sc.HamiltonianSystem
    system = kind.from_text("o", ["q[N]"], formulas[form])
    run = sc.compile_stepper(system, method).start(np.ones(3), 0.3 * np.ones(3), h=0.95 * most)
    before = run.energy
    run.advance(50)
    assert run.energy == pytest.approx(before, rel=1e-13)
    assert np.isnan(run.step_error) == (method == "svi:1" and form == "hamiltonian")


FORCED = sc.LagrangianSystem.from_text(
    name="forced net",
    coordinates=["r[N, 2]"],
    parameters={"m[N]": 1, "c": 0.3, "w": 2},
    tables=["bonds[B, 2]"],
    lagrangian="sum(i in N, m[i]*sum(a in 2, r_dot[i, a]**2)/2)"
    "- sum(b in B, sum(a in 2, (r[bonds[b, 1], a] - r[bonds[b, 0], a])**2))",
    forces={"r[i, a]": "-c*m[i]*r_dot[i, a]**3", "r[N-1, 0]": "cos(w*t)"},
    dissipation="sum(b in B, c*(r_dot[bonds[b, 1], 1] - r_dot[bonds[b, 0], 1])**2)",
)


@pytest.mark.parametrize(
    "method", ["svi:2", *(pytest.param(name, marks=pytest.mark.full) for name in ("svi:1", "svi:5", "gauss:3", "sc:4"))]
)
def test_velocity_forces_equal_those_of_the_unrolled_system(method: str) -> None:
    """Friction at every place, between the ends of bonds, and a drive at one place."""
    bonds, masses = {"bonds": [[0, 1], [1, 2], [2, 3], [0, 3]]}, {"m": [1, 2, 3, 4]}
    q, velocity = random(2, 4, 2)
    written = sc.unroll_sums(FORCED, {"N": 4, "B": 4}, tables=bonds, parameters=masses)
    stepper = sc.compile_stepper(FORCED, method)
    run = stepper.integrate(q, velocity=velocity, h=0.05, steps=40, tables=bonds, parameters=masses)
    other = sc.compile_stepper(written, method).integrate(
        q.reshape(-1), velocity=velocity.reshape(-1), h=0.05, steps=40
    )
    assert run.q["r"].reshape(41, -1) == pytest.approx(other.q, abs=1e-14)
    assert run.p["r"].reshape(41, -1) == pytest.approx(other.p, abs=1e-14)
    assert abs(run.energy() - run.energy()[0]).max() > 0.1
    assert stepper.momentum_map_names == ()


@pytest.mark.parametrize("method", ["stoermer-verlet", pytest.param("svi:3", marks=pytest.mark.full)])
def test_forces_of_position_and_time(method: str) -> None:
    """Explicit methods take them; those of velocities are refused."""
    chain = {"name": "chain", "coordinates": ["q[N]"], "parameters": {"c": 0.3}}
    lagrangian = f"{KINETIC} - sum(i in 0..N-2, (q[i+1] - q[i])**2)"
    driven = sc.LagrangianSystem.from_text(
        **chain, lagrangian=lagrangian, forces={"q[N-1]": "cos(t)", "q[i]": "-c*q[i]**3"}
    )
    q, velocity = random(2, 3)
    run = sc.compile_stepper(driven, method).integrate(q, velocity=velocity, h=0.1, steps=30)
    other = sc.compile_stepper(sc.unroll_sums(driven, {"N": 3}), method)
    assert run.q["q"] == pytest.approx(other.integrate(q, velocity=velocity, h=0.1, steps=30).q, abs=1e-14)
    damped = sc.LagrangianSystem.from_text(**chain, lagrangian=lagrangian, forces={"q[i]": "-c*q_dot[i]"})
    with pytest.raises(sc.MethodError, match="does not support velocity-dependent forces"):
        sc.compile_stepper(damped, "stoermer-verlet")


@pytest.mark.full
def test_forces_depending_on_momenta() -> None:
    """Beside a Hamiltonian."""
    system = sc.HamiltonianSystem.from_text(
        name="waves",
        coordinates=["q[N]"],
        parameters={"c": 0.3},
        hamiltonian="sum(i in N, p_q[i]**2/2 + q[i]**2/2) + sum(i in 0..N-2, q[i]*q[i+1]*p_q[i])",
        forces={"q[i]": "-c*p_q[i] + cos(t)"},
    )
    q, p = 0.3 * random(2, 3)
    run = sc.compile_stepper(system, "gauss:3").integrate(q, p, h=0.1, steps=30)
    other = sc.compile_stepper(sc.unroll_sums(system, {"N": 3}), "gauss:3").integrate(q, p, h=0.1, steps=30)
    assert run.q["q"] == pytest.approx(other.q, abs=1e-14)


def test_friction_damps_at_the_exact_rate() -> None:
    """A damped oscillator at every place, in closed form."""
    system = sc.LagrangianSystem.from_text(
        name="damped",
        coordinates=["q[N]"],
        parameters={"c[N]": 1},
        lagrangian=f"{KINETIC} - sum(i in N, q[i]**2/2)",
        dissipation="sum(i in N, c[i]*q_dot[i]**2/2)",
    )
    c = np.array([0.1, 0.5, 1.5])
    run = sc.compile_stepper(system, "svi:5").integrate(np.ones(3), h=0.2, steps=50, parameters={"c": c})
    w = np.sqrt(1 - c**2 / 4)
    exact = np.exp(-5 * c) * (np.cos(10 * w) + c / (2 * w) * np.sin(10 * w))
    assert run.q["q"][-1] == pytest.approx(exact, abs=1e-12)


def test_uniform_damping_has_the_exact_rate() -> None:
    """Damped oscillators of mass 2, in closed form; for a Hamiltonian it requires known sizes."""
    system = sc.LagrangianSystem.from_text(
        name="damped", coordinates=["q[N]"], lagrangian="sum(i in N, q_dot[i]**2 - q[i]**2)", damping=0.4
    )
    stepper = sc.compile_stepper(system, "svi:5")
    assert "not symplectic" in stepper.source.header
    run = stepper.integrate(np.ones(3), h=0.2, steps=50)
    w = np.sqrt(1 - 0.2**2)
    exact = np.exp(-2.0) * (np.cos(10 * w) + 0.2 / w * np.sin(10 * w))
    assert run.q["q"][-1] == pytest.approx(exact, abs=1e-12)
    with pytest.raises(sc.MethodError, match="does not support velocity-dependent forces"):
        sc.compile_stepper(system, "stoermer-verlet")
    other = sc.HamiltonianSystem.from_text(
        name="damped", coordinates=["q[N]"], hamiltonian="sum(i in N, p_q[i]**2 + q[i]**2)", damping=0.4
    )
    start = np.array([1.0, 2.0, 3.0])
    run = sc.compile_stepper(other, "svi:5").integrate(start, h=0.2, steps=50)  # compiled with these sizes
    w = np.sqrt(4 - 0.2**2)
    exact = np.exp(-2.0) * (np.cos(10 * w) + 0.2 / w * np.sin(10 * w))
    assert run.q["q"][-1] == pytest.approx(start * exact, abs=1e-9)


def test_table_with_one_axis() -> None:
    """Springs at some places only."""
    pinned = sc.LagrangianSystem.from_text(
        name="pinned", coordinates=["q[N]"], tables=["pins[P]"], lagrangian=f"{KINETIC} - sum(p in P, q[pins[p]]**2/2)"
    )
    run = sc.compile_stepper(pinned, "svi:6").integrate(np.ones(4), h=0.1, steps=10, tables={"pins": [1, 3]})
    assert run.q["q"][-1] == pytest.approx([1, np.cos(1), 1, np.cos(1)], abs=1e-12)
    written = str(sc.unroll_sums(pinned, {"N": 2, "P": 1}, tables={"pins": [1]}).formula)
    assert "q_1**2" in written
    assert "q_0**2" not in written


def test_error_estimate_of_a_step_from_rest_at_the_origin() -> None:
    """Where nothing but a drive moves anything, it is a part of where that leads; it is held against the coefficient
    below the highest, which is far too much for so short a step."""
    driven = sc.LagrangianSystem.from_text(
        name="driven", coordinates=["q[N]"], lagrangian=f"{KINETIC} - sum(i in N, q[i]**2/2)", forces={"q[0]": "cos(t)"}
    )
    run = sc.compile_stepper(driven, "svi:4").start(np.zeros(3), h=0.2)
    run.advance(1)
    error = abs(run.q["q"][0] - 0.1 * np.sin(0.2)) / 0.02
    assert 0.1 * error < run.step_error < 1e5 * error
