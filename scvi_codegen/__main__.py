"""Entry point of ``python -m scvi_codegen``: the command line."""

from scvi_codegen.interfaces.cli import main

if __name__ == "__main__":
    main()
