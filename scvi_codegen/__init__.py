"""Compile a symbolic Lagrangian into a fast, standalone C variational integrator.

    >>> import scvi_codegen as sc
    >>> pendulum = sc.LagrangianSystem.from_text(
    ...     name="pendulum", coordinates=["q"], parameters={"m": 1.0, "l": 1.0, "g": 1.0},
    ...     lagrangian="m*l**2*q_dot**2/2 + m*g*l*cos(q)")
    >>> stepper = sc.compile_stepper(pendulum, sc.SVI(4))
    >>> run = stepper.integrate([0.5], [0.0], h=0.5, steps=2000)
    >>> bool(abs(run.energy() - run.energy()[0]).max() < 1e-9)
    True

The rooms, in the order of the way from L to a run; imports go up:

* ``common``: what every room uses: errors, checks of arguments, the cache, atomic files, displays, the registry.
* ``systems``: what the user states: formulas, Lagrangians, Hamiltonians, constraints, bodies, events.
* ``methods``: tables of numbers, discretisations, controllers of step sizes.
* ``codegen``: the way to C: intermediate form, lowering, statements of steps, rendering of ``templates/``, compilers.
* ``runs``: states, steps, runs, events, ensembles, accuracy, results, recordings; ``compile_stepper``.
* ``interfaces``: command line, model files, packages, FMU.
* ``api``: what extras may use of the rooms above: at most 60 names in nine modules.
* ``extras``: products on top, a folder each: robots, fields, pictures, chaos, orbits, verification and others.

Names are imported when they are first used, so code that only steps never imports SymPy.
"""

import importlib
import re
from pathlib import Path
from typing import Any

from scvi_codegen.version import __version__ as __version__

_STUB = Path(__file__).with_name("__init__.pyi").read_text(encoding="utf-8")
_HOME_OF: dict[str, str] = {name: home for home, name in re.findall(r"^from (\S+) import ([A-Za-z]\w*)", _STUB, re.M)}
"""Modules of the public names, which type checkers read from the same list."""

__all__ = [*sorted(_HOME_OF)]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
