"""Integrators of other packages, each with the best options and the best formulation known to us.

heyoka      adaptive Taylor series, compiled by LLVM: see :mod:`.taylor`.
irkgl16     the Gauss method of 8 stages in SIMD lanes, ported to C from the paper: see :mod:`.irkgl16`.
rebound     IAS15, for gravitating bodies, with its default step control.
mujoco      its integrators, Pinocchio and Exudyn, for multibody systems: see :mod:`.engines`.
cyrk        DOP853 in C++ (CyRK), right-hand side compiled by Numba.
scipy       ``solve_ivp`` with DOP853, right-hand side compiled by Numba if it is there, else plain Python.
"""

import importlib.util
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.cases.unforced import Array, Case
from benchmarks.contenders import arrays, pdes
from benchmarks.contenders.contact import siconos_contacts
from benchmarks.contenders.dop853 import absolute_tolerance, by_tolerance, dop853, start_of
from benchmarks.contenders.engines import exudyn_contenders, mujoco_contenders, pinocchio_contenders
from benchmarks.contenders.irkgl16 import irkgl16_contenders
from benchmarks.contenders.mechanisms import by_lambdify, by_pydy, kane_contenders
from benchmarks.contenders.taylor import heyoka_contenders
from benchmarks.contenders.tracing import rates_text
from benchmarks.report import Contender

IAS15_EPSILONS = (1e-9, 1e-6, 1e-4)
"""Accuracies of IAS15, the default first."""


@dataclass(frozen=True, slots=True)
class Peer:
    """Library to compare with.

    Attributes:
        modules: modules that must be installed.
        contenders: function that yields its contenders, one per setting.
        suits: predicate of the cases it can integrate.
        source: how to install it.
    """

    modules: tuple[str, ...]
    contenders: Callable[[Case, bool], Iterator[Contender]]
    suits: Callable[[Case], bool]
    source: str = "pip install 'scvi-codegen[bench]'"


def rebound_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield IAS15 with its default step control (PRS23); for many bodies also leapfrog."""
    epsilons = IAS15_EPSILONS[:1] if quick else IAS15_EPSILONS
    settings = [
        ("IAS15", f"epsilon={each:.0e}{' (default)' * (each == epsilons[0])}", {"epsilon": each}) for each in epsilons
    ]
    if case.arrays is not None:
        counts = arrays.step_counts(case, range(2, 4 if quick else 12))
        settings += [("leapfrog", f"{steps} steps", {"dt": case.span / steps}) for steps in counts]
    for integrator, setting, values in settings:
        prepare = partial(_rebound_preparation, case, integrator.lower(), values)
        yield Contender(f"rebound {integrator}", setting, "", 0.0, prepare, starts=len(case.q))


def _rebound_preparation(case: Case, integrator: str, values: Mapping[str, float], index: int) -> Callable[[], Array]:
    import rebound

    bodies = case.bodies
    assert bodies is not None
    simulation = rebound.Simulation()
    simulation.integrator = integrator
    for name, value in values.items():
        setattr(simulation.integrator if name == "epsilon" else simulation, name, value)
    simulation.G, simulation.softening = bodies.gravity, bodies.softening
    if bodies.fixed_centre:
        simulation.add(m=1.0)
        simulation.N_active = 1
    q, v = (part[index].reshape(-1, bodies.axes) for part in case.states)
    for mass, position, velocity in zip(bodies.masses, q, v, strict=True):
        start = {axis: float(x) for axis, x in zip("xyz", position, strict=False)}
        start |= {f"v{axis}": float(x) for axis, x in zip("xyz", velocity, strict=False)}
        simulation.add(m=mass, **start)

    def integrate() -> Array:
        simulation.integrate(case.span)
        moving = simulation.particles[1:] if bodies.fixed_centre else simulation.particles
        return np.array([particle.xyz[: bodies.axes] for particle in moving]).ravel()

    return integrate


# ---- Dormand-Prince method of order 8, in two packages


def _right_hand_side(case: Case) -> Callable[..., None]:
    """Return a Python function ``rates(out, t, x, unused)``: the loops of the case if any, else unrolled."""
    names: dict[str, Any] = {"sin": math.sin, "cos": math.cos, "sqrt": math.sqrt}
    text = case.loops or rates_text(case.formulations[0].rates, case.parameters, case.size)
    exec(compile(text, f"<rates of {case.name}>", "exec"), names)
    function: Callable[..., None] = names["rates"]
    return function


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
        final, success = compiled(address, start, tolerance, absolute_tolerance(tolerance, start), span)
        if not success:
            raise ArithmeticError("CyRK's DOP853 failed")
        result: Array = final
        return result

    compiled(address, start_of(case, 0), 1e-3, 1e-3, 1e-3 * span)
    seconds = time.perf_counter() - began
    yield from by_tolerance("CyRK DOP853", "right-hand side by Numba", seconds, case, quick, solve)


def _scipy(case: Case, quick: bool) -> Iterator[Contender]:
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

    rates(0.0, start_of(case, 0))
    yield from dop853(options, time.perf_counter() - began, case, quick, rates)


def _has_formulations(case: Case) -> bool:
    return bool(case.formulations)


def _is_mechanism(case: Case) -> bool:
    return case.name.startswith("mechanisms")


def _is_field(case: Case) -> bool:
    return case.field is not None


def _is_tree(case: Case) -> bool:
    return case.mjcf is not None and not case.system.rotations and not case.system.constraints


BY_LAMBDIFY, BY_PYDY = (
    partial(kane_contenders, f"{name} DOP853", make) for name, make in (("lambdify", by_lambdify), ("PyDy", by_pydy))
)
PEERS = {
    "heyoka": Peer(("heyoka",), heyoka_contenders, _has_formulations),
    "irkgl16": Peer((), irkgl16_contenders, _has_formulations),
    "rebound": Peer(("rebound",), rebound_contenders, lambda case: case.bodies is not None),
    "mujoco": Peer(("mujoco",), mujoco_contenders, lambda case: case.mjcf is not None),
    "siconos": Peer(
        ("siconos",), siconos_contacts, lambda case: "contact:" in case.name, "apt install python3-siconos"
    ),
    "pinocchio": Peer(("pinocchio",), pinocchio_contenders, lambda case: _is_tree(case) or ":tree:" in case.name),
    "exudyn": Peer(("exudyn",), exudyn_contenders, _is_tree),
    "cyrk": Peer(("CyRK", "numba"), _cyrk, _has_formulations),
    "scipy": Peer(("scipy",), _scipy, _has_formulations),
    "py-pde": Peer(("pde", "numba"), pdes.pde_contenders, _is_field),
    "fft": Peer(("scipy",), pdes.fft_contenders, _is_field),
    "numba": Peer(("numba",), pdes.numba_contenders, _is_field),
    "hand": Peer((), arrays.by_hand_contenders, lambda case: bool(case.arrays and case.arrays.by_hand)),
    "lambdify": Peer((), BY_LAMBDIFY, _is_mechanism),
    "pydy": Peer(("pydy",), BY_PYDY, _is_mechanism),
    "openmm": Peer(("openmm",), arrays.openmm_contenders, lambda case: "atoms" in case.name),
}
"""Peers by the name on the command line, the fastest first; "irkgl16", "hand", "fft" and "numba" are
programs written by hand: a port of a Julia package to C, C for lattices, split steps with FFT and loops in Numba for
fields."""
