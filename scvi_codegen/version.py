"""Version of this package, written into the files it produces."""

__version__ = "0.2.0.dev0"
