"""Double-double arithmetic: elementary functions and steps against mpmath, ensembles."""

import ctypes
import json
import operator
import pickle
import subprocess
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from mpmath import mp
from notation import lagrange
from oracle import stepper_of
from samples import GENERIC, sample_named

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import TUNED_FLAGS
from scvi_codegen.codegen.rendering.kernels.double_double import arithmetic_headers
from scvi_codegen.codegen.rendering.kernels.printer import IN_PAIRS
from scvi_codegen.common.errors import MethodError, StateError
from scvi_codegen.runs.states.words import as_mpmath, product_of, quotient_of, split, sum_of, two_words, with_low

KEPLER = "m*(x_dot**2 + y_dot**2)/2 + mu/sqrt(x**2 + y**2)"
ROOTS = ("sqrt", "inverse_root_1", "inverse_root_3", "inverse_root_5", "inverse_root_7")
RANGES = {
    **dict.fromkeys(ROOTS, (1e-5, 1e5)),
    **dict.fromkeys(("asinh", "atan", "divide", "multiply", "square"), (1e-9, 1e9)),
    **dict.fromkeys(("asin", "acos", "atanh"), (1e-9, 0.999)),
    **dict.fromkeys(("sin", "cos", "tan"), (1e-9, 1e4)),
    **dict.fromkeys(("sinh", "cosh", "exp"), (1e-9, 600.0)),
    "tanh": (1e-9, 40.0),
    "acosh": (1.0001, 1e9),
    "atan2": (1e-9, 1e9),
    "pow": (0.1, 10.0),
    "log": (1e-250, 1e250),
}
"""Magnitudes of random arguments; of both signs where the function is defined there."""
POSITIVE = (*ROOTS, "acosh", "pow", "log")
OF_TWO = {"divide": operator.truediv, "multiply": operator.mul}
MANY = 1_000_000 if find_spec("flint") else 10_000  # mpmath takes a hundred times as long


def compiled_functions(folder: Path) -> ctypes.CDLL:
    """Return a library of ``number_f`` and ``vector_f`` of arrays of high words, then low words."""
    support, headers = Path(sc.__file__).parent.parent / "templates" / "support", arithmetic_headers()
    if not support.is_dir():
        pytest.skip("needs the templates of a checkout")

    def text(name: str) -> str:
        return headers.get(f"support/{name}") or (support / name).read_text()

    names = [
        "core/numbers.h",
        "core/vector_width.h",
        "core/vectors.h",
        *(f"double_double/{name}.h" for name in ("words", "number_pairs", "vector_words")),
    ]
    names += [f"double_double/{name}.h" for name in ("vector_pairs", "conversions", "tables_of_functions")]
    names += ["double_double/number_functions.h", "double_double/vector_functions.h"]
    code = "#include <float.h>\n#include <math.h>\n#include <string.h>\n#define POINTS 8\n#define PARAMETERS 1\n"
    code += "\n".join(line for name in names for line in text(name).split("\n") if '#include "' not in line)
    for f in RANGES:
        for kind, pair, step in (("number", "dd", "1"), ("vector", "ddl", "LANES")):
            second = ", b" if f in ("pow", "atan2", "divide", "multiply") else ""
            loads = "".join(
                f"memcpy(&{x}.high, {x}s + i, sizeof {x}.high); memcpy(&{x}.low, {x}s + n + i, sizeof {x}.low);"
                for x in "ab"
            )
            stores = "memcpy(to + i, &r.high, sizeof r.high); memcpy(to + n + i, &r.low, sizeof r.low);"
            code += f"\nvoid {kind}_{f}(int n, const double *as, const double *bs, double *to) {{"
            code += f"for (int i = 0; i < n; i += {step}) {{ {pair} a, b; {loads}"
            code += f"{pair} r = {pair}_{f}(a{second}); {stores} }} }}"
    (folder / "functions.c").write_text(code)
    flags = [*TUNED_FLAGS, "-std=c99", "-shared", "-fPIC"]
    subprocess.run(["cc", *flags, "functions.c", "-o", "functions.so", "-lm"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "functions.so"))


