"""Flow map as a CasADi external function in C, and stage equations of a step as CasADi expressions.

The flow map has derivatives, for trajectory optimisation and estimation. The stage equations of a method
(:mod:`scvi_codegen.methods.stage_system`) are kernels and tables; here they are evaluated with CasADi's scalar symbols,
as constraints of a nonlinear program, so that Jacobians and Hessians of any order are exact and sparse, and its maps,
root finders and code generation apply. Formulas in the states at the ends of steps, and the Legendre transform between
v and p, are CasADi functions, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from math import comb
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.api.checks import Kind, checked_count, checks_arguments
from scvi_codegen.api.formulas import Intermediate, input_parameters, parse_expression, symbol
from scvi_codegen.api.methods import Discretisation, Method, StageSystem
from scvi_codegen.api.systems import MechanicalSystem, forms_of
from scvi_codegen.common.errors import ArgumentError, MethodError, StateError, imported
from scvi_codegen.extras.frameworks.flow import Flow
from scvi_codegen.extras.frameworks.sources import casadi_name, with_casadi_flow
from scvi_codegen.methods import as_method
from scvi_codegen.runs.stepper import Stepper

FLOW_ARGUMENTS = ("q", "p", "parameters", "t", "h")


@checks_arguments(StateError, stepper=Kind.of("a compiled stepper", Stepper))
def casadi_flow(stepper: Stepper, *, steps: int, save_every: int | None = None, hessian: bool = False) -> Any:
    """Return a fixed number of steps of a stepper as a ``casadi.Function``.

    It is an external function in compiled C, which CasADi calls without Python, with Jacobian and adjoint in CasADi's
    naming convention: ``jacobian``, ``gradient``, ``jtimes``, ``map`` and nonlinear programs accept it. Derivatives are
    those of the computed map, exact up to round-off. Second derivatives require ``hessian``; without them pass
    ``{"ipopt.hessian_approximation": "limited-memory"}`` to IPOPT, or use steps as constraints
    (:func:`optimal_control`).

    Args:
        stepper: compiled stepper.
        steps: number of steps.
        save_every: save the initial state and every ``save_every``-th one; by default only the final state.
        hessian: derive and compile exact second derivatives, too.

    Returns:
        A ``casadi.Function`` of q (m), p (m), parameters (k), such as ``stepper.defaults``, t and h, by position or by
        name; t defaults to 0. Its values q1 and p1 are (m), with ``save_every`` (m, n), states in columns. If a step
        fails, the call fails, and solvers shorten their step. States that violate the constraints are not projected;
        the first step moves them onto the constraint manifold.

    Raises:
        MethodError: in transformed time, for steps of a time-rescaling function, and for second derivatives with
            damping.
        MissingLibraryError: without CasADi (extra ``casadi``).
        StateError: if ``steps`` is not a multiple of ``save_every``.
    """
    flow = Flow.checked(stepper, steps, save_every)
    ca = imported("casadi", "casadi")
    derivatives = flow.second_derivatives if hessian else flow.derivatives
    source = with_casadi_flow(derivatives, flow.steps, flow.spacing, second=hessian)
    library = stepper.products.library(source)
    name, m = casadi_name(source.prefix), stepper.dimension
    sizes = (m, m, len(stepper.interface.parameters), 1, 1)
    arguments = [ca.MX.sym(word, size) for word, size in zip(FLOW_ARGUMENTS, sizes, strict=True)]
    states = ca.external(name, str(library.path))(ca.vertcat(*arguments))
    states = states[:, -1] if flow.save_every is None else states
    result = [states[:m, :], states[m:, :]]
    missing = float("nan")
    defaults = [missing, missing, missing if stepper.interface.parameters else 0.0, 0.0, missing]
    return ca.Function(name, arguments, result, [*FLOW_ARGUMENTS], ["q1", "p1"], {"default_in": defaults})


@dataclass(frozen=True)
class EndConditions:
    """Functions of q, v, p, t and the parameters, without inputs, at the beginning or the end of a step."""

    ca: Any
    system: MechanicalSystem

    @cached_property
    def symbols(self) -> tuple[Symbol, ...]:
        """Symbols that formulas may contain."""
        system = self.system
        return (*system.coordinates, *system.velocities, *system.momentum_symbols, system.time, *own_parameters(system))

    def formula(self, text: str) -> Any:
        """Return a formula as a function; raises ExpressionError for one outside the grammar."""
        return self._function(read([text], self.symbols))

    @cached_property
    def legendre(self) -> Any:
        """Residual of the Legendre transform, p - L_v or v - H_p; MethodError for an input, which may jump."""
        forms, system = forms_of(self.system), self.system
        conditions = forms.constitutive or tuple(map(sympy.Add, system.momentum_symbols, (-p for p in forms.momentum)))
        if any(condition.free_symbols - {*self.symbols} for condition in conditions):
            raise MethodError("momenta depend on an input and would jump with it: use inputs only in forces")
        return self._function(conditions)

    @cached_property
    def constraint_residual(self) -> Any:
        """Residual of the constraints g(q) = 0 and of their time derivatives; MethodError if they contain an input."""
        conditions = (*forms_of(self.system).position_conditions, *forms_of(self.system).constraint_rates)
        residuals = [condition for condition in conditions if condition != 0]
        if any(residual.free_symbols - {*self.symbols} for residual in residuals):
            raise MethodError("a constraint depends on an input and would jump with it: use inputs only in forces")
        return self._function(residuals)

    def momentum(self, q: Any, v: Any, t: Any, parameters: Any) -> Any:
        """Return the momentum of a velocity: exact if H is quadratic in p, otherwise an initial guess."""
        return self._updated("by_p", q=q, v=v, p=self.ca.DM.zeros(*q.shape), t=t, parameters=parameters)

    def velocity(self, q: Any, p: Any, t: Any, parameters: Any) -> Any:
        """Return the velocity of a momentum: exact if L is quadratic in v, otherwise an initial guess."""
        return self._updated("by_v", q=q, v=self.ca.DM.zeros(*q.shape), p=p, t=t, parameters=parameters)

    def _updated(self, derivative: str, **values: Any) -> Any:
        result = self._legendre_derivatives(**values)
        return -self.ca.solve(result[derivative], result["residual"], "qr")

    @cached_property
    def _legendre_derivatives(self) -> Any:
        """Residual of :attr:`legendre`, and its derivatives with respect to v and p."""
        arguments = self.legendre.sx_in()
        residual = self.legendre(*arguments)
        results = [residual, *(self.ca.jacobian(residual, arguments[k]) for k in (1, 2))]
        return self.ca.Function("partials", arguments, results, self.legendre.name_in(), ["residual", "by_v", "by_p"])

    def _function(self, expressions: Sequence[Expr]) -> Any:
        m, ca = self.system.dimension, self.ca
        shapes = {"q": m, "v": m, "p": m, "t": 1, "parameters": len(own_parameters(self.system))}
        arguments = [ca.SX.sym(name, size) for name, size in shapes.items()]
        result = numeric(ca, expressions, self.symbols)(*ca.vertsplit(ca.vertcat(*arguments)))
        return ca.Function("at_end", arguments, [ca.vertcat(*result)], [*shapes], ["value"])


def own_parameters(system: MechanicalSystem) -> Mapping[Symbol, float]:
    """Return the default values of the parameters that do not belong to inputs."""
    parts = input_parameters(system.inputs)
    return {name: value for name, value in system.constants.items() if name.name not in parts}


def read(texts: Sequence[str], symbols: Sequence[Symbol]) -> list[Expr]:
    """Return formulas as expressions in symbols; raises ExpressionError for one outside the grammar."""
    names = {variable.name: variable for variable in symbols}
    return [parse_expression(text, names) for text in texts]


def numeric(ca: Any, expressions: Sequence[Expr], symbols: Sequence[Symbol]) -> Callable[..., list[Any]]:
    """Return expressions as a function of CasADi's symbols, with common subexpressions shared."""
    applied = {type(part).__name__ for formula in expressions for part in formula.atoms(sympy.Function)}
    names = {name: getattr(ca, name) for name in (*applied, "sqrt", "exp") if hasattr(ca, name)}
    names |= {"rint": lambda x: ca.floor(x + 0.5), "unit_step": lambda x: x >= 0}
    constants = {"pi": math.pi, "e": math.e}
    arguments: dict[str, Any] = {
        "modules": [names | constants],
        "cse": True,
        "dummify": True,
    }  # a symbol may be called e
    plain = list(map(Intermediate.written_out, expressions))
    function: Callable[..., list[Any]] = sympy.lambdify(symbols, plain, **arguments)
    return function


