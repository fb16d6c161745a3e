"""Concurrency: processes that share a cache, threads that share a stepper, pickled steppers."""

import copy
import json
import multiprocessing
import os
import pickle
import random
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from programs import script

from scvi_codegen import SVI, RecordedRun, Stepper, record_run
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common import cache

PROCESSES = 16
FAST = ("-O0",)


def source(number: int) -> Source:
    declaration = f"double answer_{number}(void);\n"
    code = f'#include "small.h"\ndouble answer_{number}(void)\n{{\n  return {number}.0;\n}}\n'
    return Source(prefix="small", header=declaration, code=code, declarations=declaration)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """An empty cache."""
    path = tmp_path / "cache"
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(path))
    monkeypatch.setattr(building, "_loaded", {})
    return path


# Processes that share a cache.

LOADING = """
import json, logging, sys
from pathlib import Path
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.rendering.source import Source
logging.getLogger("scvi_codegen").setLevel(logging.WARNING)  # slow compilations are not announced
sources = [Source.from_record(record) for record in json.loads(Path(sys.argv[1]).read_text())]
print("ready", flush=True)
sys.stdin.readline()
for number in map(int, sys.argv[2:]):
    building._loaded.clear()
    print(getattr(building.load(sources[number], flags=("-O0",)).lib, f"answer_{number}")(), flush=True)
"""


def loading(folder: Path, *numbers: int, **environment: str) -> subprocess.Popen[str]:
    """A process that loads these sources, one after the other, once it is given a line."""
    path = folder.parent / "sources.json"
    if not path.exists():  # which the processes before this one may be reading
        path.write_text(json.dumps([source(number).to_record() for number in range(8)]))
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", LOADING, str(path), *map(str, numbers)],
        env=os.environ | environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def at_once(processes: list[subprocess.Popen[str]]) -> list[tuple[str, str]]:
    """Return the output and errors of concurrently started processes."""
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n", process.communicate(timeout=60)[1]
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    return [process.communicate(timeout=300) for process in processes]


@pytest.mark.rotated
def test_concurrent_processes_compile_into_an_empty_cache(folder):
    results = at_once([loading(folder, i % 4) for i in range(PROCESSES)])
    assert results == [(f"{i % 4}.0\n", "") for i in range(PROCESSES)]
    found = sorted(path.name for path in folder.iterdir())
    assert found == sorted(f"_scvi_{building.fingerprint(source(i), flags=FAST)}" for i in range(4))
    assert all(building._is_intact(folder / name) for name in found)


@pytest.mark.rotated
@pytest.mark.parametrize("rounds", [1, pytest.param(12, marks=pytest.mark.full)])
def test_entries_removed_during_loading_are_rebuilt(folder, rounds):
    """The cache has room for one entry, so each process removes the others' entries."""
    numbers = [[(first + i) % 3 for i in range(rounds * 3)] for first in range(4)]
    results = at_once([loading(folder, *order, **{cache.SIZE_VARIABLE: "1"}) for order in numbers])
    assert results == [("".join(f"{number}.0\n" for number in order), "") for order in numbers]


SLOW_COMPILER = """#!/bin/sh
touch "$COMPILING"
sleep "$SECONDS_TO_WAIT"
exec cc "$@"
"""


def killed(folder: Path, seconds: float, generator: random.Random) -> None:
    """Load a source in a process that is killed while it compiles."""
    compiler, mark = script(folder.parent / "slow-cc", SLOW_COMPILER), folder.parent / "compiling"
    mark.unlink(missing_ok=True)
    with loading(folder, 0, CC=compiler, COMPILING=str(mark), SECONDS_TO_WAIT=str(seconds)) as process:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
        while not mark.exists() and process.poll() is None:
            time.sleep(0.005)
        time.sleep(generator.uniform(0.0, 0.8))
        process.kill()


@pytest.mark.rotated
@pytest.mark.parametrize("times", [3, pytest.param(40, marks=pytest.mark.full)])
def test_killed_compilation_leaves_a_usable_cache(folder, times, monkeypatch):
    generator, left = random.Random(times), 0
    for _ in range(times):
        killed(folder, 0.1, generator)
        entries = list(folder.glob("_scvi_*"))
        assert all(building._is_intact(entry) for entry in entries)
        left += not entries
        shutil.rmtree(folder, ignore_errors=generator.random() < 0.5)
    assert left > 0
    killed(folder, 5.0, generator)
    assert len(list(folder.glob(".building-*"))) >= 1
    assert building.load(source(0), flags=FAST).lib.answer_0() == 0.0


# Steppers and runs that travel.


@pytest.fixture(scope="session")
def kepler(compiled) -> Stepper:
    return compiled("kepler", SVI(4))


STATE = ([0.5, 0.0], [0.0, 1.7])


def final(stepper: Stepper, p: float = 1.7) -> bytes:
    """The last state of a run from a momentum, to the bit."""
    run = stepper.integrate([0.5, 0.0], [0.0, p], h=0.05, steps=2000, save_every=2000)
    return run.q[-1].tobytes() + run.p[-1].tobytes()


MOMENTA = tuple(1.2 + 0.05 * i for i in range(16))


@pytest.fixture(scope="session")
def finals(kepler) -> list[bytes]:
    """Return the final state for each momentum in turn."""
    return [final(kepler, p) for p in MOMENTA]


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda given: pickle.loads(pickle.dumps(given))])
def test_copies_of_steppers_runs_and_trajectories_are_equal(kepler, duplicate, tmp_path):
    run = kepler.start(*STATE, h=0.05, parameters={"mu": 1.1})
    run.record(50)
    other = duplicate(run)
    assert (other.checkpoint(), other.steps, list(other.parameters)) == (run.checkpoint(), 50, [1.1])
    np.testing.assert_array_equal(run.record(50).q, other.record(50).q)
    assert final(duplicate(kepler)) == final(kepler)
    trajectory = kepler.integrate(*STATE, h=0.05, steps=10)
    np.testing.assert_array_equal(duplicate(trajectory).energy(), trajectory.energy())
    recorded: RecordedRun = duplicate(record_run(kepler.start(*STATE, h=0.05), tmp_path / "a.run", steps=10))
    np.testing.assert_array_equal(recorded.q[:], trajectory.q)


def test_threads_compile_each_text_once(folder, monkeypatch):
    built = []
    publish = building._publish
    monkeypatch.setattr(building, "_publish", lambda *arguments: built.append(1) or publish(*arguments))

    def compiled(number: int) -> float:
        return getattr(building.load(source(number), flags=FAST).lib, f"answer_{number}")()

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(compiled, [0, 1] * 4)) == [0.0, 1.0] * 4
    assert len(built) == len(list(folder.glob("_scvi_*"))) == 2


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize("method", ["fork", "spawn", pytest.param("forkserver", marks=pytest.mark.full)])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_steppers_are_pickled_to_other_processes(kepler, finals, method):
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert pool.starmap(final, [(kepler, p) for p in MOMENTA[:4]]) == finals[:4]
