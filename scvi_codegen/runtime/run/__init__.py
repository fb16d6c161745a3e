"""Runs: state, step plan, run loop."""
