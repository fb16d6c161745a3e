"""Extreme numbers: a compiled stepper is accurate to round-off or reports a failure."""

import warnings
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from random import Random
from typing import Any

import numpy as np
import pytest
from fuzzing import guarded
from mpmath import mp, mpc
from samples import QUICK_FLAGS, stepper_for

import scvi_codegen as sc
from scvi_codegen.runs.stepping.saving import sealed, unsealed

Q, P = np.array([1.0, 0.25]), np.array([0.0, 1.0])
REFUSED = (sc.StateError, sc.StepFailedError)


def prepared(stepper: sc.Stepper) -> sc.Stepper:
    """Compile in advance all code that is compiled on demand."""
    stepper.prepare()
    return stepper


@pytest.fixture(scope="module")
def kepler() -> sc.Stepper:
    return prepared(stepper_for("kepler", sc.SVI(3)))


# Layouts, types and shapes.

CLEAN: dict[str, Callable[[np.ndarray], Any]] = {
    "list": list,
    "tuple of numpy numbers": tuple,
    "float32": lambda x: x.astype(np.float32),
    "float16": lambda x: x.astype(np.float16),
    "long double": lambda x: x.astype(np.longdouble),
    "big-endian": lambda x: x.astype(">f8"),
    "big-endian float32": lambda x: x.astype(">f4"),
    "strided": lambda x: np.repeat(x, 3)[::3],
    "reversed": lambda x: np.ascontiguousarray(x[::-1])[::-1],
    "column": lambda x: np.column_stack([x + 1, x, x + 2])[:, 1],
    "broadcast view": lambda x: np.broadcast_to(x, (3, len(x)))[1],
    "unaligned": lambda x: np.frombuffer(b"\0" + x.tobytes(), dtype=np.uint8)[1:].view(np.float64),
    "objects": lambda x: np.array([Fraction(value) for value in x.tolist()], dtype=object),
    "read-only": lambda x: _read_only(x),
    "nothing masked": lambda x: np.ma.array(x, mask=False),
    "memory": memoryview,
}
"""The same numbers in other clothes."""


def _read_only(x: np.ndarray) -> np.ndarray:
    copy = x.copy()
    copy.flags.writeable = False
    return copy


WRONG: dict[str, Callable[[np.ndarray], Any]] = {
    "masked": lambda x: np.ma.array(x, mask=[True, *[False] * (len(x) - 1)]),
    "complex": lambda x: x + 0j,
    "complex objects": lambda x: [1j, *x[1:]],
    "text": lambda x: x.astype(str),
    "bytes": lambda x: x.tobytes(),
    "dates": lambda x: x.astype("M8[s]"),
    "spans of time": lambda x: x.astype("m8[s]"),
    "truth values": lambda x: x > 0,
    "records": lambda x: np.zeros(len(x), dtype=[("a", "f8"), ("b", "i4")]),
    "None": lambda x: None,
    "a hole": lambda x: [None, *x[1:]],
    "nan": lambda x: [np.nan, *x[1:]],
    "nan in an array": lambda x: np.array([*x[:-1], np.nan]),
    "infinity": lambda x: [*x[:-1], -np.inf],
    "beyond double": lambda x: [10**400, *x[1:]],
    "beyond double, as long double": lambda x: x.astype(np.longdouble) * np.longdouble("1e4000"),
    "ragged": lambda x: [[1.0], list(x[1:]) * 3],
    "short": lambda x: x[:-1],
    "long": lambda x: [*x, 0.0],
    "deep": lambda x: x[:, None],
    "a matrix": np.asmatrix,
    "empty": lambda x: [],
    "a number": lambda x: 1.0,
    "a dictionary": lambda x: dict(enumerate(x)),
    "a generator": lambda x: (value for value in x),
}


