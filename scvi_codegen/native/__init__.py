"""C text to a callable module: compilers, flags, cffi, options, and the arguments that cross the border."""
