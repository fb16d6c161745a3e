"""Where the templates are, and where the package itself is: what a text depends on beside its system."""

from __future__ import annotations

from pathlib import Path

__all__ = ["PACKAGE", "template_folder"]

PACKAGE = Path(__file__).parents[1]


def template_folder() -> Path:
    """The templates: inside the installed package, or beside it in a checkout."""
    for folder in (PACKAGE / "templates", PACKAGE.parent / "templates"):
        if (folder / "stepper.c.jinja").is_file():
            return folder
    raise FileNotFoundError("the C templates are missing: reinstall scvi-codegen")
