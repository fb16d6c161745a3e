"""Import from ``sympy.physics.mechanics``: bodies, joints and loads become a Lagrangian, forces and constraints."""
