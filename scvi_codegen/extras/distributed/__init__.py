"""Ensembles on a cluster."""
