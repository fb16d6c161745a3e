"""Which step and which degree a wanted error needs, and a motion in one call."""
