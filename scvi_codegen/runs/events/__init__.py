"""Events: zero crossings of functions along runs."""
