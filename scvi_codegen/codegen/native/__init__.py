"""Compilation and loading of C source: compilers, flags, cffi, options, arguments."""
