"""Version of this package, written into the files it produces."""

__version__ = "0.3.0"
