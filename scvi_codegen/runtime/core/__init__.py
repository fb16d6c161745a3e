"""Compiled methods and steppers: one step, Legendre transforms, checks of states and parameters."""
