"""Lagrangian density of fields, and its discretisation in space."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, replace
from inspect import signature
from math import isfinite
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.api.checks import checks_arguments
from scvi_codegen.api.formulas import TIME, check_names, parse_expression, symbol
from scvi_codegen.api.systems import ArraySystem
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.extras.fields.assembly import Assembly
from scvi_codegen.extras.fields.axes import NATURAL, PERIODIC, Axis, FiniteDifferences, Fourier, SpectralElements
from scvi_codegen.extras.fields.density import Density, derivatives_of
from scvi_codegen.extras.fields.jumps import warn_of_jumps
from scvi_codegen.extras.fields.laws import FieldDerivation, derivation_of
from scvi_codegen.extras.fields.mesh import MeshSystem

CLAMPED = "clamped"
MOST_AXES = 3
SHORTEST_AXIS, LONGEST_AXIS = 1e-50, 1e50
"""Bounds of lengths, whose fourth powers must be numbers."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FieldSystem(Density):
    """Lagrangian density L(u, u_t, u_x, .., x, .., t; parameters) of fields on an interval, rectangle or box.

    A Hamiltonian density H(u, p, u_x, p_x, ..) describes fields of first order in time, u_t = dH/dp, p_t = -dH/du, with
    variational derivatives. Build it with :meth:`from_text` or :meth:`from_sympy`; :meth:`discretise` returns a system
    that :func:`~scvi_codegen.compile_stepper` compiles. The attributes are those of
    :class:`~scvi_codegen.extras.fields.density.Density`.
    """

    @classmethod
    @checks_arguments(SystemDefinitionError)
    def from_text(
        cls,
        name: str,
        fields: Sequence[str],
        space: Mapping[str, Sequence[Any]],
        density: str | None = None,
        *,
        hamiltonian: str | None = None,
        momenta: Sequence[str] = (),
        boundary: Mapping[str, Any] | None = None,
        parameters: Mapping[str, float] | None = None,
        dissipation: str | None = None,
        scalars: Sequence[str] = (),
        point_lagrangians: Sequence[Mapping[str, Any]] = (),
    ) -> FieldSystem:
        """Read a density from text of the grammar in :mod:`scvi_codegen.systems.formulas.grammar`.

        Args:
            name: name of the system.
            fields: names of the fields, functions of time and of the axes.
            space: lower and upper bound by axis, numbers or formulas of numbers: ``{"x": (0, "2*pi")}``; one to three
                axes.
            density: L in the fields, their derivatives ``u_t``, ``u_x``, ``u_xx``, ``u_xy``, .., the axes and the time.
            hamiltonian: in place of it the density of H in the fields, momenta, and their derivatives in space.
            momenta: names of the conjugate fields of H.
            boundary: ``"periodic"`` by axis, or two ends. An end is ``"natural"`` (dL/du_x = 0; Neumann), or the
                prescribed value: a number or a formula in t and parameters (Dirichlet), or these by field,
                ``{"u": "sin(t)", "v": 0}``. Beams are also clamped, ``"clamped"`` or ``{"u": "sin(t)", "u_x": 0}``;
                at other ends dL/du_xx = 0. By default natural ends.
            parameters: default value by name.
            dissipation: Rayleigh density of velocities, axes and parameters, whose forces -dD/du_t are added to those
                of L; ``"100*x**4*u_t**2/2"`` absorbs waves at an end.
            scalars: names of coordinates beside the fields, functions of time.
            point_lagrangians: Lagrangians of fields at places, which are added to the integral of the density: masses,
                springs, defects. They contain fields, scalars, their velocities, t and parameters:
                ``{"x": 0.5, "lagrangian": "m*X_t**2/2 - k*(u - X)**2/2"}``.

        Raises:
            SystemDefinitionError: naming the symbol, if the density is outside the grammar, not regular in the
                velocities, or an axis or boundary is malformed.

        >>> waves = FieldSystem.from_text("waves", ["u"], {"x": (0, 1)}, "u_t**2/2 - u_x**2/2", boundary={"x": (0, 0)})
        >>> waves.euler_lagrange()["u"]
        Eq(Derivative(u(x, t), (t, 2)), Derivative(u(x, t), (x, 2)))
        """
        text = density if hamiltonian is None else hamiltonian
        if text is None or (density is not None and hamiltonian is not None):
            raise SystemDefinitionError("give exactly one of density and hamiltonian")
        variables = (*fields, *momenta)
        _check_derivatives(text, variables, space, parameters or {})
        values = {key: ArraySystem.parameter_value(key, value) for key, value in (parameters or {}).items()}
        _check_counts(space, fields, momenta, first_order=hamiltonian is not None)
        rates = [f"{field}_{TIME}" for field in fields if hamiltonian is None]
        derivatives = [*rates, *derivatives_of(variables, [*space])]
        check_names(variables, (*values, *space, *derivatives), ())
        symbols = {key: symbol(key) for key in (*variables, *derivatives, *space, TIME, *values)}
        system = cls(
            name=name,
            fields=tuple(fields),
            momenta=tuple(momenta),
            space={axis: _bounds(axis, ends) for axis, ends in space.items()},
            boundary=_boundaries(boundary or {}, space, variables, {key: symbols[key] for key in (TIME, *values)}),
            parameters=tuple(symbols[key] for key in values),
            defaults=tuple(values.values()),
            density=parse_expression(text, symbols),
        )
        for key, value in (("dissipation", dissipation), ("point_lagrangians", point_lagrangians)):
            if hamiltonian is not None and value:
                raise SystemDefinitionError(f"'{name}' has a Hamiltonian density, which has no {key}=: omit it")
        if dissipation is not None:
            symbols = {variable.name: variable for variable in (*system.rates, *map(symbol, space), *system.parameters)}
            system = replace(system, dissipation=parse_expression(dissipation, symbols))
        check_names((*fields, *scalars), (*map(str, system.parameters), *system.derivatives, *space), ())
        at_places = tuple(_at_place(system, scalars, entry) for entry in point_lagrangians)
        return replace(system, scalars=tuple(scalars), point_lagrangians=at_places)

    @classmethod
    @checks_arguments(SystemDefinitionError)
    def from_sympy(
        cls,
        *,
        name: str,
        fields: Sequence[Expr],
        space: Mapping[str, Sequence[Any]],
        density: Expr | None = None,
        hamiltonian: Expr | None = None,
        momenta: Sequence[Expr] = (),
        boundary: Mapping[str, Any] | None = None,
        parameters: Mapping[str, float] | None = None,
        dissipation: Expr | None = None,
        scalars: Sequence[Expr] = (),
        point_lagrangians: Sequence[Mapping[str, Any]] = (),
    ) -> FieldSystem:
        """Create the system from SymPy expressions in functions ``u(x, t)`` and their derivatives.

        Args:
            name, space, boundary, parameters: as of :meth:`from_text`.
            fields, momenta: functions of the axes and of the time, ``Function("u")(x, t)``.
            density, hamiltonian, dissipation: L, or in place of it H, and the Rayleigh density.
            scalars: functions of the time, ``Function("X")(t)``.
            point_lagrangians: as of :meth:`from_text`, with expressions in fields, scalars and their velocities.

        >>> from sympy import Function, symbols
        >>> x, t = symbols("x t")
        >>> u = Function("u")(x, t)
        >>> density = (u.diff(t)**2 - u.diff(x)**2)/2
        >>> FieldSystem.from_sympy(name="waves", fields=[u], space={"x": (0, 1)}, density=density)
        FieldSystem(name='waves', fields=('u',), space={'x': (0.0, 1.0)})
        """
        for function in (*fields, *momenta, *scalars):
            arguments = [TIME] if function in scalars else [*space, TIME]
            if missing := set(arguments) - set(map(str, function.args)):
                raise SystemDefinitionError(f"{function} must be a function of '{min(missing)}'")

        def text(formula: Any) -> str | None:
            if formula is None:
                return None
            names: dict[Expr, Expr] = {u: symbol(str(u.func)) for u in (*fields, *momenta, *scalars)}
            for derivative in formula.atoms(sympy.Derivative):
                orders = {str(axis): int(order) for axis, order in derivative.variable_count}
                letters = "".join(axis * orders.get(axis, 0) for axis in (*space, TIME))
                names[derivative] = symbol(f"{derivative.expr.func}_{letters}")
            return ArraySystem.formula_text(formula.xreplace(names))

        return cls.from_text(
            name,
            [str(function.func) for function in fields],
            space,
            text(density),
            hamiltonian=text(hamiltonian),
            momenta=[str(function.func) for function in momenta],
            boundary=boundary,
            parameters=parameters,
            dissipation=text(dissipation),
            scalars=[str(function.func) for function in scalars],
            point_lagrangians=[
                {key: text(entry) if key == "lagrangian" else entry for key, entry in place.items()}
                for place in point_lagrangians
            ],
        )

    def euler_lagrange(self) -> dict[str, Expr]:
        """Return u_tt of each field by the Euler-Lagrange equation d/dt dL/du_t = dL/du - sum d/dx dL/du_x + .."""
        if self.momenta:
            raise SystemDefinitionError(f"'{self.name}' has a Hamiltonian density, whose equations are of first order")
        return dict(self.derive().equations)

    def derive(self) -> FieldDerivation:
        """Return the equations of motion and the local conservation laws of the symmetries of the density.

        The symmetries tested are translations in time and space, shifts and rotations of fields, Lorentz and Galilei
        transformations.

        >>> waves = FieldSystem.from_text("waves", ["u"], {"x": (0, 1)}, "u_t**2/2 - u_x**2/2 - u**4/4")
        >>> print(waves.derive().to_text(), end="")
        waves: L = -u**4/4 + u_t**2/2 - u_x**2/2
        <BLANKLINE>
        Euler-Lagrange equations
          u_tt = -u**3 + u_xx
        <BLANKLINE>
        conservation laws, d/dt Jt + d/dx Jx = 0
          energy: translation in t
            Jt = u**4/4 + u_t**2/2 + u_x**2/2
            Jx = -u_t*u_x
          momentum_x: translation in x
            Jt = -u_t*u_x
            Jx = -u**4/4 + u_t**2/2 + u_x**2/2
          boost_x: Lorentz transformation along x
            Jt = t*u_t*u_x + u**4*x/4 + u_t**2*x/2 + u_x**2*x/2
            Jx = t*u**4/4 - t*u_t**2/2 - t*u_x**2/2 - u_t*u_x*x
        """
        return derivation_of(self)

    def discretise(self, method: str, **options: Any) -> MeshSystem:
        """Return the semi-discrete Lagrangian system on a mesh.

        Args:
            method: ``"spectral-elements"`` with ``degree=`` and ``elements=``, the number of equal elements or their
                ends, which should contain the places where coefficients jump; ``"legendre"``, one element of
                ``degree=``; ``"finite-differences"`` (periodic) with ``order=`` 2, 4, 6 or 8 and ``points=``;
                ``"fourier"`` (periodic) with ``points=`` and optionally ``derivative=``, ``"fft"`` or ``"dense"`` (at
                most 64 points unless the density is quadratic in the derivatives): fast Fourier transforms or matrices,
                by default transforms of 32 points or more, of odd numbers 65.
            options: as above; a mapping gives each axis its own value, ``points={"x": 64, "y": 32}``.

        Raises:
            SystemDefinitionError: if an option is missing or unknown, or the method does not suit the boundary or the
                density.
        """
        if not isinstance(method, str) or method not in DISCRETISATIONS:
            methods = ", ".join(DISCRETISATIONS)
            raise SystemDefinitionError(f"there is no discretisation '{method}'; possible: {methods}")
        _, _, *accepted = signature(DISCRETISATIONS[method]).parameters.values()
        names = [option.name for option in accepted]
        for name in options:
            if name not in names:
                raise SystemDefinitionError(f"'{method}' has no option '{name}'; it has {' and '.join(names)}")
        axes = {}
        for axis in self.space:
            values = {}
            for option in accepted:
                value = options.get(option.name)
                value = value.get(axis) if isinstance(value, Mapping) else value
                if value is None and option.default is option.empty:
                    raise SystemDefinitionError(f"'{method}' needs {option.name}= for the axis '{axis}'")
                values[option.name] = value
            axes[axis] = DISCRETISATIONS[method](self, axis, **values)
        if not all(axis.pairs for axis in axes.values()):
            self._check_canonical_pairs(method)
        warn_of_jumps(self, axes)
        return Assembly(self, axes).result({"method": method, **options})

    def _check_canonical_pairs(self, method: str) -> None:
        """Raise an error for a density of u = p + c q_x alone, without lower bound, as that of Korteweg-de Vries."""
        for q, p in zip(self.fields, self.momenta, strict=bool(self.momenta)):
            at_rest = {symbol(name): 0 for name in (*self.derivatives, *self.fields)}
            potential = self.density.xreplace(at_rest).as_poly(symbol(p))
            for axis in self.space:
                by_q, by_p = (self.density.diff(symbol(name)) for name in (f"{q}_{axis}", p))
                ratio = sympy.cancel(by_q / by_p) if by_q != 0 and by_p != 0 else sympy.S.Zero
                alone = ratio != 0 and not ratio.free_symbols - set(self.parameters)
                if alone and potential is not None and potential.degree() > 2 and potential.degree() % 2:
                    raise SystemDefinitionError(
                        f"the Hamiltonian density of '{self.name}' depends on {p} + ({ratio})*{q}_{axis} alone and has "
                        f"no lower bound: with '{method}', whose derivatives are not exactly antisymmetric and equal "
                        "at all points, errors grow until the run fails. Use 'fourier' with an odd number of points"
                    )


