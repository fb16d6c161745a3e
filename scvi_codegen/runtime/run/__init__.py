"""Runs: state, step plan, run loop, accuracy of runs."""
