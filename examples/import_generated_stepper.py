"""Code generation: write a folder of C and Python once, then use it without SymPy."""

import subprocess
import sys
import tempfile
from pathlib import Path

import scvi_codegen as sc

USE = """
import sys
sys.modules["sympy"] = None                # from here on, importing SymPy is an error

import pendulum_svi

stepper = pendulum_svi.stepper
run = stepper.integrate([2.0], [0.0], h=0.1, steps=100_000, save_every=100)
print(stepper.title)
print(f"100000 steps, energy error {abs(run.energy() / run.energy()[0] - 1).max():.1e}")
"""

model = sc.load_model(Path(__file__).with_name("pendulum.toml"))
with tempfile.TemporaryDirectory() as folder:
    package = sc.generate_package(model, Path(folder) / "pendulum_svi")
    print("generated:", *sorted(path.name for path in package.iterdir()), flush=True)
    subprocess.run([sys.executable, "-c", USE], cwd=folder, check=True)
