"""Validation of arguments: types, integers and keywords, with errors that name the argument."""