CALLS: dict[str, Callable[..., Any]] = {
    "step": lambda stepper, q, p: np.hstack(stepper.step(q, p, 0.125)),
    "integrate": lambda stepper, q, p: stepper.integrate(q, p, h=0.125, steps=3).q,
    "energy": lambda stepper, q, p: np.array(stepper.energy(q, p)),
}
"""Functions of a state."""


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning", "ignore:the matrix subclass")
@pytest.mark.parametrize("name", CALLS)
def test_states_in_any_container_are_accepted_and_others_rejected(name, kepler):
    call = partial(CALLS[name], kepler)
    expected = call(Q, P)
    for dress in CLEAN.values():
        assert np.array_equal(call(dress(Q), P), expected)
        assert np.array_equal(call(Q, dress(P)), expected)
    for what, spoil in WRONG.items():
        for q, p in ((spoil(Q), P), (Q, spoil(P))):
            with pytest.raises(sc.StateError), guarded():
                pytest.fail(f"{what} gave {call(q, p)}")


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning", "ignore:the matrix subclass")
def test_ensembles_in_any_container_are_accepted_and_others_rejected(kepler):
    def final(q: Any, p: Any) -> np.ndarray:
        return kepler.integrate_ensemble(q, p, h=0.125, steps=3, threads=1).q[-1]

    q, p = np.array([Q, 2 * Q, 3 * Q]), np.array([P, P, P])
    expected = final(q, p)
    for dress in (np.asfortranarray, lambda x: np.repeat(x, 2, axis=1)[:, ::2], lambda x: x.astype(">f8"), list):
        assert np.array_equal(final(dress(q), p), expected)
    for what in set(WRONG) - {"short", "a number", "a matrix", "beyond double, as long double", "deep", "bytes"}:
        with pytest.raises(REFUSED):
            pytest.fail(f"{what} gave {final([WRONG[what](row) for row in q], p)}")
    masked = np.ma.array(q, mask=q > 2)
    with pytest.raises(sc.StateError, match="masked"):
        final(masked, p)


@pytest.mark.parametrize("method", [sc.SVI(3), sc.StoermerVerlet()], ids=lambda method: method.name)
def test_damaged_bytes_of_a_run_are_rejected_or_bounded(method):
    """Behind a right checksum."""
    stepper = prepared(stepper_for("kepler", method))
    run = stepper.start(Q, P, h=0.1)
    run.record(3)
    memory, random = len(run.snapshot), Random(5)
    before, saved = (whole := unsealed(run.checkpoint()))[:-memory], whole[-memory:]
    for byte in (b"\0", b"\xff", b"\x7f"):
        with pytest.raises(sc.StateError, match=r"invalid saved run|the saved run has adaptive steps"):
            stepper.from_checkpoint(sealed(before + byte * len(saved)))
    for _ in range(300):
        damaged = bytearray(saved)
        for _ in range(random.choice((1, 1, 8))):
            damaged[random.randrange(len(damaged))] = random.randrange(256)
        with guarded():
            try:
                states = stepper.from_checkpoint(sealed(before + damaged)).record(3)
            except REFUSED:
                continue
        assert np.isfinite(states.q).all()


# Magnitudes.

SIZES = [
    0.0, 5e-324, 1e-310, 2.3e-308, 1e-200, 1e-16, 1e-3, 0.7, 1.0, 3.0, 40.0, 1e8, 1e100, 1e154, 1e155, 1e300,
    1.7e308,
]  # fmt: skip


def oscillator(kind: str) -> sc.LagrangianSystem | sc.HamiltonianSystem:
    if kind == "hamiltonian":
        return sc.HamiltonianSystem.from_text(name="o", coordinates=["q"], hamiltonian="p_q**2/2 + q**2/2")
    return sc.LagrangianSystem.from_text(name="o", coordinates=["q"], lagrangian="q_dot**2/2 - q**2/2")


def exact_step(q: float, p: float, h: float, steps: int) -> complex:
    """q + i p after steps of the two-stage Gauss method, the Pade approximant (2, 2) of the exponential function."""
    with mp.workdps(700):
        z = -1j * mp.mpf(h)
        factor = (1 + z / 2 + z**2 / 12) / (1 - z / 2 + z**2 / 12)
        return complex(mpc(q, p) * factor**steps)


def rounding(q: float, p: float, h: float) -> float:
    """Return the round-off level of the solver, of |q| + h|v| and |p| + h|L_q| as in the header, and underflow."""
    return 5e-13 * ((float(abs(q)) + float(abs(p))) * (1.0 + abs(h))) + 1e-319 * (1.0 + abs(h)) ** 2


