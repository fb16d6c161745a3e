"""What the products of ``scvi_codegen.extras`` add to the core: a line for each.

An extra imports :mod:`scvi_codegen.api` and the extras above its line. The core imports no extra but asks here by kind
and name, which imports the module of the extra at the first use; without its folder an error names the extra.

============================  =====================================  =================================================
kind                          names                                  part of the extra
============================  =====================================  =================================================
commands                      of the command line, with its line     function in ``command.py``
sections                      of model files                         :class:`ModelSection` in ``section.py``
readers                       of systems and meshes                  function in ``readers.py``
steppers, runs, ensembles     methods and properties of these        member of ``OfSteppers``, .. in ``methods.py``
services                      that commands of others ask for        function in ``services.py``
============================  =====================================  =================================================

A name after another module is written ``module.name``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from inspect import getattr_static
from typing import Any

from scvi_codegen.common.errors import MissingLibraryError

PACKAGE = "scvi_codegen.extras"
MODULES = {"commands": "command", "sections": "section", "readers": "readers", "services": "services"} | dict.fromkeys(
    ("steppers", "runs", "ensembles"), "methods"
)


@dataclass(frozen=True, kw_only=True)
class Extra:
    """Names that an extra adds, by kind."""

    commands: Mapping[str, str] = field(default_factory=dict)
    sections: str = ""
    readers: str = ""
    steppers: str = ""
    runs: str = ""
    ensembles: str = ""
    services: str = ""


EXTRAS = {
    "robots": Extra(readers="files.of_urdf files.of_mjcf files.keyframe of_lagranges_method of_kanes_method of_system"),
    "fields": Extra(sections="field", readers="mesh_of"),
    "exact": Extra(),
    "pictures": Extra(runs="plot animate", ensembles="plot animate", services="check_picture is_film"),
    "fits": Extra(),
    "chaos": Extra(
        steppers="chaos_indicators_ensemble", runs="chaos_indicators lyapunov_exponents megno fli gali sali"
    ),
    "paths": Extra(commands={"path": "Find motions between two positions, and closed paths."}, steppers="path"),
    "orbits": Extra(commands={"family": "Continue periodic orbits; locate bifurcations."}),
    "derivation": Extra(commands={"derive": "Print the equations of one step of MODEL."}),
    "verification": Extra(commands={"verify": "Measure the guaranteed properties of an integrator."}),
    "pages": Extra(
        commands={"page": "Write a page that computes the motion in the browser."},
        sections="page picture",
        services="page.page",
    ),
    "frameworks": Extra(),
    "distributed": Extra(services="blocks.integrate_ensemble"),
    "advice": Extra(services="advice.advise advice.missed_tolerance"),
    "paper": Extra(commands={"reproduce": "Reproduce the paper's experiments, with verdicts."}),
}
"""The extras in the order of their imports: each may import those above."""


@cache
def homes(kind: str) -> dict[str, str]:
    """Return the modules, ``extra.module``, of all parts of a kind by their names."""
    words: Iterable[tuple[str, str]] = ((extra, word) for extra in EXTRAS for word in _words(extra, kind))
    split = [(extra, *word.rpartition(".")) for extra, word in words]
    return {name: f"{extra}.{module or MODULES[kind]}" for extra, module, _, name in split}


def _words(extra: str, kind: str) -> Iterable[str]:
    value = getattr(EXTRAS[extra], kind)
    return value.split() if isinstance(value, str) else value


def part(kind: str, name: str) -> Any:
    """Return what an extra adds: of steppers, runs and ensembles the function or property of its class.

    Raises:
        MissingLibraryError: if no extra is registered for it, or this installation is without its folder.
    """
    home = homes(kind).get(name)
    if home is None:
        raise MissingLibraryError(f"no extra of this installation adds '{name}' to {kind}")
    try:
        module = import_module(f"{PACKAGE}.{home}")
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith(PACKAGE):
            raise
        raise MissingLibraryError(
            f"'{name}' is part of the extra '{home.partition('.')[0]}', which this installation is without: "
            "install the whole package"
        ) from error
    if MODULES[kind] == "methods":
        return getattr_static(getattr(module, f"Of{kind.capitalize()}"), name)
    return getattr(module, name)
