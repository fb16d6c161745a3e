"""Many steps as one function in C, with its derivatives, behind the text that has those of a step.

Support headers hold all of it: ``flow.h`` the function, ``xla_flow.h`` and ``casadi_flow.h`` how frameworks call it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scvi_codegen.rendering.environment import support_text
from scvi_codegen.rendering.source import Source, included

__all__ = ["casadi_name", "with_casadi_flow", "with_flow_of_rows", "with_xla_flow"]

XLA_PARTS = ("states", "push", "pull")
"""Values, changes of values, slopes by what is given."""
XLA_SECOND = "bend"
"""Changes of slopes by what is given."""


def with_xla_flow(derivatives: Source, version: str, *, second: bool = False) -> Source:
    """A text with derivatives of steps, and the flow as XLA calls it, ``<prefix>_xla_states``, ``_push``, ``_pull``.

    Args:
        derivatives: the text.
        version: of the library whose ``xla/ffi/api/c_api.h`` it is compiled with; a text belongs to one of them.
        second: whether the text has second derivatives, for ``_bend``.
    """
    parts = (*XLA_PARTS, *([XLA_SECOND] if second else ()))
    handlers = "".join(f"void *{derivatives.prefix}_xla_{part}(void *frame);\n" for part in parts)
    headers = ("flow", "xla_flow", *(("flow_second", "xla_second") if second else ()))
    return _behind(derivatives, f"\n/* For jaxlib {version}. */\n", headers, handlers)


def with_flow_of_rows(derivatives: Source, *, second: bool = False) -> Source:
    """A text with derivatives of steps, and the flow of many rows, ``<prefix>_flow_rows``.

    Args:
        derivatives: the text.
        second: whether it has second derivatives, for ``<prefix>_bend_rows``.
    """
    prefix = derivatives.prefix
    shape, rest = (
        "long long steps, long long every, int count, long long rows",
        f"double *found, {prefix}_report *report",
    )
    declared = f"int {prefix}_flow_rows(int part, {shape}, const double *x, const double *given, {rest});\n"
    if second:
        declared += (
            f"int {prefix}_bend_rows({shape}, const double *x, const double *slopes, const double *changes, {rest});\n"
        )
    headers = ("flow", "rows_flow", *(("flow_second", "rows_second") if second else ()))
    return _behind(derivatives, "\n", headers, declared)


def casadi_name(prefix: str) -> str:
    """Of the function that CasADi finds in a library."""
    return f"{prefix}_flow"


def with_casadi_flow(derivatives: Source, steps: int, save_every: int, *, second: bool = False) -> Source:
    """A text with derivatives of steps, and the flow of so many, with its own, by CasADi's naming convention.

    Args:
        derivatives: the text.
        steps: how many; save_every: so many from one kept state to the next.
        second: whether the text has second derivatives, for the Jacobian of the adjoint.
    """
    name = casadi_name(derivatives.prefix)
    fixed = f"\nenum {{\n  FLOW_STEPS = {steps},\n  FLOW_EVERY = {save_every}\n}};\n\n"
    headers = ("flow", "casadi_flow", *(("flow_second", "casadi_second") if second else ()))
    return _behind(derivatives, f"{fixed}#define EXTERNAL(before, after) before##{name}##after\n\n", headers, "")


def _behind(source: Source, text: str, headers: Sequence[str], declarations: str) -> Source:
    tail = text + "".join(f'#include "support/{header}.h"\n' for header in headers)
    support = tuple((name, support_text(name)) for name in included(tail))
    return replace(
        source,
        code=source.code + tail,
        declarations=source.declarations + declarations,
        support=(*source.support, *support),
    )
