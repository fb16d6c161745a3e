"""Names of experiments as the paper writes them, and links to their sections."""

from __future__ import annotations

import re
from collections.abc import Collection

from markupsafe import Markup

from scvi_codegen.display.page.typesetting import SPACE

__all__ = ["label", "linked"]


def label(name: str) -> str:
    """Return the name of an experiment as in the paper: ``figure-4`` as Figure 4, ``tables-6-7`` as Tables 6-7."""
    first, *rest = name.split("-", 1)
    return " ".join([first.capitalize(), *rest])


def linked(text: Markup, names: Collection[str]) -> Markup:
    """Return text with links to the sections of the experiments that it names; names without a digit are words."""
    numbered = sorted((re.escape(name) for name in names if re.search(r"\d", name)), key=len, reverse=True)
    if not numbered:
        return text
    pattern = re.compile(rf"(?<![\w-])({'|'.join(numbered)})(?![\w-]|\.\d)")
    return Markup(pattern.sub(lambda match: f'<a href="#{match[0]}">{label(match[0]).replace(" ", SPACE)}</a>', text))
