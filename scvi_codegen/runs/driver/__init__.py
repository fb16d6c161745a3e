"""Loops of steps: runs, observers, singular times, segments between breakpoints of inputs."""
