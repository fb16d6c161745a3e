"""Texts, displays in notebooks, files.

``summary(*names)``
    A ``__repr__`` that shows attributes, ``Family(parameter='mu', orbits=<12>)``, in at most 100 characters.
``counted(count, noun)``, ``clipped(text, length)``
    ``"3 orbits"``, ``"1 orbit"``; the beginning of a text, with "..", in at most 100 characters.
``Html``, ``plain(text)``, ``card(title, facts, *parts)``, ``grid(rows, *, head)``
    HTML, which text becomes by ``plain``; a card of facts by name; a table. For ``_repr_html_``.
``announced(message)``
    Context that announces a computation on the terminal if it takes longer than a second.
``write_text(path, text)``, ``write_atomically(path, write)``
    Write a file by a temporary one beside it and a new name, so that it is always complete; ``write`` gets the open
    binary file. OSError.
"""

from scvi_codegen.codegen.native.announcements import announced
from scvi_codegen.common.atomic import write_atomically, write_text
from scvi_codegen.common.display.cards import Html, card, grid, plain
from scvi_codegen.common.representation import clipped, counted, summary

__all__ = [
    "Html",
    "announced",
    "card",
    "clipped",
    "counted",
    "grid",
    "plain",
    "summary",
    "write_atomically",
    "write_text",
]
