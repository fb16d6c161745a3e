"""The representation of every public object fits in a line: constructor-like, or a summary."""

import inspect
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.common.representation import LONGEST
from scvi_codegen.methods.composition import SPLITTING

NEEDS_LIBRARIES = {"ControlledMotion", "GravitatingBodies", "JaxFlow", "Page", "TorchFlow"}
"""Made by optional libraries only."""
NAME = "a system whose name is as long as a sentence that says what moves in it and for what reason"


def definitions() -> Iterator[Any]:
    yield from (sc.SVI(8), sc.SVI(6, "gauss-lobatto:7"), sc.SVI(3, space="splines:2"), sc.SCVI(4), sc.Gauss(4))
    yield from (sc.StoermerVerlet(), sc.Composition.of(8), sc.SpectralCollocation(4), sc.CollocationRK((0.5,)))
    yield from (sc.gauss_legendre(8), sc.clenshaw_curtis(6), sc.chebyshev_lobatto(8), sc.Polynomials())
    yield from (sc.Splines(3), sc.Trigonometric(0.5), sc.SolverOptions(), sc.Event("q - 1", terminal=True))
    yield from (sc.contact("y - r", slip="x_dot - r*a_dot", friction=0.3), sc.friction("x_dot - 0.3", limit=0.25))
    yield sc.Table([0, 1], [0, 1])
    step = sc.ExplicitStep.of(SPLITTING, {"LEAPS": {"KICK": [0.5, 0.5], "DRIFT": [1, 0], "KICK_ABSCISSA": [0, 1]}})
    claims = {"order": 2, "symmetric": True, "symplectic": True}
    yield from (step, sc.ExplicitMethod(name="splitting", title=NAME, **claims, step=step))
    yield sc.HamiltonianSystem.from_text(NAME, ["q"], "p**2/2 - cos(q)", momenta=["p"])
    yield sc.LagrangianSystem.from_text(NAME, ["x", "y"], "x*y_dot - x**2/2 - y**2/2")
    waves = sc.FieldSystem.from_text(NAME, ["u"], {"x": (0, 1)}, "u_t**2/2 - u_x**2/2")
    yield from (waves, waves.discretise("spectral-elements", degree=2, elements=2), waves.derive())
    yield from waves.derive().laws
    kepler = sc.problem("kepler")
    yield from (kepler, kepler.system, sc.Model.from_problem(kepler))
    yield replace(sc.cache_info(), folder=Path("/home/user/.cache/scvi-codegen"))  # the path is shown whole
    yield from sc.symmetries(kepler.system)
    yield sc.derive(kepler.system, sc.SVI(2))
    yield sc.roll_sums(kepler.system)
    yield sc.exact_discrete_lagrangian(kepler.system, [0.5, 0.0], [0.5, 0.1], 0.1)
    yield sc.verify(kepler.system, sc.SVI(1), [0.5, 0.0], [0.0, 1.7], h=0.1)
    yield sc.advise(kepler.system, sc.SVI(4), [0.5, 0.0], [0.0, 1.7], 1.0, 1e-6)


def runs(folder: Path) -> Iterator[Any]:
    swing = sc.LagrangianSystem.from_text(NAME, ["q"], "m*q_dot**2/2 + cos(q)", parameters={"m": 1.0})
    stepper = sc.compile_stepper(swing, "svi:4", flags=QUICK_FLAGS)
    run = stepper.integrate([1.0], [0.0], h=0.1, steps=60, events="q")
    yield from (stepper, run, run.events[0], run.chaos_indicators(), run.sensitivity(), run.pullback(np.ones((61, 2))))
    yield from (stepper.start([1.0], [0.0], h=0.1), stepper.start([1.0], [0.0], t_end=2.0))
    yield from (stepper.integrate([1.0], [0.0], t_end=2.0), stepper.integrate_ensemble([[1.0]], [[0.0]], t_end=2.0))
    yield sc.fit(stepper, run.t, run.q, q=[1.0], p=[0.0], h=0.1, unknown=["m"])
    yield sc.periodic_orbit(stepper, [1.0], [0.0], period=6.7, steps=60, fixed=["q"])
    yield sc.solve_ivp(stepper, (0.0, 1.0), [1.0, 0.0])
    yield sc.record_run(stepper.start([1.0], [0.0], h=0.1), folder / "a.run", steps=10)
    yield run.animate(seconds=0.1)
    pushed = sc.LagrangianSystem.from_text(NAME, ["q"], "q_dot**2/2", forces={"q": "u"}, inputs=["u"])
    data = {"u": ([0.0, 0.5, 1.0], [0.0, 1.0, 0.0])}
    yield sc.compile_stepper(pushed, "svi:2", flags=QUICK_FLAGS).integrate([0.1], [0.0], inputs=data, h=0.1, t_end=1.0)
    ring = sc.LagrangianSystem.from_text(NAME, ["q[N]"], "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)")
    many = sc.compile_stepper(ring, "svi:2", flags=QUICK_FLAGS)
    yield from (ring, many, many.start(np.ones(5), h=0.1), many.integrate(np.ones(5), h=0.1, steps=3))
    yield sc.Model(system=ring, method=sc.SVI(2), q={"q": np.ones(5)}, h=0.1, steps=3)
    mesh = sc.FieldSystem.from_text(NAME, ["u"], {"x": (0, 1)}, "u_t**2/2").discretise(
        "spectral-elements", degree=2, elements=2
    )
    flat = sc.compile_stepper(mesh.system, "svi:2", flags=QUICK_FLAGS).integrate({"u": np.ones(5)}, h=0.1, steps=3)
    yield sc.compile_stepper(pushed, "svi:2", flags=QUICK_FLAGS).path([0.0], [1.0], 1.0, steps=2, inputs=data)
    yield mesh.local_laws(flat, "energy")["energy"]


@pytest.mark.rotated
@pytest.mark.filterwarnings("ignore")
def test_a_representation_fits_in_a_line(tmp_path):
    pytest.importorskip("matplotlib")
    found = {}
    for one in (*definitions(), *runs(tmp_path)):
        shown = repr(one)
        assert len(shown) <= LONGEST, shown
        assert "\n" not in shown
        found[type(one).__name__] = shown
    public = (getattr(sc, name) for name in sc.__all__)
    classes = {each.__name__ for each in public if inspect.isclass(each) and not issubclass(each, Exception)}
    assert classes - set(found) == NEEDS_LIBRARIES
    assert found["Quadrature"].startswith("Quadrature(name='")
    assert sc.SVI(8).__repr__() == "SVI(degree=8, quadrature='gauss-legendre:8', space='polynomials')"
