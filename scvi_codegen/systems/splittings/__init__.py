"""Kinetic energies whose flows are known, for methods that split H = T + V."""
