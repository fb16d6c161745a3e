"""The version of this package; files that it writes say which one wrote them."""

__version__ = "0.2.0.dev0"
