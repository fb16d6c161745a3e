"""Temperature, pressure and radial distribution function beside sums over all pairs by NumPy."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

import scvi_codegen as sc

COUNT, CUT = 120, 1.7
LENGTHS = np.array([4.1, 4.6, 5.3])
LONGER = LENGTHS * [1.06, 0.98, 1.2]
BOX = ["L0", "L1", "L2"]
SQUARE = " + ".join(f"wrap(r[i, {a}] - r[j, {a}], L{a})**2" for a in range(3))


@cache
def stepper(masses: str = "m[i]") -> Any:
    system = sc.LagrangianSystem.from_text(
        name="gas",
        coordinates=["r[N, 3]"],
        parameters={"m[N]": 1.0, **{f"L{a}": float(length) for a, length in enumerate(LENGTHS)}},
        neighbours={"near": {"of": "r", "cutoff": CUT, "box": ["L0", "L1", "L2"]}},
        lagrangian=f"""sum(i in N, {masses}*sum(a in 3, r_dot[i, a]**2)/2)
            - sum(i < j in near, 2*positive_part(1 - ({SQUARE})/{CUT}**2)**4)""",
    )
    return sc.compile_stepper(system, "stoermer-verlet")


def motion(lengths: Any = LENGTHS, **options: Any) -> Any:
    generator = np.random.default_rng(3)
    r, v = generator.uniform(-3, 9, size=(COUNT, 3)), generator.normal(size=(COUNT, 3))
    values = {"m": np.linspace(0.5, 2.0, COUNT), **dict(zip(BOX, lengths, strict=True))}
    return stepper().integrate(r, velocity=v, h=0.01, steps=30, save_every=10, parameters=values, **options)


def apart(r: Any, lengths: Any) -> Any:
    """Distances of the nearest images, without those of particles from themselves."""
    between = r[:, None] - r[None]
    between -= lengths * np.rint(between / lengths)
    return np.sqrt((between**2).sum(axis=-1))[np.triu_indices(len(r), 1)]


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("lengths", [LENGTHS, LONGER], ids=["default", "longer"])
def test_temperature_and_pressure_are_those_of_sums_over_all_pairs(lengths: Any) -> None:
    run = motion(lengths)
    masses = np.linspace(0.5, 2.0, COUNT)[:, None]
    kinetic = (run.p["r"] ** 2 / masses).sum(axis=(1, 2)) / 2
    assert sc.temperature(run) == pytest.approx(2 * kinetic / (3 * COUNT - 3), rel=1e-13)
    virial = []
    for r in run.q["r"]:
        d = apart(r, lengths)
        s = np.maximum(1 - d**2 / CUT**2, 0.0)
        virial.append((16 * s**3 * d**2 / CUT**2).sum())
    expected = (2 * kinetic + virial) / (3 * lengths.prod())
    assert sc.pressure(run, BOX) == pytest.approx(expected, rel=1e-8)


@pytest.mark.second
def test_temperature_with_constraints_excludes_their_degrees_of_freedom() -> None:
    """Two rods that turn and move as one: 6 coordinates of 3 masses, 2 conserved momenta, 2 constraints."""
    system = sc.LagrangianSystem.from_text(
        name="rods",
        coordinates=["r[N, 2]"],
        tables=["bonds[B, 2]"],
        lagrangian="sum(i in N, sum(a in 2, r_dot[i, a]**2)/2)",
        constraints=["sum(a in 2, (r[bonds[b, 0], a] - r[bonds[b, 1], a])**2) = 1 for b in B"],
    )
    r = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    v = np.stack([0.3 - r[:, 1], r[:, 0]], axis=1)
    run = sc.compile_stepper(system, "stoermer-verlet").integrate(
        {"r": r}, velocity={"r": v}, h=0.01, steps=2, tables={"bonds": [[0, 1], [1, 2]]}
    )
    assert sc.temperature(run) == pytest.approx((run.p["r"] ** 2).sum(axis=(1, 2)) / (6 - 2 - 2), rel=1e-13)


@pytest.mark.parametrize(("lengths", "largest"), [(LENGTHS, LENGTHS.min() / 2), (LENGTHS, 0.7), (LONGER, None)])
def test_radial_distribution_counts_each_pair_once(lengths: Any, largest: float | None) -> None:
    run = motion(lengths)
    r, g = sc.radial_distribution(run, BOX, largest=largest, bins=25)
    largest = largest or lengths.min() / 2
    edges = np.linspace(0, largest, 26)
    counts = sum(np.histogram(apart(each, lengths), edges)[0] for each in run.q["r"])
    shells = 4 / 3 * np.pi * np.diff(edges**3) / lengths.prod()
    assert r == pytest.approx((edges[1:] + edges[:-1]) / 2)
    assert g == pytest.approx(counts / (len(run.t) * COUNT * (COUNT - 1) / 2 * shells))


def test_observers_are_the_functions_of_trajectories() -> None:
    run = motion()

    def observe(now: Any) -> Any:
        _, g = sc.radial_distribution(now, BOX, largest=2.0, bins=5)
        return [sc.temperature(now), sc.pressure(now, BOX), *g]

    observed = motion(observe=observe).observed
    assert observed[:, 0] == pytest.approx(sc.temperature(run), rel=1e-14)
    assert observed[:, 1] == pytest.approx(sc.pressure(run, BOX), rel=1e-12)
    assert observed[:, 2:].mean(axis=0) == pytest.approx(sc.radial_distribution(run, BOX, largest=2.0, bins=5)[1])


@pytest.mark.rotated
def test_unknown_boxes_and_other_systems_are_refused() -> None:
    run = motion()
    with pytest.raises(sc.ArgumentError, match="'L' is not a parameter"):
        sc.pressure(run, "L")
    with pytest.raises(sc.ArgumentError, match="one name or 3"):
        sc.pressure(run, BOX[:2])
    with pytest.raises(sc.ArgumentError, match=r"at most half of the shortest period, 2\.05"):
        sc.radial_distribution(run, BOX, largest=2.1)
    few = sc.LagrangianSystem.from_text("one", ["x", "y"], "(x_dot**2 + y_dot**2)/2", parameters={})
    still = sc.compile_stepper(few, "svi:2").integrate([0.0, 0.0], [1.0, 0.0], h=0.1, steps=2)
    with pytest.raises(sc.StateError, match="kinetic energy is unknown"):
        sc.temperature(still)
