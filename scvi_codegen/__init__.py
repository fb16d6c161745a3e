"""Compile a symbolic Lagrangian into a fast, standalone C variational integrator.

    >>> import scvi_codegen as sc
    >>> pendulum = sc.LagrangianSystem.from_text(
    ...     name="pendulum", coordinates=["q"], parameters={"m": 1.0, "l": 1.0, "g": 1.0},
    ...     lagrangian="m*l**2*q_dot**2/2 + m*g*l*cos(q)")
    >>> stepper = sc.compile_stepper(pendulum, sc.SVI(4))
    >>> run = stepper.integrate([0.5], [0.0], h=0.5, steps=2000)
    >>> bool(abs(run.energy() - run.energy()[0]).max() < 1e-9)
    True

Names are imported when they are first used, so code that only steps never imports SymPy.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOMES = {
    "advice": ("Advice", "advise"),
    "compiler": ("compile_stepper", "generate_source"),
    "ensemble": ("EnsembleTrajectory",),
    "hamiltonian": ("HamiltonianSystem", "hamiltonian_of", "lagrangian_of"),
    "equations": ("StepEquations", "derive"),
    "errors": (
        "BuildError",
        "ExpressionError",
        "MethodError",
        "MethodWarning",
        "ModelFileError",
        "PackageError",
        "PlotError",
        "ScviCodegenError",
        "StateError",
        "StepFailedError",
        "SystemDefinitionError",
    ),
    "methods": (
        "SCVI",
        "SVI",
        "ChebyshevGauss",
        "ChebyshevLobatto",
        "CollocationRK",
        "Composition",
        "ExplicitEuler",
        "Gauss",
        "LobattoIIIA",
        "RadauIA",
        "RadauIIA",
        "RungeKutta",
        "SpectralCollocation",
        "StoermerVerlet",
    ),
    "model_file": ("Model", "load_model", "save_model"),
    "nodes": ("Nodes", "chebyshev_lobatto", "equispaced", "legendre_lobatto"),
    "package": ("generate_package", "load_package"),
    "plotting": ("plot_trajectory",),
    "problems": ("PROBLEMS", "problem"),
    "quadrature": (
        "Quadrature",
        "clenshaw_curtis",
        "fejer",
        "gauss_legendre",
        "gauss_lobatto",
        "gauss_radau",
    ),
    "binding": ("SolverOptions",),
    "run": ("Run",),
    "stepper": ("Stepper",),
    "system": ("LagrangianSystem",),
    "trajectory": ("Trajectory",),
    "verification": ("Certificate", "verify"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [*sorted(_HOME_OF)]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
