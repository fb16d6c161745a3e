"""Rendering of programs as C source: printing of expressions, templates, cache of sources."""
