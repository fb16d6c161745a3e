"""The version of this package; files that it writes say which one wrote them."""

__version__ = "0.1.0"
