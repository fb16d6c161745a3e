"""Make the integrators of this folder anew: ``python generated/remake.py``."""

from __future__ import annotations

from pathlib import Path

from scvi_codegen import SCVI, SVI, LagrangianSystem, compile_stepper, generate_source, problem

FOLDER = Path(__file__).parent
RING = LagrangianSystem.from_text(
    "FPUT ring",
    ["q[N]"],
    "sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**2/2 + beta*(q[i+1] - q[i])**4/4)",
    parameters={"beta": 0.25},
)


def texts() -> dict[str, str]:
    """Return the text of each file by its name, the headers that all integrators share (``support/``) included."""
    pendulum, _ = generate_source(
        problem("planar-pendulum").system, SCVI(1, "gauss-legendre:2"), prefix="two_point_pendulum"
    )
    kepler, _ = generate_source(problem("kepler").system, SVI(4), prefix="kepler_svi_4")
    ring = compile_stepper(RING, "stoermer-verlet").source
    return pendulum.files | kepler.files | ring.files


def main() -> None:
    """Write the integrators, and remove C files that are no longer made."""
    files = {FOLDER / name: text for name, text in texts().items() if "/" not in name}
    for path in {*FOLDER.glob("*.[ch]")} - set(files):
        path.unlink()
    for path, text in files.items():
        path.write_text(text, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