def reference(f: str) -> Callable[[float, float, float, float], Any]:
    """Return the function of (a + a_low, b + b_low) in 200 bits: balls of python-flint or, without it, mpmath."""
    try:
        import flint
    except ImportError:
        context = mpmath.MPContext()
        context.prec, exact = 200, context.mpf
        two = {"pow": context.power, "atan2": context.atan2, **OF_TWO}.get(f)
        one = (lambda x: 1 / context.sqrt(x) ** int(f[-1])) if f in ROOTS[1:] else getattr(context, f, lambda x: x * x)
    else:
        flint.ctx.prec, exact = 200, flint.arb
        two = {"pow": exact.__pow__, "atan2": exact.atan2, **OF_TWO}.get(f)
        one = (lambda x: x.rsqrt() ** int(f[-1])) if f in ROOTS[1:] else getattr(exact, f, lambda x: x * x)
    if two:
        return lambda a, a_low, b, b_low: two(exact(a) + a_low, exact(b) + b_low)
    return lambda a, a_low, b, b_low: one(exact(a) + a_low)


def largest_errors(folder: Path, count: int) -> dict[str, float]:
    """Return the largest relative error of each function, of numbers or lanes, for random arguments."""
    library, rng, worst = compiled_functions(folder), np.random.default_rng(7), {}
    assert {*RANGES} == {*IN_PAIRS, *ROOTS, *OF_TWO, "square"}

    def pairs(low: float, high: float) -> np.ndarray:
        values = np.exp(rng.uniform(np.log(low), np.log(high), count))
        return np.array([values, values * rng.uniform(-1.0, 1.0, count) * 2.0**-54])

    for f, (low, high) in RANGES.items():
        x, y = pairs(low, high), pairs(0.1, 3.0)
        for each in (x, y) if f not in POSITIVE else (y,):
            each *= rng.choice([-1.0, 1.0], count)
        number, lanes = results = [np.empty((2, count)) for _ in range(2)]
        for kind, found in zip(("number", "vector"), results, strict=True):
            pointers = (each.ctypes.data_as(ctypes.c_void_p) for each in (x, y, found))
            getattr(library, f"{kind}_{f}")(count, *pointers)
        exact = reference(f)
        rows = zip(*(words.tolist() for words in (*x, *y, *number)), strict=True)
        errors = np.array([float(exact(*arguments) - value - rest) for *arguments, value, rest in rows])
        others = errors - ((lanes[0] - number[0]) + (lanes[1] - number[1]))
        assert np.isfinite([errors, others]).all()
        worst[f] = float((np.abs([errors, others]) / np.abs(number[0])).max())
    return worst


@pytest.mark.rotated
@pytest.mark.parametrize("count", [1000, pytest.param(MANY, marks=pytest.mark.full)])
def test_functions(count: int, tmp_path: Path) -> None:
    """Every function is accurate to 1e-30 for random arguments of all magnitudes, numbers and lanes."""
    worst = largest_errors(tmp_path, count)
    assert max(worst.values()) <= 1e-30, worst


@pytest.mark.rotated
def test_rounding_errors_have_no_bias(tmp_path: Path) -> None:
    """Mean errors of products and roots vanish, as those of one sign would let the energies of orbits drift."""
    library, rng, count = compiled_functions(tmp_path), np.random.default_rng(3), 10_000
    for f in ("square", "multiply", "divide", "sqrt", "inverse_root_1"):
        exact = reference(f)
        for least in (1.0, 2.0):
            x, y = (np.array([rng.uniform(least, 2 * least, count), rng.uniform(-1, 1, count)]) for _ in range(2))
            for each in (x, y):
                each[1] *= least * 2.0**-53
            found = np.empty((2, count))
            getattr(library, f"number_{f}")(count, *(each.ctypes.data_as(ctypes.c_void_p) for each in (x, y, found)))
            rows = zip(*(words.tolist() for words in (*x, *y, *found)), strict=True)
            errors = np.array([float(exact(*arguments) - value - rest) for *arguments, value, rest in rows]) / found[0]
            assert abs(errors.mean()) < 4 * errors.std() / np.sqrt(count), f


