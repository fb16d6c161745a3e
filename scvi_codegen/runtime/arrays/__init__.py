"""Runs of arrays whose sizes are known at run time."""
