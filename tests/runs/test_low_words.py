"""Low words of compensated sums, compared in exact arithmetic: high plus low word, not statistics.

Bodies whose forces depend on differences keep their momentum, and their centre of mass moves on a line, by every method
here: with fractions of the high and the low words both are known exactly. Increments err by roundings of their own
size, a thousandth of a rounding of the state at these steps; a low word that is dropped, added twice or with the other
sign shows as a rounding of the state.
"""

import re
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from notation import hamilton, lagrange
from oracle import collocation_tableau, points
from samples import QUICK_FLAGS

import scvi_codegen as sc

MASSES = (2.0, 1.0, 0.5)
Q, P = np.array([0.7, 0.9, 1.3]), np.array([1.9, -0.8, 0.7])
LOW = np.array([0.4, -0.3, 0.2])
"""Of a rounding, what the first state has as low words."""
H, STEPS = 2.0**-11, 500
L = "x_dot**2 + y_dot**2/2 + z_dot**2/4 - (x - y)**2 - (y - z)**4/4 + cos(z - x + t)/3"
COORDINATES = ["x", "y", "z"]


def bodies() -> sc.LagrangianSystem:
    return sc.LagrangianSystem.from_text(name="bodies", coordinates=COORDINATES, lagrangian=L)


def coupled() -> sc.LagrangianSystem:
    """The mass matrix depends on differences."""
    text = L + " + (x_dot - y_dot)**2*sin(x - z)**2/8"
    return sc.LagrangianSystem.from_text(name="coupled", coordinates=COORDINATES, lagrangian=text)


def hamiltonian() -> sc.HamiltonianSystem:
    text = "p**2/4 + r**2/2 + s**2 + (x - y)**2 + (y - z)**4/4 - cos(z - x + t)/3"
    return hamilton("bodies", COORDINATES, text, momenta="p r s")


def coupled_hamiltonian() -> sc.HamiltonianSystem:
    """Velocities depend on several momenta; their coupling does not move the centre of mass."""
    text = "p**2/4 + r**2/2 + s**2 + (p/2 - r)**4/6 + (x - y)**2 + (y - z)**4/4 - cos(z - x + t)/3"
    return hamilton("coupled momenta", COORDINATES, text, momenta="p r s")


def rod() -> sc.LagrangianSystem:
    """Two bodies on a rod, and a third: the lengths along x alone are compared."""
    text = "x_dot**2 + y_dot**2/2 + z_dot**2/4 + w_dot**2/2 - (y - z)**4/4 + cos(z - x + t)/3"
    return lagrange("rod", "x y z w", text, constraints=["(x - y)**2 + w**2 = 1"])


def array() -> sc.LagrangianSystem:
    text = "sum(i in N, m[i]*q_dot[i]**2/2) - sum(i in 0..N-2, (q[i+1] - q[i])**2 + (q[i+1] - q[i])**4/4)"
    return lagrange("bodies of an array", "q[N]", text, parameters={"m[N]": 1.0})


RATTLE = {"method": "svi", "degree": 1, "quadrature": "gauss-lobatto:2"}
CASES: dict[str, tuple[Any, Any, str]] = {
    "svi": (bodies, "svi:3", "fixed-point"),
    "svi by Newton": (bodies, "svi:3", "newton"),
    "svi, coupled": (coupled, "svi:3", "fixed-point"),
    "svi, coupled, by Newton": (coupled, "svi:3", "newton"),
    "gauss": (bodies, "gauss:3", "fixed-point"),
    "gauss of a Hamiltonian": (hamiltonian, "gauss:3", "fixed-point"),
    "composition": (bodies, {"method": "composition", "order": 8}, "auto"),
    "composition of a Hamiltonian": (coupled_hamiltonian, {"method": "composition", "order": 8}, "auto"),
    "leapfrog": (bodies, "stoermer-verlet", "explicit"),
    "rattle": (rod, RATTLE, "auto"),
    "lobatto": (rod, {"method": "svi", "degree": 3, "quadrature": "gauss-lobatto:4"}, "auto"),
    "array": (array, "svi:3", "fixed-point"),
    "array by Newton": (array, "svi:3", "newton"),
    "composition of an array": (array, {"method": "composition", "order": 8}, "fixed-point"),
}
ARRAYS = [name for name, (system, *_) in CASES.items() if system is array]


