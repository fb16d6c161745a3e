"""Saved states: dense output, recomputation, export, conserved quantities."""
