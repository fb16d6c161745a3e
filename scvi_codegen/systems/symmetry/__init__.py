"""Symmetries and conserved quantities by Noether's theorem: detection, naming and verification."""
