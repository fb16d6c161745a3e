"""Scenes of contacts, robots, inputs, transformed time and baths: bits of the recorded source, and recorded states.

States are those of the motions, which other algorithms share. Where bits change on purpose, list the scenes whose
states deviate and why, then record the bits (``tools/record_golden.py``), not the states.
"""

import subprocess
from functools import cache

import numpy as np
import pytest
from golden_cells import Program, build, output, program, recorded
from golden_scenes import SCENES, STATES, digest, farthest, states_of

pytestmark = pytest.mark.second
MOTIONS = [name for name, scene in SCENES.items() if scene.within]
now = cache(program)


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """What a program prints; each is compiled once."""

    @cache
    def run(made: Program) -> str:
        return output(made, tmp_path_factory.mktemp("program"))

    return run


@pytest.mark.parametrize("name", MOTIONS)
def test_states_are_those_of_the_motion(name, printed):
    with np.load(STATES) as states:
        if digest(now(name).files) != str(states[f"{name} source"]):
            assert farthest(states_of(printed(now(name))), states[name]) < SCENES[name].within


@pytest.mark.parametrize("name", SCENES)
def test_scenes_have_the_bits_of_the_recorded_source(name, printed):
    if now(name) != recorded()[name]:
        assert printed(now(name)) == printed(recorded()[name])


@pytest.mark.full
@pytest.mark.parametrize("name", MOTIONS)
def test_recorded_motions_are_insensitive(name, tmp_path):
    """A change of 1e-12 at the start, and fixed steps of half the size, move no state by a tenth of its tolerance.

    Both do move it. Adaptive steps are within rounding: no argument of the program changes their sizes.
    """
    program_file = build(now(name), tmp_path)

    def states(*arguments: str):
        return states_of(subprocess.check_output([program_file, *arguments], text=True))

    unmoved = states()
    changes = [farthest(states(change), unmoved) for change in ("1e-12", "-1e-12", "3e-13")]
    halved = [farthest(states("0", "2"), unmoved)] if SCENES[name].steps else []
    assert max(changes) > 1e-16
    assert all(half > 1e-16 for half in halved)
    assert max(changes + halved) < SCENES[name].within / 10
