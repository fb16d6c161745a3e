"""Ensembles: many initial states in SIMD lanes and threads."""