def check_oscillator(stepper: sc.Stepper, random: Random) -> bool:
    """Return whether a run from a random state was completed; check its end."""
    q, p = (
        random.choice((-1, 1)) * random.choice(SIZES) * random.choice((1.0, random.uniform(0.5, 1.0))) for _ in "qp"
    )
    h = random.choice((-1, 1)) * random.choice(SIZES[1:]) * random.choice((1.0, random.uniform(0.5, 1.0)))
    if h == 0.0:
        return False
    steps = random.choice((1, 1, 5))
    with guarded(), warnings.catch_warnings(action="error"):
        warnings.simplefilter("ignore", sc.AccuracyWarning)
        try:
            if steps == 1:
                found = complex(*(x[0] for x in stepper.step([q], [p], h)))
            else:
                run = stepper.integrate([q], [p], h=h, steps=steps)
                found = complex(run.q[-1, 0], run.p[-1, 0])
        except REFUSED:
            return False
    expected = exact_step(q, p, h, steps)
    allowed = steps * rounding(q, p, h)
    assert abs(found - expected) <= allowed, (q, p, h, steps, found, expected)
    return True


@pytest.mark.rotated
@pytest.mark.sampled(3)
@pytest.mark.parametrize("solver", ["auto", "newton", "fixed-point"])
@pytest.mark.parametrize("kind", ["lagrangian", "hamiltonian"])
def test_oscillator_of_any_size_with_any_step_is_correct_or_rejected(kind, solver, request):
    """SVI(2) with two Gauss points is the two-stage Gauss method, and on the oscillator a rational function of h."""
    stepper = prepared(sc.compile_stepper(oscillator(kind), sc.SVI(2), solver=solver, flags=QUICK_FLAGS))
    random = Random(11)
    done = sum(check_oscillator(stepper, random) for _ in range(400))
    assert done > 100


NONLINEAR = [
    ("kepler", sc.SVI(3)),
    ("double-pendulum", sc.SCVI(2)),
    ("planar-pendulum", sc.Gauss(2)),
    ("charged-particle", sc.SpectralCollocation(2, form="position")),
    ("cart-pole", sc.SVI(2)),
    ("kepler", sc.StoermerVerlet()),
]


def check_nonlinear(name: str, method: Any, random: Random) -> bool:
    """Return whether both solvers took a step; check that the steps agree if h is reasonable."""
    steppers = [prepared(stepper_for(name, method, solver=solver)) for solver in ("auto", "newton")]
    q, p = (
        [random.choice((-1, 1)) * random.choice(SIZES) * random.uniform(0.5, 1.0) for _ in range(steppers[0].dimension)]
        for _ in "qp"
    )
    h = random.choice((-1, 1)) * random.choice(SIZES[1:])
    found = []
    for stepper in steppers:
        with guarded(), warnings.catch_warnings(action="error"):
            warnings.simplefilter("ignore", sc.AccuracyWarning)
            try:
                found.append(np.hstack(stepper.step(q, p, h)))
            except REFUSED:
                continue
        assert np.isfinite(found[-1]).all()
    sizes = np.abs([*q, *p])
    if len(found) == 2 and abs(h) < 0.01 and sizes.min() > 0.3 and sizes.max() < 5.0:
        np.testing.assert_allclose(found[0], found[1], rtol=1e-11, atol=1e-11)
    return len(found) == 2


@pytest.mark.tiers(1, 1)
@pytest.mark.sampled(3)
@pytest.mark.parametrize(("name", "method"), NONLINEAR, ids=lambda value: str(getattr(value, "name", value)))
def test_any_state_gives_a_finite_step_or_is_rejected(name, method):
    random = Random(7)
    assert sum(check_nonlinear(name, method, random) for _ in range(300)) > 10


@pytest.mark.full
def test_any_state_full_sample():
    for kind in ("lagrangian", "hamiltonian"):
        for solver in ("auto", "newton", "fixed-point"):
            stepper = prepared(sc.compile_stepper(oscillator(kind), sc.SVI(2), solver=solver, flags=QUICK_FLAGS))
            random = Random(1)
            assert sum(check_oscillator(stepper, random) for _ in range(20_000)) > 5_000
    for name, method in NONLINEAR:
        random = Random(2)
        assert sum(check_nonlinear(name, method, random) for _ in range(20_000)) > 500
