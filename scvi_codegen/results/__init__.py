"""Storage of results: recorded runs."""
