"""A system with a method, an initial state and a length: catalogue, TOML, grids, generated folders."""
