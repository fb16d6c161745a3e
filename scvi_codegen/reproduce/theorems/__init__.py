"""Lemmas and theorems of the paper, checked numerically."""
