"""Observers receive every state of a run once, in any situation."""

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.runs.driver.observation import Observer

STATE = {"q": [1.0, 0.0], "p": [0.0, 1.1], "h": 0.1}
SITUATIONS = {
    "steps": {"steps": 500},
    "to a time between steps": {"t_end": 33.33},
    "adaptive": {"h": None, "t_end": 33.33},
    "to a terminal event": {"steps": 500, "events": sc.Event("q2 - 0.3", terminal=3)},
    "with impacts": {"steps": 200, "events": sc.impact("q1 - 0.2")},
}


class Everything(Observer):
    """Observer that keeps all states and limits its chunks."""

    def __init__(self) -> None:
        self.states, self.sizes = [], []

    def most_steps(self, run):
        """Return the number of steps of a chunk."""
        return 17

    def receive(self, chunk):
        """Keep the states that are new."""
        states = np.concatenate([chunk.states.q, chunk.states.p], axis=1)
        if not chunk.is_first:
            assert np.array_equal(states[0], self.states[-1])
            self.sizes.append(len(states) - 1)
        self.states.extend(states[0 if chunk.is_first else 1 :])

    def result(self):
        """Return all states."""
        return self.states


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(sc.problem("kepler").system, "svi:2")


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("situation", SITUATIONS)
def test_observers_receive_the_states_that_a_run_saves(stepper, situation):
    arguments = STATE | SITUATIONS[situation]
    saved, everything = stepper.integrate(**arguments), Everything()
    states = np.concatenate([saved.q, saved.p], axis=1)
    observed = stepper.integrate(**arguments, observe=everything)
    assert np.array_equal(observed.observed, states)
    assert np.array_equal(observed.t, saved.t)
    assert np.array_equal(observed.q, saved.q[[0, -1]])
    assert len(everything.sizes) > 5
    extremes = stepper.integrate(**arguments, observe="extremes").observed
    assert np.array_equal(extremes, [states.min(axis=0), states.max(axis=0)])


def test_observers_and_functions_save_the_same_times(stepper):
    energies, extremes = (
        stepper.integrate(**STATE, steps=50, save_every=7, observe=observe)
        for observe in (lambda run: run.energy, "extremes")
    )
    assert np.array_equal(energies.t, extremes.t)
    assert np.array_equal(energies.observed, energies.conserved[:, 2])
    assert np.array_equal(energies.conserved, extremes.conserved, equal_nan=True)


def test_energy_errors_of_observed_runs_are_those_of_saved_ones(stepper):
    arguments = {"q": [1.0, 0.0], "p": [0.0, 0.6], "t_end": 60.0, "tolerance": 0.3, "check_growth": False}
    with pytest.warns(sc.AccuracyWarning):
        energy = stepper.integrate(**arguments).energy()
    for observe in (None, "energy"):
        with pytest.warns(sc.AccuracyWarning, match=f"energy changed from -0.82 to {energy[-1]:.3g} although"):
            run = stepper.integrate(**arguments, observe=observe)
        kinetic = np.sum(run.p**2, axis=1) / 2
        saved = energy if observe is None else energy[[0, -1]]
        size = max(np.abs(energy).max(), (kinetic + np.abs(saved - kinetic)).max())
        assert run.energy_error() == pytest.approx(np.abs(energy - energy[0]).max() / size, rel=1e-15)
    ends = stepper.velocity(run.q, run.p, run.t[[0, -1]])
    assert np.array_equal(run.velocity, ends)


@pytest.mark.parametrize("plan", [{"h": 0.1, "steps": 20_000}, {"t_end": 3000.0, "tolerance": 1e-6}])
def test_chunks_of_few_saved_states_have_the_bits_of_all_states(plan):
    pendulum = sc.compile_stepper(sc.problem("planar-pendulum").system, "svi:2")
    few = pendulum.integrate([1.0], [0.0], **plan, save_every=7000)
    whole = pendulum.integrate([1.0], [0.0], **plan)
    assert np.array_equal(few.q[:-1], whole.q[::7000][: len(few) - 1])
    assert np.array_equal(few.q[-1], whole.q[-1 if "t_end" in plan else 14_000])
