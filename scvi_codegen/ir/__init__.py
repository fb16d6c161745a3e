"""C without syntax: kernels, families of points, sweeps, the program; and how an expression becomes a kernel."""
