"""States of rotations and directions at run time."""