def compiled(name: str) -> Any:
    system, method, solver = CASES[name]
    method = sc.methods.method_from_specification(method) if isinstance(method, dict) else method
    make = sc.compile_stepper
    return make(system(), method, solver=solver, flags=QUICK_FLAGS)


def exact(*values: Any) -> Fraction:
    return sum((Fraction(float(x)) for x in values), Fraction(0))


class Begun:
    """A run with low words, and what is known of it exactly."""

    def __init__(self, name: str, stepper: Any = None) -> None:
        self.array, self.stepper = name in ARRAYS, stepper or compiled(name)
        system = CASES[name][0]
        self.q, self.p, self.masses = Q, P, MASSES
        if system is rod:  # at rest beside each other along y, where w is 0
            self.q, self.p = np.array([0.25, 1.25, 2.0, 0.0]), np.array([1.9, 0.95, -0.7, 0.4])
            self.masses = (*MASSES, 0.0)
        extra = {"parameters": {"m": np.array(MASSES)}} if self.array else {}
        self.run = self.stepper.start(self.q, self.p, h=H, t=1 / 3, **extra)
        low_q, low_p = (np.spacing(x[:3]) * LOW for x in (self.q, self.p))
        carries = self.words()[2:]
        carries[0][:3], carries[1][:3] = low_q, low_p
        if not self.array:
            self.run._resume_at(0, (self.run.t, 0.0), carries)

    def words(self) -> tuple[Any, ...]:
        """q, p and their low words; of an array those of the run itself."""
        if self.array:
            vector, memory = self.run.stepper.binding.vector, self.run._memory
            return tuple(vector(getattr(memory, name)) for name in ("q", "p", "carry_q", "carry_p"))
        return self.run.q, self.run.p, *self.run._compensation

    def time(self) -> Fraction:
        memory = self.run._memory
        return exact(memory.t, memory.t_low)

    def invariants(self) -> tuple[Fraction, Fraction]:
        """The momentum, and the sum of masses times positions."""
        q, p, low_q, low_p = self.words()
        momentum = sum((exact(a, b) for a, b, m in zip(p, low_p, self.masses, strict=True) if m), Fraction(0))
        places = sum((Fraction(m) * exact(a, b) for a, b, m in zip(q, low_q, self.masses, strict=True)), Fraction(0))
        return momentum, places

    def off(self, start: tuple[Fraction, Fraction, Fraction]) -> tuple[float, float]:
        """Return the deviations of the momentum and of the centre of mass."""
        momentum, places = self.invariants()
        t, first, begun = start
        return float(momentum - first), float(places - begun - first * (self.time() - t))


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(6)
@pytest.mark.parametrize("name", CASES)
def test_sums_of_high_and_low_words_are_exact(name: str) -> None:
    own = Begun(name)
    start = (own.time(), *own.invariants())
    assert start[1] != exact(*own.p[:3])
    worst = np.zeros(2)
    for part in range(5):
        own.run.advance(STEPS // 5)
        worst = np.maximum(worst, np.abs(own.off(start)))
        if part == 2:  # and as bytes, from there on
            saved = own.run.checkpoint()
            own.run = own.stepper.from_checkpoint(saved)
    assert own.time() == Fraction(1 / 3) + STEPS * Fraction(H)
    assert worst[0] < (1e-16 if name == "composition of a Hamiltonian" else 1e-17)  # roundings of forces of 17 stages
    assert worst[1] < (1e-16 if "composition" in name else 1e-17)  # whose coefficients have 53 bits


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("name", ["svi", "gauss of a Hamiltonian", "svi, coupled"])
def test_ensemble_states_are_within_a_rounding_of_exact_sums(name: str) -> None:
    """Low words keep what sums leave: high words alone are off by no more than half a rounding each, however long."""
    steps, members = 1024, 5
    shift = np.arange(members)[:, None] / 16
    begun = Q + shift, P - shift / 4
    ends = compiled(name).integrate_ensemble(*begun, t=1 / 3, h=H, steps=steps, save_every=64)
    most_p = float(np.spacing(np.abs(ends.p)).max(axis=0).sum(axis=1).max()) / 2
    most_q = float((np.spacing(np.abs(ends.q)).max(axis=0) * MASSES).sum(axis=1).max()) / 2
    for j in range(members):
        first, begun_at = exact(*begun[1][j]), exact(*(begun[0][j] * MASSES))
        for k, (q, p) in enumerate(zip(ends.q[:, j], ends.p[:, j], strict=True)):
            assert abs(exact(*p) - first) <= most_p * 1.01
            assert abs(exact(*(q * MASSES)) - begun_at - first * 64 * k * Fraction(H)) <= most_q * 1.01


def tables(code: str) -> dict[str, list[float]]:
    """Numbers of every table of doubles that a text has."""
    found = re.findall(r"static const (?:lanes|double) (\w+)(?:\[[^=]*\])? = (\{.*?\});", code, re.S)
    return {name: [float(x) for x in re.findall(r"-?\d[\w.+-]*", text)] for name, text in found}


@pytest.mark.rotated
@pytest.mark.parametrize("text", ["svi", "gauss", "ensemble", "array"])
def test_coefficients_and_their_low_words_are_exact(text: str) -> None:
    """For Gauss-Legendre points, compare c, A^2, b A and b of the tableau in 50 digits."""
    stepper = compiled(text if text != "ensemble" else "svi")
    code = stepper.ensemble.code if text == "ensemble" else stepper.source.code
    found, own = tables(code), collocation_tableau(points("gauss", 3))
    A, b, c = own["A"], own["b"], own["c"]
    square = A @ A
    wanted = {"DRIFT": c, "PRODUCT": square, "POINT_END_POSITION": b @ A, "POINT_END_MOMENTUM": b}
    for name, exactly in wanted.items():
        high, low = found[name], found[f"{name}_LOW"]
        if text != "ensemble" and name == "PRODUCT":  # by columns, with a lane that is not used
            exactly = exactly.T
        numbers = [x for row in np.reshape(exactly, (-1, 3)) for x in row]
        width = 3 if text == "ensemble" else 4
        pairs = list(zip(high, low, strict=True))
        words = [pair for k in range(0, len(high), width) for pair in pairs[k : k + width][:3]][: len(numbers)]
        for (one, two), x in zip(words, numbers, strict=True):
            assert one == float(x), name
            assert abs(Fraction(two) + Fraction(one) - Fraction(str(x))) <= Fraction(abs(two)) / 2**52, name


BY_DESIGN = ("Newton", "rattle", "lobatto", "composition of an array")
"""Forces at the start of their steps are those of the high word: an error like a rounding of the increment."""


@pytest.mark.rotated
@pytest.mark.parametrize("name", [name for name in CASES if not any(each in name for each in BY_DESIGN)])
def test_low_words_enter_everywhere_the_state_does(name: str) -> None:
    """A thousandth of the state as its low word, or in its high word: a step has the same forces and velocities."""
    ends = []
    for whole in (False, True):
        own = Begun(name)
        long = [np.cos(np.arange(len(x)) + k) / 1024 for k, x in enumerate((own.q, own.p))]  # of q others than of p
        q, p = (x + part if whole else x for x, part in zip((own.q, own.p), long, strict=True))
        extra = {"parameters": {"m": np.array(MASSES)}} if own.array else {}
        own.run = own.stepper.start(q, p, h=1 / 16, **extra)
        if own.array:
            for saved_states, part in zip(own.words()[2:], long, strict=True):
                saved_states[:] = 0.0 if whole else part
        elif not whole:
            own.run._resume_at(0, (0.0, 0.0), tuple(long))
        own.run.advance(1)
        q, p, low_q, low_p = own.words()
        ends.append(np.concatenate([q + low_q, p + low_p]))
    assert np.abs(ends[1] - ends[0]).max() < 2e-6  # the last iteration and its remainder take the low words in


def test_adaptive_steps_of_loose_tolerance_omit_low_words() -> None:
    """Their iteration takes as many steps of the same sizes, whose states differ by rounding errors."""
    kepler = sc.compile_stepper(sc.problem("kepler").system, "svi:8", flags=QUICK_FLAGS)
    exact, rough = (
        kepler.integrate(
            [0.4, 0.0], [0.0, 2.0], t_end=20.0, tolerance=1e-9, options=sc.SolverOptions(tolerance=tolerance)
        )
        for tolerance in (0.99e-12, 1.01e-12)
    )
    assert (exact.t == rough.t).all()
    apart = np.abs(rough.q - exact.q).max()
    assert 0.0 < apart < 1e-10  # the former extrapolate the remainder of the iteration
    assert np.ptp(rough.energy()) < 1.5 * np.ptp(exact.energy())
