"""How programs and people meet the integrators: command line, model files, packages, pictures, pages."""