def _check_derivatives(
    text: str, variables: Sequence[str], space: Iterable[str], parameters: Mapping[str, float]
) -> None:
    """Raise an error if a text contains a derivative of a field that densities cannot contain."""
    fields, letters = ("|".join(map(re.escape, names)) for names in (variables, (*space, TIME)))
    for match in re.finditer(rf"\b({fields})_((?:{letters})+)\b", text):
        _check_derivative(match[0], match[1], [*space], parameters)


def _check_counts(space: Sized, fields: Sized, momenta: Sized, *, first_order: bool) -> None:
    """Raise an error for a number of axes or momenta that densities cannot have."""
    if not 1 <= len(space) <= MOST_AXES:
        raise SystemDefinitionError(f"space has {len(space)} axes; one to three are supported")
    required = len(fields) if first_order else 0
    if len(momenta) != required:
        raise SystemDefinitionError(
            f"there are {len(fields)} fields and {len(momenta)} momenta: a Hamiltonian density needs one momentum "
            "by field, a Lagrangian density none"
        )


def _check_derivative(name: str, field: str, axes: Sequence[str], parameters: Mapping[str, float]) -> None:
    """Raise an error for a derivative of a field that densities cannot contain."""
    if name in {*derivatives_of([field], axes), f"{field}_{TIME}", *parameters}:
        return
    letters = name.removeprefix(f"{field}_")
    if TIME in letters:
        raise SystemDefinitionError(
            f"the density contains {name}: of the derivatives in time only the first, {field}_{TIME}, is supported; "
            "integrate higher ones by parts, or describe their momenta by hamiltonian="
        )
    raise SystemDefinitionError(
        f"the density contains {name}: derivatives in space have order 1 or 2, with axes in the order of space=: "
        f"{', '.join(derivatives_of([field], axes))}"
    )