ARGUMENTS = ("q", "p", "stages", "inputs", "parameters", "t", "h")
RESULTS = ("q1", "p1", "residual", "along", "integrals")
HIGHEST = 3
"""Highest degree of inputs within a step; compiled steps have cubics."""


@checks_arguments(ArgumentError, system=MechanicalSystem.KIND, along=Kind.TEXTS)
def casadi_step(
    system: MechanicalSystem, method: Method | str, *, degree: int = 0, along: Sequence[str] = (), solved: bool = False
) -> Any:
    """Return one step as equations, a ``casadi.Function``: constraints of a nonlinear program or a root finder.

    The step from (q, p) at t to t + h ends at q1 and p1 if the residual is 0; the unknowns are the stages. Nothing is
    solved or compiled; everything has exact derivatives of any order, and IPOPT can use the exact Hessian.

    Args:
        system: Lagrangian or Hamiltonian system.
        method: method, or its name.
        degree: degree of the inputs within the step, 0 (constant) to 3.
        along: formulas in coordinates, velocities (for a Hamiltonian also momenta), inputs, parameters and t, evaluated
            at the g points of the method's quadrature.
        solved: solve the equations by CasADi's Newton method at each call, to 1e-12: the step is then a map without
            stages and residual, also with second derivatives. A call fails if they are not solved.

    Returns:
        A ``casadi.Function`` by position or by name of q (m), p (m), stages (s), inputs (k, degree + 1) in Bernstein
        form (a polynomial lies between its least and largest coefficient, the first and last of which are its values at
        the ends), parameters (without those of inputs), t and h. Its values are q1 (m), p1 (m), residual (s), along
        (formulas, g), and integrals (formulas), their quadratures over the step.

    Raises:
        ExpressionError: for a formula outside the grammar.
        MethodError: for a method that does not apply to the system, formulas with a method without quadrature along a
            curve, a system in transformed time, and degrees above 3.
        MissingLibraryError: without CasADi (extra ``casadi``).

    Source: S. Ober-Bloebaum, O. Junge, J. E. Marsden, ESAIM: COCV 17 (2011) 322; C. M. Campos, S. Ober-Bloebaum,
    E. Trelat, Discrete and Continuous Dynamical Systems 35 (2015) 4193.
    """
    ca = imported("casadi", "casadi")
    if system.clock:
        raise MethodError(f"'{system.name}' is in transformed time: pass the original system")
    if checked_count(degree, "degree", least=0) > HIGHEST:
        raise MethodError(f"degree must be at most {HIGHEST} (polynomial inputs), not {degree}")
    Discretisation.warn_of_kinks(system, "casadi_step or optimal_control")
    stages = Discretisation(system, as_method(method, system)).equations
    written = _StageExpressions(ca, system, stages, degree)
    *rows, p1 = written.rows()
    values, weights = written.along(along) if along else (ca.SX(0, 0), ca.SX(0, 1))
    results = [written.end_position(), p1, ca.vertcat(*rows), values, written.h * values @ weights]
    step = ca.Function("step", written.arguments, results, [*ARGUMENTS], [*RESULTS])
    return _solved(ca, EndConditions(ca, system), stages, step) if solved else step


