"""Fixtures of all tests; what they are made from is in ``tools/samples.py``."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from browsing import chromium
from samples import Sample, compile_quickly, sample_named, stepper_for
from tiers import mark_the_rest_full

from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods.method import Method
from scvi_codegen.runtime.stepper import Stepper

signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the tests run in the background of a shell


@pytest.hookimpl(tryfirst=True)  # before those of the full tier are left out
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    mark_the_rest_full(items)


@pytest.fixture(scope="session")
def sample() -> Callable[[str], Sample]:
    return sample_named


@pytest.fixture(scope="session")
def compiled() -> Callable[..., Stepper]:
    return stepper_for


@pytest.fixture(scope="session")
def quickly_compiled() -> Callable[[LagrangianSystem, Method], Stepper]:
    """For systems without a name."""
    return compile_quickly


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium, for a module: its event loop is in the way of other tests that have one."""
    with chromium() as started:
        yield started
