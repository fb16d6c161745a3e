"""C of the package: written to a folder, compiled with every warning an error, and run."""

import subprocess
from collections.abc import Sequence
from pathlib import Path

from programs import needs
from style import check_style

from scvi_codegen.codegen.rendering.source import Source

STRICT = "-std=c99 -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Werror".split()  # noqa: SIM905  (as one types it)


def run(command: Sequence[str], folder: Path) -> str:
    """Return the output of a command that must succeed without a warning.

    GCC's note that its own ABI for wide vectors changed in version 4.6 is let pass: no function with one is exported.
    """
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout[-2000:]}{done.stderr}"
    assert "warning" not in done.stderr
    return done.stdout


def write(sources: Sequence[Source], folder: Path) -> list[str]:
    """Write sources, each as one file with its header, and return the names of the C files."""
    for source in sources:
        (folder / f"{source.prefix}.h").write_text(source.header, encoding="utf-8")
        (folder / f"{source.prefix}.c").write_text(source.amalgamated().code, encoding="utf-8")
    return [f"{source.prefix}.c" for source in sources]


def check_strict(source: Source, folder: Path, *flags: str, compiler: str = "cc") -> None:
    """Check the style of the code of a source, and compile it with every warning an error."""
    check_style(source.amalgamated().code)
    run([needs(compiler), *STRICT, *flags, "-c", *write([source], folder)], folder)
