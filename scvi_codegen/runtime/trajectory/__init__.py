"""Results of runs: saved states, dense output, derived quantities."""