def _bounds(axis: str, ends: Any) -> tuple[float, float]:
    """Return the lower and upper bound of an axis."""
    if isinstance(ends, str) or not isinstance(ends, Collection) or len(ends) != 2:
        raise SystemDefinitionError(f"the axis '{axis}' needs a lower and an upper bound, not {ends!r}")
    lower, upper = (float(parse_expression(str(end), {})) for end in ends)
    if not (isfinite(lower) and isfinite(upper) and lower < upper):
        raise SystemDefinitionError(f"the bounds of the axis '{axis}' must be finite and ascending, not {ends!r}")
    if not SHORTEST_AXIS <= upper - lower <= LONGEST_AXIS:
        raise SystemDefinitionError(
            f"the axis '{axis}' has the length {upper - lower:g}, and must have one from {SHORTEST_AXIS:g} to "
            f"{LONGEST_AXIS:g}: choose other units of length"
        )
    return lower, upper


def _boundaries(
    boundary: Mapping[str, Any], space: Iterable[str], fields: Sequence[str], symbols: Mapping[str, Symbol]
) -> dict[str, Any]:
    """Return the boundary of each axis; by default both ends are natural."""
    for axis in boundary:
        if axis not in space:
            raise SystemDefinitionError(f"there is no axis '{axis}', as in boundary. Axes: {', '.join(space)}")
    return {axis: _boundary(axis, boundary.get(axis, NATURAL), fields, symbols) for axis in space}


