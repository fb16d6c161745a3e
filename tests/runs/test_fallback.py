"""Newton's iteration from a fallback library equals a built-in one and is compiled on demand."""

from functools import cache

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS

pytestmark = [pytest.mark.usefixtures("as_users_compile"), pytest.mark.rotated]

LONG = 0.2
"""A step of the double pendulum at which the fixed-point iteration sometimes fails and Newton's iteration converges."""

each_method = pytest.mark.parametrize(
    "method",
    [
        sc.SVI(4),
        *(pytest.param(each, marks=pytest.mark.full) for each in (sc.Gauss(3), sc.SCVI(2), sc.SpectralCollocation(2))),
    ],
    ids=lambda method: method.name,
)


@cache
def both(method):
    """Return a stepper with a fallback library and one with a built-in iteration."""
    chosen = sc.problem("double-pendulum")
    source, interface = sc.generate_source(chosen.system, method)
    return sc.compile_stepper(chosen.system, method, flags=PORTABLE_FLAGS), sc.Stepper(
        source, interface, flags=PORTABLE_FLAGS
    )


@pytest.fixture
def start():
    chosen = sc.problem("double-pendulum")
    return np.array(chosen.q), 0.3 * np.array(chosen.q)


def outcome(stepper, start, h, **more):
    """Every number of a run, as far as it goes."""
    try:
        run, status = stepper.integrate(*start, h=h, steps=60, **more), ""
    except sc.StepFailedError as error:
        run, status = error.trajectory, f"{error.status} {error.t} {error.residual}"
    events = [(found.t.tolist(), found.q.tolist()) for found in run.events] if more else []
    return [*(x.tolist() for x in (run.t, run.q, run.p, run.iterations)), status, events]


@pytest.mark.sampled(2)
@pytest.mark.filterwarnings("ignore::scvi_codegen.AccuracyWarning")
@each_method
@pytest.mark.parametrize("h", [0.02, LONG, 0.3])
@pytest.mark.parametrize("events", [{}, {"events": "sin(theta1)"}], ids=["plain", "events"])
def test_fallback_library_gives_equal_bits(method, h, events, start):
    borrowing, owning = both(method)
    assert outcome(borrowing, start, h, **events) == outcome(owning, start, h, **events)


def test_newton_iteration_is_compiled_on_demand(start, monkeypatch):
    built = []
    load = building.load
    monkeypatch.setattr(building, "load", lambda source, **flags: built.append(source.prefix) or load(source, **flags))
    stepper = sc.compile_stepper(sc.problem("double-pendulum").system, sc.SVI(5), prefix="late", flags=PORTABLE_FLAGS)
    stepper.integrate(*start, h=0.02, steps=100)
    assert built == ["late"]
    assert "quadrature_derivatives(" not in stepper.source.code
    with pytest.raises(sc.StepFailedError):
        stepper.step(*start, 40.0)
    assert built == ["late"] * 2
    with pytest.raises(sc.StepFailedError):
        stepper.step(*start, 40.0)
    assert built == ["late"] * 2


def test_prepare_compiles_everything_later_calls_need(tmp_path, monkeypatch):
    monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(tmp_path))
    swing, flags = sc.problem("planar-pendulum").system, ("-O0",)
    stepper, state = sc.compile_stepper(swing, "svi:2", flags=flags), ([1.0], [0.0])
    lattice = lagrange("chain", "q[N]", "sum(a in N, q_dot[a]**2/2 - q[a]**2/2)")
    chain = sc.compile_stepper(lattice, "svi:2", flags=flags)
    stepper.prepare(tangent=True, second=True, ensemble=True, events=["q", "q_dot"])
    chain.prepare()
    sc.compile_stepper(sc.problem("kepler").system, "stoermer-verlet", flags=flags).prepare()  # nothing to borrow
    built: list[str] = []
    monkeypatch.setattr(building, "_publish", lambda *given: built.append(given[0].prefix))
    for events in (None, ["q", "q_dot"]):
        stepper.integrate(*state, h=0.1, steps=3, events=events)
        stepper.integrate(*state, t_end=0.3, tolerance=1e-6, events=events)
    stepper.binding.set_fallback()
    stepper.jacobian(*state, h=0.1)
    assert stepper._second_derivatives
    stepper.integrate_ensemble([[1.0], [0.5]], [[0.0], [0.0]], h=0.1, steps=3)
    chain.integrate([1.0, 0.5], [0.0, 0.0], h=0.1, steps=3)
    chain.integrate([1.0, 0.5], [0.0, 0.0], t_end=0.3, tolerance=1e-6)
    assert built == []


