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

from scvi_codegen.version import __version__ as __version__

_HOMES = {
    "advice.advice": ("Advice", "advise"),
    "frameworks.casadi": ("casadi_flow", "casadi_step"),
    "frameworks.control_task": ("ControlledMotion",),
    "frameworks.optimal_control": ("optimal_control",),
    "frameworks.flow": ("JaxFlow", "jax_flow"),
    "frameworks.torch": ("TorchFlow", "torch_flow"),
    "frameworks.rebound": ("GravitatingBodies", "from_rebound", "to_rebound"),
    "fields.derivation": ("FieldDerivation",),
    "fields.laws": ("ConservationLaw",),
    "fields.local": ("LocalLaw",),
    "fields.mesh": ("MeshSystem",),
    "fields.system": ("FieldSystem",),
    "files.cache": ("CacheInfo", "cache_info", "clear_cache"),
    "compiler": ("compile_stepper",),
    "pipeline": ("generate_source",),
    "runtime.ensemble.result": ("EnsembleTrajectory",),
    "exact.discrete_lagrangian": ("ExactStep", "exact_discrete_lagrangian", "exact_map"),
    "runtime.chaos.indicators": ("ChaosIndicators",),
    "runtime.events.event": ("Crossings", "Event", "impact"),
    "runtime.estimation.fitting": ("Fit", "fit"),
    "runtime.sensitivity.gradients": ("Gradient",),
    "runtime.sensitivity.step_derivatives": ("Sensitivity",),
    "mechanics.first_order": ("FirstOrderSystem",),
    "mechanics.hamiltonian": ("HamiltonianSystem",),
    "mechanics.legendre": ("hamiltonian_of", "lagrangian_of"),
    "mechanics.time_transformation": ("reparametrise",),
    "mechanics.derived_systems": ("change_coordinates", "variational_system"),
    "derivation.equations": ("StepEquations", "derive"),
    "errors": (
        "AccuracyWarning",
        "ArgumentError",
        "BuildError",
        "CacheWarning",
        "ControlError",
        "EventError",
        "EventWarning",
        "ExpressionError",
        "FitError",
        "MethodError",
        "MethodWarning",
        "MissingLibraryError",
        "ModelFileError",
        "OrbitError",
        "PackageError",
        "PlotError",
        "RecordingError",
        "RecordingWarning",
        "ScviCodegenError",
        "StateError",
        "StepFailedError",
        "SystemDefinitionError",
        "SystemDefinitionWarning",
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
        "as_method",
    ),
    "mechanics.arrays.rolling": ("RolledSums", "roll_sums", "unroll_sums"),
    "models.packages.fmu": ("generate_fmu",),
    "models.model": ("Model",),
    "models.model_files.model_file": ("load_model", "save_model"),
    "advice.solve_ivp": ("OdeResult", "solve_ivp"),
    "tables.nodes": ("Nodes", "chebyshev_lobatto", "equispaced", "legendre_lobatto"),
    "models.packages.package": ("generate_package", "load_package"),
    "pictures.animation": ("Film", "animate"),
    "pictures.conserved": ("plot_energy", "plot_momentum_maps"),
    "pictures.overview": ("plot_section", "plot_trajectory"),
    "pictures.attitudes": ("plot_attitude",),
    "pictures.paths": ("plot_motion", "plot_phase"),
    "pictures.arrays": ("plot_arrays", "plot_spectrum"),
    "models.problems": ("PROBLEMS", "problem"),
    "tables.quadrature": (
        "Quadrature",
        "clenshaw_curtis",
        "fejer",
        "gauss_legendre",
        "gauss_lobatto",
        "gauss_radau",
        "hermite",
    ),
    "tables.spaces": ("Polynomials", "Splines", "Trigonometric"),
    "native.options": ("SolverOptions",),
    "results.recording": ("RecordedRun", "load_run", "record_run", "resume_run"),
    "runtime.orbits.solver": ("periodic_orbit",),
    "runtime.orbits.periodic_orbit": ("PeriodicOrbit",),
    "runtime.run.run": ("Run",),
    "runtime.core.stepper": ("Stepper",),
    "mechanics.symmetry.checking": ("check_symmetry",),
    "mechanics.symmetry.symmetry": ("Symmetry", "symmetries"),
    "mechanics.lagrangian": ("LagrangianSystem",),
    "runtime.trajectory.trajectory": ("Trajectory",),
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
