"""Public names: references to defining modules resolve to ``scvi_codegen.NAME``; tables of the names of pages.

```{names} systems
``` is a table of the names that ``reference/systems.md`` documents, with the first line of each docstring.
"""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.docutils import SphinxDirective

import scvi_codegen

__all__ = ["setup"]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the event handler with Sphinx."""
    app.connect("missing-reference", _resolve)
    app.add_directive("names", Names)
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


class Names(SphinxDirective):
    """Table of the names that pages of the reference document."""

    required_arguments, final_argument_whitespace = 1, True

    def run(self) -> list[nodes.Node]:
        """Return the table."""
        lines = ["| name | |", "| --- | --- |"]
        for page in self.arguments[0].split():
            path = Path(self.env.doc2path(f"reference/{page}"))
            self.env.note_dependency(str(path))
            text = path.read_text(encoding="utf-8")
            for name in re.findall(r"^\.\. auto\w+:: (\w+)", text, re.MULTILINE):
                object_ = getattr(scvi_codegen, name)
                first = (
                    "Catalogue of problems, by name."
                    if isinstance(object_, dict)
                    else (object_.__doc__ or "").strip().partition("\n")[0]
                )
                first = re.sub(r":\w+:`[~.]?([^`]*)`|``(.*?)``", r"`\1\2`", first)
                first = first.replace("|", "\\|")
                lines.append(f"| {{py:obj}}`{name} <scvi_codegen.{name}>` | {first} |")
        node = nodes.Element()
        source = self.get_source_info()[0]
        self.state.nested_parse(StringList(lines, source), self.content_offset, node)
        return list(node.children)
