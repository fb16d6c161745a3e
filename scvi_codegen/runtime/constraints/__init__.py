"""Constraints: projection, multipliers, rank."""