def system(name: str) -> sc.LagrangianSystem:
    texts = {
        "kepler": (["x", "y"], KEPLER, {"m": 1.0, "mu": 1.0}),
        "driven": (["q"], "q_dot**2/2 + cos(q) + q*sin(t)/3", {}),
    }
    coordinates, text, parameters = texts[name]
    return sc.LagrangianSystem.from_text(name=name, coordinates=coordinates, lagrangian=text, parameters=parameters)


METHODS = (
    sc.SVI(4),
    sc.SVI(3, "gauss-lobatto:4"),
    sc.SCVI(3),
    sc.SpectralCollocation(2),
    sc.Gauss(3),
    sc.RadauIIA(2),
    sc.LobattoIIIA(4),
)
FORCED = ("forced-cart-pole", "radial-friction", "damped-pair")
"""Systems with forces or damping, which the oracle lacks."""
CASES = [
    *((name, METHODS[0]) for name in GENERIC if name not in FORCED),
    *(("henon-heiles", method) for method in METHODS[1:]),
]


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("name", "method"), CASES)
def test_step_of_samples(name: str, method: sc.methods.Method) -> None:
    """One step of each sample system that is accepted agrees with the oracle in 60 digits to 2e-30."""
    sample = sample_named(name)
    try:
        stepper = sc.compile_stepper(sample.system, method, precision="double-double")
    except MethodError:
        assert name not in ("harmonic-oscillator", "planar-pendulum", "driven-duffing", "kepler", "three-bodies")
        return
    small = Fraction(1, 3 * 10**17)
    q, v = ([Fraction(x) + small * (k + 1) for k, x in enumerate(each)] for each in GENERIC[name])
    run = stepper.integrate(q, velocity=v, h=0.0625, steps=1, t=0.5)
    with mp.workdps(60):
        step, arguments = stepper_of(method.specification())
        exact = step(sample.mechanics, mp.mpf(0.5), run.mp("q")[0], run.mp("p")[0], mp.mpf(0.0625), **arguments)
        for part, values in zip("qp", exact, strict=True):
            assert max(abs(run.mp(part)[1] - values)) <= 2e-30 * max(map(abs, values)), part


@pytest.mark.rotated
def test_near_zeros(tmp_path: Path) -> None:
    """Near zeros sin, cos and tan of x have the relative error 1e-31 + 1e-47 |x / f(x)|."""
    flint = pytest.importorskip("flint")
    flint.ctx.prec, arb = 400, flint.arb
    library, half = compiled_functions(tmp_path), arb.pi() / 2
    multiples = np.unique(np.exp(np.random.default_rng(3).uniform(0.0, np.log(6e8), 100)).astype(int))
    for least in (0.0, 1.0):  # x is near a zero to one and to two words
        high = np.array([float(half * int(k)) for k in multiples])
        low = np.array([float(half * int(k) - arb(x)) * least for k, x in zip(multiples, high, strict=True)])
        x, found = np.concatenate([high, low]), np.empty(2 * len(high))
        for f in ("sin", "cos", "tan"):
            getattr(library, f"number_{f}")(
                len(high), *(each.ctypes.data_as(ctypes.c_void_p) for each in (x, x, found))
            )
            for a, b, c, d in zip(high, low, *found.reshape(2, -1), strict=True):
                exact, value = getattr(arb(a) + b, f)(), arb(c) + d
                if abs(exact) < 1e3:
                    assert abs(value - exact) <= 1e-31 * abs(exact) + 1e-47 * a


