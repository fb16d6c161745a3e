"""Fixtures of recorded runs."""

from pathlib import Path

import pytest

import scvi_codegen as sc


@pytest.fixture(scope="session")
def kepler(compiled) -> sc.Stepper:
    return compiled("kepler", sc.SVI(4))


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
