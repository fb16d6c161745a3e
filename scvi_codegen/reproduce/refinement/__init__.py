"""Errors of one step over the number of points and over the step size: figures 6-8 and 16-20."""
