"""Fixtures of recorded runs."""

from pathlib import Path

import pytest

from scvi_codegen.methods import SVI
from scvi_codegen.runtime.core.stepper import Stepper


@pytest.fixture(scope="session")
def kepler(compiled) -> Stepper:
    return compiled("kepler", SVI(4))


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
