"""States and times: flat and named, rotations, arrays, one word or two."""
