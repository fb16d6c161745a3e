"""Partial differential equations with exact solutions: a breather, a wave in two dimensions, a soliton.

Every contender has its own mesh; its error is that of its final values at its own points, relative in root mean square.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.cases.unforced import SYSTEMS, Array, Case
from benchmarks.contenders.ours import compiled
from benchmarks.report import OURS, Contender
from scvi_codegen.extras.fields.system import FieldSystem

Points = Mapping[str, Array]
FREQUENCY = 0.6
"""Frequency of the breather."""
SPEED = 0.5
"""Speed of the soliton."""
WIDTH, MODES = 0.4, 20
"""Width of the bump, whose Fourier coefficients exp(-(k WIDTH)^2 / 2) are below round-off beyond these modes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldCase:
    """Field with its exact solution.

    Attributes:
        name: name of the section after ``fields:``.
        field: density.
        span: duration.
        exact: function from points and time to the field and its rate, or to real and imaginary part.
        settings: (discretisation, options, methods in time, numbers of steps, solver) of this package.
        pde: right-hand sides for py-pde; of a complex field one.
    """

    name: str
    field: FieldSystem
    span: float
    exact: Callable[[Points, float], tuple[Array, Array]]
    settings: Sequence[tuple[str, Mapping[str, Any], Sequence[str], Sequence[int], str]]
    pde: Mapping[str, str]

    @property
    def complex(self) -> bool:
        """True for a field of first order in time."""
        return len(self.pde) == 1

    def plain(self) -> Case:
        """Return the case of the benchmark; every contender has an error of its own."""
        zero = np.zeros((1, 1))
        system: Any = self.field
        return Case(
            name=f"fields:{self.name}", system=system, q=zero, velocity=zero, span=self.span, step=1.0, field=self
        )

    def error(self, points: Points, final: Array) -> float:
        """Return the error of final values: of the field, or of real and imaginary part."""
        exact = np.array(self.exact(points, self.span)[: 2 if self.complex else 1])
        return float(np.linalg.norm(final - exact) / np.linalg.norm(exact))


def our_fields(case: FieldCase, quick: bool) -> Iterator[Contender]:
    """Yield contenders of this package on every mesh of a case."""
    for kind, options, methods, counts, solver in case.settings[: 1 if quick else None]:
        mesh = case.field.discretise(kind, **options)
        for method in methods:
            stepper, seconds = compiled(mesh.system, method, solver)
            for steps in counts[: 2 if quick else None]:
                size = ", ".join(f"{key} {value}" for key, value in options.items())
                yield Contender(
                    method=f"{OURS} {kind} {method}{' factors' if solver == 'newton' else ''}",
                    setting=f"{size}, {steps} steps",
                    options="",
                    compile_seconds=seconds,
                    prepare=partial(_prepared, case, mesh, stepper, steps),
                    starts=1,
                    error=partial(case.error, mesh.points),
                )


def _prepared(case: FieldCase, mesh: Any, stepper: Any, steps: int, _: int) -> Callable[[], Any]:
    (name,) = case.field.fields
    first, second = case.exact(mesh.points, 0.0)
    how = {"p": {name: mesh.weights * second}} if case.complex else {"velocity": {name: second}}
    run = stepper.start({name: first}, **how, h=case.span / steps)

    def integrate() -> Callable[[], Array]:
        run.advance(steps)
        return final

    def final() -> Array:
        q = np.asarray(run.q[name])
        return np.array([q, np.asarray(run.p[name]) / mesh.weights] if case.complex else [q])

    return integrate


def _case(name: str, exact: Callable[[Points, float], tuple[Array, Array]]) -> FieldCase:
    """Return the field of the table with its exact solution."""
    table = SYSTEMS["fields"][name]
    settings = []
    for options in map(dict, table["settings"]):
        kind, methods, steps = (options.pop(key) for key in ("kind", "methods", "steps"))
        solver = options.pop("solver", "auto")
        size = "elements" if "elements" in options else "points"
        settings += [(kind, {**options, size: count}, methods, steps, solver) for count in options.pop(size)]
    space = {axis: tuple(ends) for axis, ends in table["field"]["space"].items()}
    field = FieldSystem.from_text(**table["field"] | {"space": space})
    return FieldCase(name=name, field=field, span=table["span"], exact=exact, settings=settings, pde=table["pde"])


def breather() -> FieldCase:
    """Return the breather of the sine-Gordon equation for ten units of time."""
    w, e = FREQUENCY, np.sqrt(1.0 - FREQUENCY**2)

    def exact(points: Points, t: float) -> tuple[Array, Array]:
        inner, rate = (factor / np.cosh(e * points["x"]) for factor in (e / w * np.sin(w * t), e * np.cos(w * t)))
        return 4.0 * np.arctan(inner), 4.0 * rate / (1.0 + inner**2)

    return _case("breather", exact)


def wave() -> FieldCase:
    """Return the linear wave equation on a torus: a bump that spreads and meets itself."""
    k = np.arange(-MODES, MODES + 1)
    coefficients = np.exp(-((k * WIDTH) ** 2) / 2)
    frequencies = np.hypot(k[:, np.newaxis], k)

    def exact(points: Points, t: float) -> tuple[Array, Array]:
        along = [np.cos(np.outer(axis, k)) for axis in (np.unique(points["x"]), np.unique(points["y"]))]
        both = np.outer(coefficients, coefficients)
        moving = (np.cos(frequencies * t), -frequencies * np.sin(frequencies * t))
        u, rate = (along[0] @ (both * each) @ along[1].T for each in moving)
        return u, rate

    return _case("wave-2d", exact)


def schroedinger() -> FieldCase:
    """Return the moving soliton of i psi_t = -psi_xx / 2 - |psi|^2 psi."""

    def exact(points: Points, t: float) -> tuple[Array, Array]:
        x = points["x"]
        psi = np.exp(1j * (SPEED * x + (1.0 - SPEED**2) * t / 2)) / np.cosh(x - SPEED * t)
        return psi.real, psi.imag

    return _case("schroedinger", exact)


FIELDS: Mapping[str, Callable[[], FieldCase]] = {"breather": breather, "wave-2d": wave, "schroedinger": schroedinger}
"""Functions that build a case, by the name after ``fields:``."""
