"""Recorded runs as the tests make and compare them."""

import hashlib
from pathlib import Path

import numpy as np

from scvi_codegen import RecordedRun, Run, Stepper, Trajectory, record_run

COLUMNS = ("t", "q", "p", "iterations")
STATE = {"q": [0.5, 0.0], "p": [0.0, 1.7]}
H = 0.05


def start(stepper: Stepper, **settings: object) -> Run:
    return stepper.start(**STATE, h=H, **settings)


def recorded(stepper: Stepper, steps: int = 1000, *, folder: str = "a.run", **settings: object) -> RecordedRun:
    return record_run(start(stepper), folder, steps=steps, **{"rows": 64} | settings)


def digests(folder: str | Path) -> dict[str, str]:
    """Return the hashes of all files with states."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(Path(folder).glob("states-*"))}


def assert_same(one: RecordedRun | Trajectory, other: RecordedRun | Trajectory) -> None:
    for column in COLUMNS:
        np.testing.assert_array_equal(np.asarray(getattr(one, column)), np.asarray(getattr(other, column)))


class StopsAfter:
    """Says stop when it was asked so often."""

    def __init__(self, looks: int) -> None:
        self.looks = looks

    def __call__(self) -> bool:
        self.looks -= 1
        return self.looks < 0
