"""Choice of step size and degree for a given error, and integration in one call."""