def _boundary(axis: str, boundary: Any, fields: Sequence[str], symbols: Mapping[str, Symbol]) -> Any:
    """Return ``"periodic"``, or for each end ``"natural"`` or the prescribed value by field."""
    if boundary in (PERIODIC, NATURAL):
        return PERIODIC if boundary == PERIODIC else (NATURAL, NATURAL)
    if isinstance(boundary, str) or not isinstance(boundary, Collection) or len(boundary) != 2:
        raise SystemDefinitionError(
            f'the boundary of \'{axis}\' must be "periodic" or two ends, each "natural" or a value, not {boundary!r}'
        )
    ends: list[Any] = []
    for end in boundary:
        if end == NATURAL:
            ends.append(NATURAL)
            continue
        gradients = [f"{field}_{axis}" for field in fields]
        values = dict(end) if isinstance(end, Mapping) else dict.fromkeys(fields, end)
        values = dict.fromkeys((*fields, *gradients), 0) if end == CLAMPED else values
        if set(values) not in ({*fields}, {*fields, *gradients}) or any(
            values.get(gradient, 0) != 0 for gradient in gradients
        ):
            raise SystemDefinitionError(f"an end of '{axis}' has values of {sorted(values)}, not of {sorted(fields)}")
        ends.append({name: parse_expression(str(value), symbols) for name, value in values.items()})
    return tuple(ends)


