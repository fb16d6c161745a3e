"""Contenders of the benchmark: this package, its peers, and the processes in which they are timed."""
