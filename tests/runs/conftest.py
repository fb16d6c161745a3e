"""Fixtures of recorded runs."""

import pytest

import scvi_codegen as sc


@pytest.fixture(scope="session")
def kepler(compiled) -> sc.Stepper:
    return compiled("kepler", sc.SVI(4))
