"""Checks of what the user states: likely mistakes, jumps and corners."""