@pytest.mark.rotated
def test_automatic_precision() -> None:
    """With precision="auto" a chaotic run has the error asked for in double-double, a short one in double."""
    bodies = [(f"x{n}", f"y{n}") for n in range(3)]
    pairs = [(bodies[i], bodies[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    kinetic = " + ".join(f"{name}_dot**2/2" for body in bodies for name in body)
    potential = " + ".join(f"1/sqrt(({a} - {c})**2 + ({b} - {d})**2)" for (a, b), (c, d) in pairs)
    three = lagrange("three bodies", [x for body in bodies for x in body], f"{kinetic} + {potential}")
    stepper = sc.compile_stepper(three, "svi:12", precision="auto")
    start = {"q": [-0.5, 0.0, 0.5, 0.0, 0.2, 0.4], "velocity": np.zeros(6), "error": 1e-6}
    short, long = (stepper.integrate(**start, t_end=end) for end in (2.0, 15.0))
    assert [each.confirmation.precision for each in (short, long)] == ["double", "double-double"]
    assert short.confirmation.confirmed
    assert long.confirmation.confirmed
    del start["error"]
    other = sc.compile_stepper(three, "svi:16", precision="double-double").integrate(**start, t_end=15.0)
    assert np.abs(other.q[-1] - long.q[-1]).max() < 1e-6
    double = stepper.integrate(**start, t_end=15.0, check_growth=False)
    assert np.abs(np.asarray(double.q[-1]) - np.asarray(long.q[-1])).max() > 1e-5


def test_numbers() -> None:
    """Floats, text, fractions, mpmath numbers and long doubles become two words; other values are refused by name."""
    with mp.workdps(50):
        third = mp.mpf(1) / 3
        for value in ("1/3", Fraction(1, 3), third):
            high, low = two_words(value, "q")
            assert high == 1 / 3
            assert abs(mp.mpf(high) + mp.mpf(low) - third) < 1e-32
    assert two_words(0.1, "q") == (0.1, 0.0)
    assert two_words(10**17 + 1, "q") == (1e17, 1.0)
    for value in (np.int8(3), np.uint32(3), np.array(3), np.float32(3), Decimal(3), sympy.Integer(3)):
        assert two_words(value, "q") == (3.0, 0.0)
    assert two_words(np.int64(10**17 + 1), "q") == (1e17, 1.0)
    assert (split(np.array([1, 10**17 + 1]), "q")[1] == [0.0, 1.0]).all()
    assert two_words(sympy.pi, "q") == (np.pi, 1.2246467991473532e-16)
    assert two_words(np.array("1/3"), "q") == two_words("1/3", "q")
    long = np.longdouble(1) / 3
    high, low = two_words(long, "q")
    assert np.longdouble(high) + np.longdouble(low) == long
    for wrong in ("x", None, True, 1j, [1.0], "1/0"):
        with pytest.raises(StateError, match="q must be a real number"):
            two_words(wrong, "q")
    for wrong in (float("inf"), "nan", "1e999999999", mp.inf):
        with pytest.raises(StateError, match=r"q is .*: it must be finite"):
            two_words(wrong, "q")


@pytest.mark.rotated
def test_tolerances_are_met_or_refused() -> None:
    """Tolerances below what error estimates resolve are refused; the error of each step is below all others."""
    kepler, start = system("kepler"), {"q": ["0.5", 0], "velocity": [0, "1.7"], "t_end": 2.0}
    exact = sc.compile_stepper(kepler, "svi:12", precision="double-double")
    for method, least in (("sc:5", 2.2e-20), ("svi:4", 1e-31), ("chebyshev-gauss:6", 1.7e-19)):
        stepper = sc.compile_stepper(kepler, method, precision="double-double")
        with pytest.raises(StateError, match=r"tolerance=1e-32 cannot be met: .* resolve errors of"):
            stepper.integrate(**start, tolerance=1e-32)
        if least > 1e-27:
            with pytest.raises(StateError, match="the default tolerance, round-off, cannot be met"):
                stepper.integrate(**start)
            with pytest.raises(StateError, match="tolerance=1e-28 cannot be met"):
                stepper.integrate_ensemble([start["q"]], velocity=[start["velocity"]], t_end=2.0, tolerance=1e-28)
        tolerance = max(least, 1e-22)
        run = stepper.integrate(**start, tolerance=tolerance)
        for k in range(0, len(run) - 1, len(run) // 8):
            step = exact.integrate(run.q[k], run.p[k], t=run.t[k], t_end=float(run.t[k + 1]), tolerance=1e-30)
            assert abs(step.mp("q")[-1] - run.mp("q")[k + 1]).max() < 10 * tolerance


@pytest.mark.rotated
def test_cost_of_the_default_tolerance() -> None:
    """Adaptive steps to round-off are at most twice as many as those of 1e-28, also from and through zero."""
    text = "a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a - b) + 2*cos(a) + cos(b)"
    double = sc.LagrangianSystem.from_text(name="double", coordinates=["a", "b"], lagrangian=text)
    driven = lagrange("driven", "x", "x_dot**2/2 - (1 + cos(t)/2)*x**2/2")
    for each, method, start in (
        (double, "svi:12", {"q": ["1", "0.5"], "p": ["0", "0"], "t": 0.0, "t_end": 5.0}),
        (double, "svi:12", {"q": [0, 0], "p": ["1", "0.5"], "t": 0.0, "t_end": 5.0}),
        (driven, "svi:12", {"q": ["1"], "p": [0], "t": "100.3", "t_end": 110.0}),
    ):
        stepper = sc.compile_stepper(each, method, precision="double-double")
        few = stepper.integrate(**start, tolerance=1e-28)
        run = stepper.start(**start)
        run.advance(2 * few.steps)
        assert run.t == start["t_end"], (method, start, run.steps)
        assert abs(run.q.mp() - few.mp("q")[-1]).max() < 1e-26


@pytest.mark.rotated
def test_every_quantity_has_both_words(tmp_path: Path) -> None:
    """Coordinates, momenta and velocities by name, of runs, in progress, of ensembles, recordings and events."""
    stepper = sc.compile_stepper(system("kepler"), "svi:4", precision="double-double", events=sc.Event("y - 3/5"))
    start: dict[str, Any] = {"q": ["1/3", "0.7"], "velocity": ["0.1", "-1/7"], "t": "1/3", "parameters": {"m": "1.1"}}
    run = stepper.integrate(**start, h=1 / 16, steps=8)
    runs = stepper.integrate_ensemble(**start | {"q": [start["q"]], "velocity": [start["velocity"]]}, h=1 / 16, steps=8)
    recorded = sc.record_run(stepper.start(**start, h=1 / 16), tmp_path / "a.run", steps=8)
    now = stepper.start(**start, h=1 / 16)
    now.advance(8)
    with mp.workdps(40):
        columns = {"x": ("q", 0), "p_y": ("p", 1), "y_dot": ("velocity", 1)}
        for name, (whole, column) in columns.items():
            values = run.mp(whole)[:, column]
            assert any(mp.mpf(float(value)) != value for value in values)
            for other in (run.mp(name), run[1:].mp(name), runs[0].mp(name), recorded[:].mp(name), recorded[name].mp()):
                assert abs(other - values[-len(other) :]).max() < 1e-31, name
            assert abs(runs.mp(name)[:, 0] - values).max() < 1e-31
        assert abs(run.mp("x_dot")[0] - mp.mpf("0.1")) < 1e-32
        for states in (run, runs[0], recorded):
            t, q, p = states[8]
            assert t.mp() == run.mp("t")[8] == now.t.mp()
            assert abs(q.mp() - run.mp("q")[8]).max() + abs(p.mp() - run.mp("p")[8]).max() < 1e-31
        assert now.energy.mp() == run.mp("energy")[8]
        assert (now.velocity.mp() == run.mp("velocity")[8]).all()
        assert (now.momentum_maps.mp() == run.mp("momentum_maps")[8]).all()
        (crossings,), (saved,) = run.events, recorded.events
        assert len(crossings) == 1
        assert abs(crossings.q.mp()[0, 1] - mp.mpf(3) / 5) < 1e-31
        assert crossings.t.mp()[0] == saved.t.mp()[0]
        q, p = run.at(0.4)
        again = stepper.integrate(run.q[0], run.p[0], t=run.t[0], h=1 / 16, t_end=0.4, parameters={"m": "1.1"})
        assert abs(q.mp() - again.mp("q")[-1]).max() < 1e-30


@pytest.mark.rotated
def test_velocities_at_times_of_two_words() -> None:
    """Momenta, velocities, energies, steps and projections of systems that depend on t use both words of t."""
    text = "(2 + sin(t))*(x_dot**2 + y_dot**2)/2 - x**2*cos(t)/2 + t*x_dot"
    moving = sc.LagrangianSystem.from_text(name="moving", coordinates=["x", "y"], lagrangian=text)
    stepper = sc.compile_stepper(moving, "svi:4", precision="double-double")
    ring = lagrange("ring", "x y", "(x_dot**2 + y_dot**2)/2", constraints=["x**2 + y**2 = (1 + sin(t)/4)**2"])
    with mp.workdps(40):
        t = 3 + mp.mpf(3) / 10**17
        run = stepper.integrate(["1", "0"], velocity=["0.3", "0.1"], t=t, h=1 / 64, steps=1)
        p = (2 + mp.sin(t)) * mp.mpf("0.3") + t
        assert abs(run.mp("p")[0][0] - p) < 1e-31
        many = stepper.integrate_ensemble([["1", "0"]], velocity=[["0.3", "0.1"]], t=t, h=1 / 64, steps=1)
        assert abs(many.mp("p")[0][0][0] - p) < 1e-31
        assert abs(run.mp("x_dot")[0] - mp.mpf("0.3")) < 1e-31
        q1, p1 = stepper.step(run.q[0], run.p[0], 1 / 64, t=t)
        assert (q1.mp() == run.mp("q")[1]).all()
        assert (p1.mp() == run.mp("p")[1]).all()
        radius, rate, (c, s) = 1 + mp.sin(t) / 4, mp.cos(t) / 4, (mp.mpf(3) / 5, mp.mpf(4) / 5)
        q, v = [radius * c, radius * s], [rate * c - s, rate * s + c]
        moved = sc.compile_stepper(ring, "svi:4", precision="double-double").project(q, v, t=t)
        assert abs(np.array([moved[0].mp() - q, moved[1].mp() - v])).max() < 1e-31


def test_entries() -> None:
    """Entries of arrays keep low words, in differences, as initial values and in pickles."""
    x = with_low(np.array([1.0, 1.0, 2.0]), np.array([1e-20, 3e-20, 5e-20]))
    assert (x - x[0])[:2].tolist() == [0.0, 3e-20 - 1e-20]
    assert x[1] - x[0] == 3e-20 - 1e-20
    assert x[1] - 1.0 == 3e-20
    assert [each.low for each in x] == [1e-20, 3e-20, 5e-20]
    assert two_words(x[2], "q") == (2.0, 5e-20)
    assert (split([x[0], x[2]], "q")[1] == [1e-20, 5e-20]).all()
    assert pickle.loads(pickle.dumps(x[1])).low == 3e-20
    assert f"{x[1]:g} {json.dumps(x[1])}" == "1 1.0"
    assert isinstance(x[1] + 1.0, float)
    assert not hasattr(x[1] + 1.0, "low")
    with mp.workdps(40):
        assert x[1].mp() == mp.mpf(1) + mp.mpf(3e-20)


@pytest.mark.second
def test_explicit_ensembles() -> None:
    """Trajectories in SIMD lanes equal the formulas in 50 digits, whatever their neighbours are."""
    driven = lagrange("driven", "x y", "m*(x_dot**2 + 2*y_dot**2)/2 - k*cos(x - y) - x*y**2*sin(t)", m=1.0, k=1.0)
    starts = [[f"0.{j}1", f"-1/{j + 3}"] for j in range(11)]
    numbers = {"m": [f"1.{j}" for j in range(11)], "k": "0.3"}
    with mp.workdps(50):
        q, p = [mp.mpf("0.31"), mp.mpf(-1) / 6], [mp.mpf("0.31"), mp.mpf(-1) / 6]
        m, k, h = mp.mpf("1.3"), mp.mpf("0.3"), mp.mpf(-0.07)

        def kick(t: object) -> None:
            force = k * mp.sin(q[0] - q[1])
            p[0] += h / 2 * (force - q[1] ** 2 * mp.sin(t))
            p[1] += h / 2 * (-force - 2 * q[0] * q[1] * mp.sin(t))

        for n in range(9):
            kick(n * h)
            q = [q[0] + h * p[0] / m, q[1] + h * p[1] / (2 * m)]
            kick((n + 1) * h)
        stepper = sc.compile_stepper(driven, "stoermer-verlet", precision="double-double")
        runs = stepper.integrate_ensemble(starts, starts, parameters=numbers, h=-0.07, steps=9)
        assert max(abs(runs.mp("q")[-1, 3] - q)) < 1e-31
        assert max(abs(runs.mp("p")[-1, 3] - p)) < 1e-31
        infinite = stepper.integrate_ensemble([*starts[:3], ["1e200", "1e300"]], starts[:4], h=-0.07, steps=9)
        fewer = stepper.integrate_ensemble(starts[:3], starts[:3], h=-0.07, steps=9)
        assert infinite.status.tolist() == ["ok", "ok", "ok", "not finite"]
        assert (infinite.mp("q")[:, :3] == fewer.mp("q")).all()


@pytest.mark.rotated
@pytest.mark.parametrize("kind", ["fixed", "tau", "inputs", "events"])
def test_dense_output_at_the_times_of_states_is_these_states(kind: str) -> None:
    """Times have low words, which dense output takes as well: in arrays, in lists and alone."""
    more: dict[str, Any] = {"forces": {"q": "u"}, "inputs": ["u"]} if kind == "inputs" else {}
    system = sc.LagrangianSystem.from_text("pendulum", ["q"], "q_dot**2/2 + cos(q)", **more)
    system = sc.reparametrise(system, "1/(1 + q**2)") if kind == "tau" else system
    stepper = sc.compile_stepper(system, "svi:4", precision="double-double")
    arguments: dict[str, Any] = {"inputs": {"u": ([0.0, 0.35, 2.0], [0.0, 0.1, 0.3])}} if kind == "inputs" else {}
    arguments |= {"events": [sc.impact("0.55 - q", 0.5)]} if kind == "events" else {}
    run = stepper.integrate(["0.5"], ["0.2"], h=0.1, steps=12, **arguments)
    assert run.t_low.any()
    last = slice(None) if kind != "events" else np.flatnonzero(np.diff(run.t, prepend=-1.0))  # of equal times
    q, p = run.at(run.t)
    assert not (q - run.q)[last].any()
    assert not (p - run.p)[last].any()
    assert not (run.at([run.t[3], run.t[4]])[0] - run.q[3:5]).any()
    assert not (run.at(run.t[3])[0] - run.q[3]).any()
    assert (run.at(float(run.t[3]))[0] - run.q[3]).any()


@pytest.mark.rotated
def test_outputs_have_both_words_or_are_refused():
    body = lagrange("body", "x", "(omega_1**2 + 2*omega_2**2 + 3*omega_3**2 + x_dot**2)/2", rotations={"R": "omega"})
    stepper = sc.compile_stepper(body, "svi:3", precision="double-double")
    start, moving = {"R": np.eye(3), "x": 1.0}, {"omega": [0.3, 0.8, 0.5], "x": 0.1}
    run = stepper.integrate(start, velocity=moving, h=0.125, steps=8)
    for name in ("x", "R_w", "q", "p", "velocity", "energy"):
        values = run.mp(name)
        assert max(abs(x - float(x)) for x in values[1:].ravel()) > 0.0, name
    for name in ("R", "omega"):
        with pytest.raises(sc.StateError, match=f"'{name}' has one word"):
            run.mp(name)
    for export in (run.to_dataframe, run.to_xarray):
        with pytest.raises(sc.StateError, match="would lose the low words"):
            export()


def test_arithmetic() -> None:
    """Sums, products and quotients of arrays of two words are accurate to 1e-31; of doubles they are those of NumPy."""
    rng = np.random.default_rng(5)
    high = rng.uniform(0.5, 2.0, (2, 100))
    x, y = (with_low(each, each * 2.0**-54 * rng.uniform(-1, 1, 100)) for each in high)
    with mp.workdps(50):
        a, b = map(as_mpmath, (x, y))
        for function, plain in ((sum_of, operator.add), (product_of, operator.mul), (quotient_of, operator.truediv)):
            exact = plain(a, b)
            assert np.abs((as_mpmath(function(x, y)) - exact) / exact).max() < 3e-32
            assert (function(*high) == plain(*high)).all()
