"""Resolve references to the defining module of a public name as its documented name, ``scvi_codegen.NAME``."""

from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

import scvi_codegen

__all__ = ["setup"]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the event handler with Sphinx."""
    app.connect("missing-reference", _resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _resolve(
    app: Sphinx,
    environment: BuildEnvironment,
    reference: pending_xref,
    content: nodes.Element,
) -> nodes.reference | None:
    """Return the link for a full name of a method, or ``Stepper.step``; None for other targets."""
    if reference.get("refdomain") != "py":
        return None
    parts = reference["reftarget"].split(".")
    public = next(
        (n for n, part in enumerate(parts) if part in scvi_codegen.__all__), None
    )
    if public is None or not (public == 0 or parts[0] == "scvi_codegen"):
        return None
    target = ".".join(["scvi_codegen", *parts[public:]])
    domain = environment.domains["py"]
    return domain.resolve_xref(
        environment, reference["refdoc"], app.builder, "obj", target, reference, content
    )
