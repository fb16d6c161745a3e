"""Models: a system with a method, an initial state and a time span; their files, and generated folders and FMUs."""
