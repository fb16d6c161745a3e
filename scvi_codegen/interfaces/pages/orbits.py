"""Data of a page that moves along a family of periodic orbits."""

from dataclasses import replace
from typing import Any

from scvi_codegen.analysis.orbits.family import Family
from scvi_codegen.analysis.orbits.solver import ERROR
from scvi_codegen.common.errors import MethodError, StateError
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.pictures.family import sizes_of

SECONDS, STEPS = 6, 64
"""Duration of the first period at the speed that the page begins with, and its least number of adaptive steps."""


def begun_at(model: Model, family: Family) -> Model:
    """Return a model that begins at the first orbit of a family, with its speed and the range of its parameter."""
    first, page, name = family[0], dict(model.page), model.system.name
    if first.stepper.interface.system != name:
        raise StateError(f"the family is one of '{first.stepper.interface.system}', not of '{name}'")
    if model.array_system is not None:
        raise MethodError(f"a page of a family requires named coordinates: unroll '{name}' (unroll_sums)")
    if family.parameter is not None:
        values = [*family.values.tolist(), model.parameters[family.parameter]]
        page["ranges"] = {family.parameter: (min(values), max(values)), **page.get("ranges", {})}
    page.setdefault("speed", float(f"{first.period / SECONDS:.1g}"))
    if model.h is None and model.tolerance is None:
        model = replace(model, tolerance=ERROR, error=None, max_step=first.period / STEPS)
    return replace(model, q=first.q, p=first.p, velocity=None, t=first.t, page=page)


def described(family: Family, *, from_momenta: bool) -> dict[str, Any]:
    """Return the orbits and bifurcations of a family in their order, as the scripts of the page read them."""
    places = [(k, "", orbit) for k, orbit in enumerate(family)]
    places += [(found.after, found.kind, found.orbit) for found in family.bifurcations]
    places.sort(key=lambda place: place[0])  # stable: bifurcations are after the orbit before them
    name, sizes = sizes_of([orbit for _, _, orbit in places])
    entries = []
    for (_, kind, orbit), moduli in zip(places, sizes, strict=True):
        rates = orbit.p if from_momenta else orbit.stepper.velocity(orbit.q, orbit.p, orbit.t, orbit.parameters)
        state = {name: values.tolist() for name, values in (("q", orbit.q), ("v", rates), ("p", orbit.p))}
        state["parameters"] = dict(zip(orbit.stepper.parameters, orbit.parameters.tolist(), strict=False))
        numbers = {"value": family.value_of(orbit), "period": orbit.period, "energy": orbit.energy}
        text = kind or ("stable" if orbit.stable else "unstable")
        entries.append({**state, **numbers, "kind": text, "bifurcation": bool(kind), "sizes": moduli.tolist()})
    return {"value": family.parameter or "energy", "sizes": name, "orbits": entries}
