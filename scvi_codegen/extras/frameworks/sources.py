"""C sources of flows, with derivatives, for JAX, PyTorch and CasADi."""

from scvi_codegen.api.program import Source
from scvi_codegen.api.runs import Products

XLA_PARTS = ("states", "jvp", "vjp")
"""XLA handlers: states, tangent vectors of states (JVP), gradients with respect to inputs (VJP)."""
XLA_SECOND_ORDER = "vjp_derivative"
"""XLA handler of derivatives of gradients."""


def with_xla_flow(derivatives: Source, version: str, *, second: bool = False) -> Source:
    """Return a source with the XLA custom calls ``<prefix>_xla_states``, ``_jvp``, ``_vjp``.

    Args:
        derivatives: a source with derivatives of steps.
        version: of the library whose ``xla/ffi/api/c_api.h`` it is compiled with; a source is specific to one version.
        second: whether to add second derivatives, ``_curvature``, which the source must have.
    """
    parts = (*XLA_PARTS, *([XLA_SECOND_ORDER] if second else ()))
    handlers = "".join(f"void *{derivatives.prefix}_xla_{part}(void *frame);\n" for part in parts)
    headers = ("flow", "xla_flow")
    return Products.with_headers(derivatives, f"\n/* For jaxlib {version}. */\n", headers, handlers, second=second)


def with_flow_of_rows(derivatives: Source, *, second: bool = False) -> Source:
    """Return a source with derivatives of steps and the flow of many rows; ``second``: with second derivatives."""
    prefix = derivatives.prefix
    shape = "long long steps, long long every, int count, long long rows"
    rest = f"double *found, {prefix}_report *report"
    declared = f"int {prefix}_flow_rows(int part, {shape}, const double *x, const double *given, {rest});\n"
    if second:
        declared += f"int {prefix}_hessian_rows({shape}, const double *x, "
        declared += f"const double *partials, const double *changes, {rest});\n"
    return Products.with_headers(derivatives, "\n#define FLOW_OF_ROWS\n", ("flow",), declared, second=second)


def casadi_name(prefix: str) -> str:
    """Return the name of the function that CasADi looks up in a library."""
    return f"{prefix}_flow"


def with_casadi_flow(derivatives: Source, steps: int, save_every: int, *, second: bool = False) -> Source:
    """Return a source with the flow of ``steps`` steps and its derivatives, by CasADi's naming convention.

    Args:
        derivatives: a source with derivatives of steps.
        steps: number of steps; save_every: steps between stored states.
        second: whether to add the Jacobian of the adjoint, from second derivatives that the source must have.
    """
    name = casadi_name(derivatives.prefix)
    fixed = f"\nenum {{\n  FLOW_STEPS = {steps},\n  FLOW_EVERY = {save_every}\n}};\n\n"
    headers = ("flow", "casadi_flow")
    return Products.with_headers(
        derivatives, f"{fixed}#define EXTERNAL(before, after) before##{name}##after\n\n", headers, "", second=second
    )
