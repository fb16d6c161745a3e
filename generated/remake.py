"""Make the integrators of this folder anew: ``python generated/remake.py``."""

from __future__ import annotations

from pathlib import Path

from scvi_codegen import SCVI, SVI, StoermerVerlet, generate_source, problem

FOLDER = Path(__file__).parent

INTEGRATORS = {
    "two_point_pendulum": ("planar-pendulum", SCVI(1, "gauss-legendre:2")),
    "pendulum_stoermer_verlet": ("planar-pendulum", StoermerVerlet()),
    "kepler_svi_4": ("kepler", SVI(4)),
    "kepler_scvi_2": ("kepler", SCVI(2)),
}


def texts() -> dict[str, str]:
    """Return the text of each file by its name; the support headers serve all integrators."""
    files = {}
    for prefix, (name, method) in INTEGRATORS.items():
        source, _ = generate_source(problem(name).system, method, prefix=prefix)
        files |= source.files
    return files


def main() -> None:
    """Write every file, and remove C files that are no longer made."""
    files = texts()
    for path in {*FOLDER.glob("**/*.[ch]")} - {FOLDER / name for name in files}:
        path.unlink()
    for name, text in files.items():
        (FOLDER / name).parent.mkdir(parents=True, exist_ok=True)
        (FOLDER / name).write_text(text, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
