"""Locations of the templates and of the package."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def template_folder() -> Path:
    """Return the templates: inside the installed package, or next to it in a checkout."""
    for folder in (PACKAGE / "templates", PACKAGE.parent / "templates"):
        if (folder / "stepper.c.jinja").is_file():
            return folder
    raise FileNotFoundError("the C templates are missing: reinstall scvi-codegen")