STIFF = {"lagrangian": "q_dot**2/2 - k*(1 - cos(q))", "coordinates": ["q"], "parameters": {"k": 1.0}}
ROD = {"lagrangian": "(x_dot**2 + y_dot**2)/2 - g*y", "coordinates": ["x", "y"], "parameters": {"g": 9.81}}


@pytest.mark.filterwarnings("ignore::scvi_codegen.AccuracyWarning")
@pytest.mark.parametrize(
    ("text", "q", "h", "values"),
    [
        (STIFF, [0.3], 0.7, {"k": np.array([10.0, 30.0, 40.0])}),
        (ROD | {"constraints": ["x**2 + y**2 - 1"]}, [1.0, 0.0], 0.4, {"g": np.array([2.0, 10.5, 10.5])}),
    ],
    ids=["spring", "rod"],
)
def test_steps_by_newtons_method_are_counted(text, q, h, values):
    """A run has as many as an ensemble's trajectory and its own parts; adaptive steps are shortened instead."""
    system = sc.LagrangianSystem.from_text(name="stiff", **text)
    stepper = sc.compile_stepper(system, "svi:4", flags=PORTABLE_FLAGS)
    q, p, counts = np.array(q), np.zeros(len(q)), []
    ((name, each),) = values.items()
    for value in each.tolist():
        settings = {"h": h, "parameters": {name: value}}
        whole = stepper.integrate(q, p, **settings, steps=60)
        part = stepper.start(q, p, **settings)
        part.advance(23)
        part = stepper.from_checkpoint(part.checkpoint())
        part.advance(37)
        assert part.fallback_steps == whole.fallback_steps
        assert np.array_equal(part.q, whole.q[-1])
        counts.append(whole.fallback_steps)
        assert stepper.integrate(q, p, parameters={name: value}, t_end=5.0).fallback_steps == 0
    assert counts[0] == 0 < min(counts[1:])
    assert max(counts) <= 60
    start = np.tile([q, p], (3, 1, 1)).swapaxes(0, 1)
    runs = stepper.integrate_ensemble(*start, h=h, steps=60, parameters=values)
    assert runs.fallback_steps.tolist() == [runs[j].fallback_steps for j in range(3)] == counts


def test_iteration_that_fails_is_tried_again_after_growing_numbers_of_steps():
    """A try takes 10 iterations or more; the iteration takes over again where the equations are no longer stiff."""
    system = sc.LagrangianSystem.from_text(name="stiff", **STIFF)
    ours, newton = (
        sc.compile_stepper(system, "svi:4", solver=each, flags=PORTABLE_FLAGS) for each in ("auto", "newton")
    )
    stiff = {"h": 0.7, "parameters": {"k": 40.0}}
    run, other = (each.integrate([0.3], [0.0], **stiff, steps=200) for each in (ours, newton))
    assert run.fallback_steps == 200
    assert np.flatnonzero(run.iterations[1:] >= 15).tolist() == [0, 1, 3, 7, 15, 31, 63, 127, 191]
    assert np.abs(run.q - other.q).max() < 1e-12
    after = ours.start([0.3], [0.0], **stiff)
    after.advance(20)
    after.update(parameters={"k": 10.0})
    after.advance(11)
    assert after.fallback_steps == 31
    after.advance(30)
    assert after.fallback_steps == 31
    after.update(parameters={"k": 40.0})
    after.advance(4)
    assert after.fallback_steps == 35
