"""Programs of robot files do not depend on the processor that reads them."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

READ = """
import sys, warnings, hashlib
import scvi_codegen as sc
from scvi_codegen.codegen.pipeline import generate_source
warnings.simplefilter("ignore")
system = sc.LagrangianSystem.from_urdf(sys.argv[1])
print(hashlib.sha256(generate_source(system, sc.as_method("svi:2"))[0].code.encode()).hexdigest())
"""
OLDER = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3"}
"""Variables with which BLAS and NumPy round as on processors without fused products; others ignore them."""


@pytest.mark.second
def test_programs_of_robot_files_are_the_same_without_fused_products() -> None:
    file = str(Path(__file__).parent / "robots" / "arm.urdf")
    read = [
        subprocess.run([sys.executable, "-c", READ, file], env=os.environ | variables, capture_output=True, text=True)
        for variables in ({}, OLDER)
    ]
    assert all(len(each.stdout.strip()) == hashlib.sha256().digest_size * 2 for each in read), read
    assert read[0].stdout == read[1].stdout
