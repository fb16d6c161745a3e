"""Formulas: parsing of text and SymPy to canonical expressions, exact; derivatives, evaluation and printing."""
