"""Texts, displays in notebooks, files.

``summary(*names)``
    A ``__repr__`` that shows attributes, ``Family(parameter='mu', orbits=<12>)``, in at most 100 characters.
``counted(count, noun)``
    ``"3 orbits"``, ``"1 orbit"``.
``Html``
    HTML, for ``_repr_html_``: ``Html.plain(text)``, ``Html.listed(names)``; ``Html.card(title, facts, *parts)``, facts
    by name; ``Html.grid(rows, *, head)``, a table.
``Typeset``
    Formulas as MathML: ``terms(right, left)`` of an equation, ``whole(expression)``; ``latex_name(name)`` in LaTeX.
``TableBlock(columns, rows, name, formats)``
    Table of numbers, texts and formulas of a page or a report.
``announced(message)``
    Context that announces a computation on the terminal if it takes longer than a second.
``cached_source(key, make)``
    Text ``make()`` for a sequence of texts that determine it, from the user's cache if it was made before.
``template_folder()``
    Folder of the Jinja templates of C, pages and reports.
``is_inside(folder, path)``
    Whether a document in a folder may name a file: it is there, or in a folder that the user named.
``write_text(path, text)``, ``write_atomically(path, write)``
    Write a file by a temporary one beside it and a new name, so that it is always complete; ``write`` gets the open
    binary file. OSError.
"""

from scvi_codegen.codegen.native.announcements import announced
from scvi_codegen.common.atomic import is_inside, write_atomically, write_text
from scvi_codegen.common.cache import cached_source, template_folder
from scvi_codegen.common.display.cards import Html
from scvi_codegen.common.display.mathml import Typeset
from scvi_codegen.common.display.tables import TableBlock
from scvi_codegen.common.representation import counted, summary

__all__ = [
    "Html",
    "TableBlock",
    "Typeset",
    "announced",
    "cached_source",
    "counted",
    "is_inside",
    "summary",
    "template_folder",
    "write_atomically",
    "write_text",
]