def _solved(ca: Any, ends: EndConditions, stages: StageSystem, step: Any) -> Any:
    """Return the step with its equations solved, without the argument stages and the result residual."""
    symbols = dict(zip(ARGUMENTS, step.sx_in(), strict=True))
    unknowns = symbols.pop("stages")
    equations = {"x": unknowns, "p": ca.veccat(*symbols.values()), "g": step(**symbols, stages=unknowns)["residual"]}
    symbols_of = {name: ca.MX.sym(name, *argument.shape) for name, argument in symbols.items()}
    q, p, t, h, parameters = (symbols_of[name] for name in ("q", "p", "t", "h", "parameters"))
    guess = ca.veccat(*stages.straight(q, ends.velocity(q, p, t, parameters), p, h))
    solution = ca.rootfinder("stages", "newton", equations)(guess, ca.veccat(*symbols_of.values()))
    results = step(**symbols_of, stages=solution)
    names = [name for name in RESULTS if name != "residual"]
    return ca.Function("step", [*symbols_of.values()], [results[name] for name in names], [*symbols_of], names)


class _StageExpressions:
    """Stage system in CasADi's symbols: gather arguments, evaluate kernels, scatter results into rows."""

    def __init__(self, ca: Any, system: MechanicalSystem, stages: StageSystem, degree: int) -> None:
        self.ca, self.system, self.stages = ca, system, stages
        m, sizes = system.dimension, stages.block_sizes(system.dimension)
        lengths = ((m, 1), (m, 1), (sum(sizes), 1), (len(system.inputs), degree + 1), (len(own_parameters(system)), 1))
        shapes = (*lengths, (1, 1), (1, 1))
        self.arguments = [ca.SX.sym(name, *shape) for name, shape in zip(ARGUMENTS, shapes, strict=True)]
        self.q, self.p, unknowns, self.inputs, self.parameters, self.t, self.h = self.arguments
        blocks = [unknowns[start:end] for start, end in pairwise(accumulate(sizes, initial=0))]
        powers = (block.power for block in stages.blocks)
        self.columns = ((0, self.q), *zip(powers, blocks, strict=True))

    def rows(self) -> list[Any]:
        sizes = self.stages.row_sizes(self.system.dimension)
        momenta = (*(row.momentum for row in self.stages.rows), self.stages.end_momentum)
        powers = (*(row.power for row in self.stages.rows), 0)
        rows = [float(c) * self.p if c else self.ca.SX(size, 1) for c, size in zip(momenta, sizes, strict=True)]
        for group in self.stages.stage_groups:
            kernel = self._kernel(group)
            for n, weight in enumerate(group.weights):
                results = iter(kernel(*self._arguments(group, n), *self._surroundings(group.abscissae[n])))
                for scatter in group.scatters:
                    values = self.ca.vertcat(*(next(results) for _ in scatter.results))
                    for r, entry in enumerate(scatter.table.entries[n]):
                        if entry:
                            factor = float(scatter.scale * weight * entry) * self._damping_factor(group.abscissae[n])
                            rows[r] += factor * self.h ** (scatter.power + powers[r]) * values
        return [*rows[:-1], rows[-1] / self._damping_factor(1)]

    def _damping_factor(self, abscissa: Any) -> Any:
        """Return the factor e^(gamma c h) of the weight at abscissa c in a system with damping gamma."""
        if self.stages.damping == 0:
            return 1.0
        rate = numeric(self.ca, [self.stages.damping], tuple(own_parameters(self.system)))
        return self.ca.exp(float(abscissa) * rate(*self.ca.vertsplit(self.parameters))[0] * self.h)

    def end_position(self) -> Any:
        return self._gathered(self.stages.end_position, 0, power=0, scale=1.0)

    def along(self, texts: Sequence[str]) -> tuple[Any, Any]:
        """Return values at the points of the quadrature, and weights; MethodError without quadrature along a curve."""
        system = self.system
        groups = [group for group in self.stages.stage_groups if group.in_action]
        curve_variables = {*system.coordinates, *system.velocities}
        if not groups or any(group.scalar_power or not curve_variables <= {*group.arguments} for group in groups):
            raise MethodError(
                "this method has no quadrature along its curve, so formulas cannot be integrated: use an SVI, SCVI or "
                "Gauss method"
            )
        inputs_constant = tuple(symbol(name) for name in system.inputs)
        around = (system.time, *own_parameters(system), *inputs_constant)
        formulas = read(texts, (*curve_variables, *system.auxiliaries, *around))
        columns, weights = [], []
        for group in groups:
            values = numeric(self.ca, formulas, (*group.arguments, *around))
            for n, (c, weight) in enumerate(zip(group.abscissae, group.weights, strict=True)):
                pushed = [parts[0] for parts in self._input_parts(float(c))]
                arguments = (*self._arguments(group, n), self._time(c), *self.ca.vertsplit(self.parameters), *pushed)
                columns.append(self.ca.vertcat(*values(*arguments)))
                weights.append(float(weight))
        return self.ca.horzcat(*columns), self.ca.SX(weights)

    def _kernel(self, group: Any) -> Callable[..., list[Any]]:
        """Return results as a function of arguments, time and parameters, inputs expanded at the point's time."""
        from_here = {symbol(f"{name}_t"): self.system.time for name in self.system.inputs}
        results = [result.xreplace(from_here) for result in group.results]
        return numeric(self.ca, results, (*group.arguments, self.system.time, *self.system.parameters))

    def _arguments(self, group: Any, n: int) -> list[Any]:
        parts = [self._gathered(g.table, n, power=g.power, scale=float(g.scale)) for g in group.gathers]
        return list(self.ca.vertsplit(self.ca.vertcat(*parts)))

    def _gathered(self, table: Any, n: int, *, power: int, scale: float) -> Any:
        """Return the product of a row of a table with q and the stages."""
        terms = [
            scale * float(entry) * self.h ** (power + shift) * values
            for entry, (shift, values) in zip(table.entries[n], self.columns, strict=True)
            if entry
        ]
        return sum(terms[1:], terms[0])

    def _time(self, abscissa: Any) -> Any:
        return self.t + float(abscissa) * self.h

    def _surroundings(self, abscissa: Any) -> list[Any]:
        """Return the time at a point of the step, and all parameters of the system there."""
        time = self._time(abscissa)
        values = dict(zip(own_parameters(self.system), self.ca.vertsplit(self.parameters), strict=True))
        for name, parts in zip(self.system.inputs, self._input_parts(float(abscissa)), strict=True):
            values |= dict(zip(map(symbol, input_parameters([name])), (*parts, time), strict=True))
        return [time, *(values[name] for name in self.system.parameters)]

    def _input_parts(self, c: float) -> list[list[Any]]:
        """Return the coefficients of each input in powers of the time since the point c."""
        # u(c + x) = sum_k x^k C(d, k) sum_j B_j^(d-k)(c) D^k b_j, D the forward difference of coefficients b.
        degree, differences, columns = self.inputs.shape[1] - 1, self.inputs, []
        for power in range(HIGHEST + 1):
            left, values = degree - power, self.ca.SX.zeros(self.inputs.shape[0], 1)
            for j in range(left + 1):
                values += comb(degree, power) * comb(left, j) * c**j * (1 - c) ** (left - j) * differences[:, j]
            columns.append(self.ca.vertsplit(values * self.h**-power))
            differences = differences[:, 1:] - differences[:, :-1] if left > 0 else differences
        return [list(parts) for parts in zip(*columns, strict=True)]
