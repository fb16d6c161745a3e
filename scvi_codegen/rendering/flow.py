"""Many steps as one function in C, with its derivatives, behind the text that has those of a step.

Support headers hold all of it: ``flow.h`` the function, ``xla_flow.h`` and ``casadi_flow.h`` how frameworks call it.
"""

from __future__ import annotations

from dataclasses import replace

from scvi_codegen.rendering.environment import support_text
from scvi_codegen.rendering.source import Source, included

__all__ = ["casadi_name", "with_casadi_flow", "with_xla_flow"]

XLA_PARTS = ("states", "push", "pull")
"""Values, changes of values, slopes by what is given."""


def with_xla_flow(derivatives: Source, version: str) -> Source:
    """A text with derivatives of steps, and the flow as XLA calls it, ``<prefix>_xla_states``, ``_push``, ``_pull``.

    Args:
        derivatives: the text.
        version: of the library whose ``xla/ffi/api/c_api.h`` it is compiled with; a text belongs to one of them.
    """
    handlers = "".join(f"void *{derivatives.prefix}_xla_{part}(void *frame);\n" for part in XLA_PARTS)
    return _behind(derivatives, f"\n/* For jaxlib {version}. */\n", "xla_flow", handlers)


def casadi_name(prefix: str) -> str:
    """Of the function that CasADi finds in a library."""
    return f"{prefix}_flow"


def with_casadi_flow(derivatives: Source, steps: int, every: int) -> Source:
    """A text with derivatives of steps, and the flow of so many, with its own, by CasADi's naming convention."""
    name = casadi_name(derivatives.prefix)
    fixed = f"\nenum {{\n  FLOW_STEPS = {steps},\n  FLOW_EVERY = {every}\n}};\n\n"
    return _behind(derivatives, f"{fixed}#define EXTERNAL(before, after) before##{name}##after\n\n", "casadi_flow", "")


def _behind(source: Source, text: str, header: str, declarations: str) -> Source:
    tail = f'{text}#include "support/flow.h"\n#include "support/{header}.h"\n'
    support = tuple((name, support_text(name)) for name in included(tail))
    return replace(
        source,
        code=source.code + tail,
        declarations=source.declarations + declarations,
        support=(*source.support, *support),
    )
