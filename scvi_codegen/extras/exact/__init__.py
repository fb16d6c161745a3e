"""Reference solutions in up to 60 digits, computed independently of the compiled code."""
