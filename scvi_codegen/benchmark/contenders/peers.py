"""Integrators of other packages, each with the best options and the best formulation known to us.

heyoka      adaptive Taylor series, compiled by LLVM: see :mod:`.taylor`.
rebound     IAS15, for gravitating bodies, with its default step control.
mujoco      its integrators, and Pinocchio, for multibody systems: see :mod:`.engines`.
cyrk        DOP853 in C++ (CyRK), right-hand side compiled by Numba.
jitcode     SciPy's Fortran DOP853, right-hand side compiled by C with JiTCODE's default flags (-Ofast -march=native).
scipy       ``solve_ivp`` with DOP853, right-hand side compiled by Numba if it is there, else plain Python.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.unforced import Array, Case
from scvi_codegen.benchmark.contenders import arrays, pdes
from scvi_codegen.benchmark.contenders.engines import mujoco_contenders, pinocchio_contenders
from scvi_codegen.benchmark.contenders.mechanisms import lambdify_contenders, pydy_contenders
from scvi_codegen.benchmark.contenders.taylor import heyoka_contenders
from scvi_codegen.benchmark.contenders.tracing import rates_text
from scvi_codegen.benchmark.report import Contender

TOLERANCES = (3e-14, 1e-13, 1e-12, 1e-11, 1e-9, 1e-7)
IAS15_EPSILONS = (1e-9, 1e-6, 1e-4)
MOST_STEPS = 10**9


@dataclass(frozen=True, slots=True, kw_only=True)
class Peer:
    """Library to compare with.

    Attributes:
        modules: modules that must be installed.
        contenders: function that yields its contenders, one per setting.
        suits: predicate of the cases it can integrate.
    """

    modules: tuple[str, ...]
    contenders: Callable[[Case, bool], Iterator[Contender]]
    suits: Callable[[Case], bool]


def missing_module(peer: Peer) -> str | None:
    """Return the first module that is not installed."""
    return next((name for name in peer.modules if importlib.util.find_spec(name) is None), None)


# ---- REBOUND


def _rebound(case: Case, quick: bool) -> Iterator[Contender]:
    for epsilon in IAS15_EPSILONS[: 1 if quick else None]:
        yield Contender(
            method="rebound IAS15",
            setting=f"epsilon={epsilon:.0e}" + (" (default)" if epsilon == IAS15_EPSILONS[0] else ""),
            options="default step control (PRS23)",
            compile_seconds=0.0,
            prepare=_rebound_preparation(case, epsilon),
        )


def _rebound_preparation(case: Case, epsilon: float) -> Callable[[int], Callable[[], Array]]:
    import rebound

    bodies = case.bodies
    assert bodies is not None

    def prepare(index: int) -> Callable[[], Array]:
        simulation = rebound.Simulation()
        simulation.integrator = "ias15"
        simulation.integrator.epsilon = epsilon
        simulation.G = bodies.gravity
        if bodies.fixed_centre:
            simulation.add(m=1.0)
            simulation.N_active = 1
        q, v = (part[index].reshape(-1, bodies.axes) for part in (case.q, case.velocity))
        for mass, position, velocity in zip(bodies.masses, q, v, strict=True):
            start = {axis: float(x) for axis, x in zip("xyz", position, strict=False)}
            start |= {f"v{axis}": float(x) for axis, x in zip("xyz", velocity, strict=False)}
            simulation.add(m=mass, **start)

        def integrate() -> Array:
            simulation.integrate(case.span)
            moving = simulation.particles[1:] if bodies.fixed_centre else simulation.particles
            return np.array([particle.xyz[: bodies.axes] for particle in moving]).ravel()

        return integrate

    return prepare


# ---- Dormand-Prince method of order 8, in three packages


def _start(case: Case, index: int) -> Array:
    return np.concatenate([case.q[index], case.velocity[index]])


def _right_hand_side(case: Case) -> Callable[..., None]:
    """Return a Python function ``rates(out, t, x, unused)``: the loops of the case if any, else unrolled."""
    names: dict[str, Any] = {"sin": math.sin, "cos": math.cos, "sqrt": math.sqrt}
    text = case.loops or rates_text(case.formulations[0].rates, case.parameters, case.size)
    exec(compile(text, f"<rates of {case.name}>", "exec"), names)
    function: Callable[..., None] = names["rates"]
    return function


def _dop853(
    method: str, options: str, seconds: float, case: Case, quick: bool, solve: Callable[[Array, float], Array]
) -> Iterator[Contender]:
    """Yield one contender per tolerance; ``solve`` maps (state, relative tolerance) to the final state."""

    def preparation(tolerance: float) -> Callable[[int], Callable[[], Array]]:
        def prepare(index: int) -> Callable[[], Array]:
            start = _start(case, index)
            return lambda: solve(start, tolerance)[: case.dimension]

        return prepare

    for tolerance in TOLERANCES[: 2 if quick else None]:
        yield Contender(
            method=method,
            setting=f"rtol={tolerance:.0e}",
            options=options,
            compile_seconds=seconds,
            prepare=preparation(tolerance),
        )


def _absolute(tolerance: float, start: Array) -> float:
    """Return the absolute tolerance: a tenth of the relative one times the smaller typical size of q and v."""
    sizes = [float(np.sqrt(np.mean(half**2))) for half in np.array_split(start, 2)]
    return 0.1 * tolerance * min(size for size in sizes if size > 0.0)


def _cyrk(case: Case, quick: bool) -> Iterator[Contender]:
    import numba
    from CyRK import cyjit, nbsolve2_ivp

    began = time.perf_counter()
    address = cyjit(_right_hand_side(case)).address
    span = np.array([case.span])

    @numba.njit  # type: ignore[untyped-decorator]  # Numba ships no stubs
    def compiled(address: int, start: Array, relative: float, absolute: float, span: Array) -> Any:
        outcome = nbsolve2_ivp(
            address, (0.0, span[0]), start, method="DOP853", rtol=relative, atol=absolute, t_eval=span
        )
        final, success = outcome.y[:, -1].copy(), outcome.success
        outcome.free()
        return final, success

    def solve(start: Array, tolerance: float) -> Array:
        final, success = compiled(address, start, tolerance, _absolute(tolerance, start), span)
        if not success:
            raise ArithmeticError("CyRK's DOP853 failed")
        result: Array = final
        return result

    compiled(address, _start(case, 0), 1e-3, 1e-3, 1e-3 * span)
    seconds = time.perf_counter() - began
    yield from _dop853("CyRK DOP853", "right-hand side by Numba", seconds, case, quick, solve)


def _jitcode(case: Case, quick: bool) -> Iterator[Contender]:
    import jitcode
    import symengine

    began = time.perf_counter()
    x = [jitcode.y(n) for n in range(case.size)]
    functions = SimpleNamespace(sin=symengine.sin, cos=symengine.cos, sqrt=symengine.sqrt, time=jitcode.t)
    rates = case.formulations[0].rates(x, case.parameters, functions)
    system = jitcode.jitcode(rates, n=len(x), verbose=False)
    with _elsewhere():
        system.compile_C()
    seconds = time.perf_counter() - began

    def solve(start: Array, tolerance: float) -> Array:
        system.set_integrator("dop853", rtol=tolerance, atol=_absolute(tolerance, start), nsteps=MOST_STEPS)
        system.set_initial_value(start, 0.0)
        final: Array = system.integrate(case.span)
        return final

    yield from _dop853("JiTCODE DOP853", "right-hand side in C, default flags", seconds, case, quick, solve)


@contextlib.contextmanager
def _elsewhere() -> Iterator[None]:
    """Work in a temporary folder, as setuptools (for JiTCODE) would read a pyproject.toml here; restore logging."""
    level = logging.root.level
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        try:
            yield
        finally:
            logging.root.setLevel(level)


def _scipy(case: Case, quick: bool) -> Iterator[Contender]:
    from scipy.integrate import solve_ivp

    began = time.perf_counter()
    plain, size = _right_hand_side(case), case.size
    fast, options = plain, "right-hand side in Python"
    if importlib.util.find_spec("numba") is not None:
        import numba

        fast, options = numba.njit(plain), "right-hand side by Numba"

    def rates(t: float, x: Array) -> Array:
        out = np.empty(size)
        fast(out, t, x, 0)
        return out

    def solve(start: Array, tolerance: float) -> Array:
        outcome = solve_ivp(
            rates,
            (0.0, case.span),
            start,
            method="DOP853",
            rtol=tolerance,
            atol=_absolute(tolerance, start),
            t_eval=[case.span],
        )
        if not outcome.success:
            raise ArithmeticError(f"solve_ivp: {outcome.message}")
        final: Array = outcome.y[:, -1]
        return final

    rates(0.0, _start(case, 0))
    seconds = time.perf_counter() - began
    yield from _dop853("SciPy DOP853", options, seconds, case, quick, solve)


def _solvable(case: Case) -> bool:
    return bool(case.formulations)


def _field(case: Case) -> bool:
    return case.field is not None


def _sympy_mechanism(case: Case) -> bool:
    return case.name.startswith("mechanisms")


def _by_hand(case: Case) -> bool:
    return case.arrays is not None and case.arrays.by_hand is not None


PEERS = {
    "heyoka": Peer(modules=("heyoka",), contenders=heyoka_contenders, suits=_solvable),
    "rebound": Peer(
        modules=("rebound",),
        contenders=lambda case, quick: (arrays.rebound_contenders if case.arrays else _rebound)(case, quick),
        suits=lambda case: case.bodies is not None or ("bodies" in case.name and case.arrays is not None),
    ),
    "mujoco": Peer(modules=("mujoco",), contenders=mujoco_contenders, suits=lambda case: case.mjcf is not None),
    "pinocchio": Peer(
        modules=("pinocchio",),
        contenders=pinocchio_contenders,
        suits=lambda case: case.mjcf is not None and case.size == 2 * case.dimension and not case.system.constraints,
    ),
    "cyrk": Peer(modules=("CyRK", "numba"), contenders=_cyrk, suits=_solvable),
    "jitcode": Peer(modules=("jitcode",), contenders=_jitcode, suits=_solvable),
    "scipy": Peer(
        modules=("scipy",),
        contenders=lambda case, quick: (arrays.numpy_contenders if case.arrays else _scipy)(case, quick),
        suits=lambda case: bool(case.formulations) or case.arrays is not None,
    ),
    "py-pde": Peer(modules=("pde", "numba"), contenders=pdes.pde_contenders, suits=_field),
    "fft": Peer(modules=("scipy",), contenders=pdes.fft_contenders, suits=_field),
    "numba": Peer(modules=("numba",), contenders=pdes.numba_contenders, suits=_field),
    "hand": Peer(modules=(), contenders=arrays.by_hand_contenders, suits=_by_hand),
    "lambdify": Peer(modules=(), contenders=lambdify_contenders, suits=_sympy_mechanism),
    "pydy": Peer(modules=("pydy",), contenders=pydy_contenders, suits=_sympy_mechanism),
    "openmm": Peer(modules=("openmm",), contenders=arrays.openmm_contenders, suits=lambda case: "atoms" in case.name),
}
"""Peers by the name on the command line, the fastest first; "hand", "fft" and "numba" are programs
written by hand: C for lattices, split steps with FFT and loops in Numba for fields."""
