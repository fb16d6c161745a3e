"""Fields from densities: Lagrangian densities, meshes, and their semi-discrete systems."""