def _at_place(system: Density, scalars: Sequence[str], entry: Any) -> tuple[Mapping[str, float], Expr]:
    """Return place and formula of a point Lagrangian."""
    if not isinstance(entry, Mapping) or {*entry} != {*system.space, "lagrangian"}:
        keys = ", ".join(f'"{axis}": ..' for axis in system.space)
        raise SystemDefinitionError(
            f'a point Lagrangian needs a place and a formula, {{{keys}, "lagrangian": ".."}}, not {entry!r}'
        )
    place = {axis: float(parse_expression(str(entry[axis]), {})) for axis in system.space}
    for axis, (start, end) in system.space.items():
        if not start <= place[axis] <= end:
            raise SystemDefinitionError(
                f"the point Lagrangian at {axis} = {place[axis]:g} is outside of the axis, {start:g} to {end:g}: "
                "give a place inside"
            )
    rates = [f"{coordinate}_{TIME}" for coordinate in (*system.fields, *scalars)]
    names = (*system.fields, *scalars, *rates, TIME, *map(str, system.parameters))
    return place, parse_expression(str(entry["lagrangian"]), {name: symbol(name) for name in names})


DISCRETISATIONS: Mapping[str, Callable[..., Axis]] = {
    "spectral-elements": SpectralElements.of,
    "legendre": SpectralElements.one,
    "finite-differences": FiniteDifferences.of,
    "fourier": Fourier.of,
}
"""Function that discretises an axis of a field system, with its options, by the name of the discretisation."""
