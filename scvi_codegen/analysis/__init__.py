"""Questions about motions: chaos, periodic orbits, paths, estimation, advice, verification."""
