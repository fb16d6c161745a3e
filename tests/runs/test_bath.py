"""Heat bath: exact covariances, averages beside quadrature, bits, Metropolis.

Averages have fixed seeds, and bounds of four standard errors, which are those of 16 independent trajectories.
"""

import subprocess
from contextlib import suppress

import numpy as np
import pytest
from samples import QUICK_FLAGS
from scipy.linalg import expm, solve_discrete_lyapunov

import scvi_codegen as sc
from scvi_codegen.runs.stepping.noise import normal_numbers

MASS = np.array([[1, 0.5, 0], [0.5, 2, 0], [0, 0, 1]])
STIFFNESS = np.array([[2, -1, 0], [-1, 2, -1], [0, -1, 2.0]])
CHAIN = {
    "coordinates": ["a", "b", "c"],
    "lagrangian": "(a_dot**2 + 2*b_dot**2 + c_dot**2 + a_dot*b_dot)/2 - (a**2 + (b-a)**2 + (c-b)**2 + c**2)/2",
    "parameters": {"kT": 1.3, "g": 0.7},
}
WELL = {
    "coordinates": ["x"],
    "lagrangian": "x_dot**2/2 - (x**2 - 1)**2 - x/2",
    "parameters": {"kT": 1, "g": 1},
    "damping": "g",
    "temperature": "kT",
}
RODS = {"parameters": {"g": 1, "m": 2, "kT": 2}, "damping": 1.0, "temperature": "kT"}


def compiled(method, name="body", **arguments):
    return sc.compile_stepper(sc.LagrangianSystem.from_text(name, **arguments), method, flags=QUICK_FLAGS)


def averages(stepper, q, h, steps, observe, **arguments):
    """Means of 16 trajectories from rest, without the first hundredth, and their standard errors."""
    start = np.tile(np.asarray(q, dtype=float), (16, 1))
    runs = stepper.integrate_ensemble(start, np.zeros_like(start), h=h, steps=steps, seed=5, **arguments)
    assert (runs.status == "ok").all()
    means = observe(runs.q[steps // 100 :]).mean(axis=0)
    return means.mean(axis=0), means.std(axis=0, ddof=1) / 4


def agrees(mean, error, exact, largest_error):
    assert (error < largest_error).all()
    return (np.abs(mean - exact) < 4 * error).all()


@pytest.mark.second
@pytest.mark.parametrize("dissipation", ["g*a_dot**2/2", "g*(a_dot**2 + 2*b_dot**2 + c_dot**2 + a_dot*b_dot)/2"])
def test_half_steps_are_exact_and_harmonic_covariances_have_no_error(dissipation):
    # E of two half steps from C, B from fluctuation and dissipation; covariance of O Phi O by Lyapunov's equation
    h, kT = 0.8, 1.3
    chain = compiled("svi:2", **CHAIN, dissipation=dissipation, temperature="kT")
    free = compiled("svi:2", **{**CHAIN, "lagrangian": CHAIN["lagrangian"].split(" - ")[0]}, dissipation=dissipation,
                    temperature="kT")  # fmt: skip
    still = {"h": h / 2, "steps": 1, "parameters": {"kT": 0, "g": 0.7}}
    decay = np.array([free.integrate(np.zeros(3), p, **still).p[-1] for p in np.eye(3)]).T  # E(h/2) of two quarters
    friction = np.diag([0.7, 0, 0]) if "2*b_dot" not in dissipation else 0.7 * MASS
    assert np.abs(decay - expm(-friction @ np.linalg.inv(MASS) * h / 2)).max() < 1e-15
    step = chain.jacobian(np.zeros(3), np.zeros(3), h)
    zero = np.zeros((3, 3))
    half = np.block([[np.eye(3), zero], [zero, decay]])
    noise = np.block([[zero, zero], [zero, kT * (MASS - decay @ MASS @ decay.T)]])
    covariance = solve_discrete_lyapunov(half @ step @ half, half @ step @ noise @ step.T @ half.T + noise)
    assert np.abs(covariance[:3, :3] - kT * np.linalg.inv(STIFFNESS)).max() < 1e-13
    assert np.abs(covariance[3:, 3:] - kT * MASS).max() < 1e-13
    end = chain.integrate(np.ones(3), np.ones(3), **{**still, "h": h})
    whole = half @ step @ half @ np.ones(6)
    assert np.abs(np.r_[end.q[-1], end.p[-1]] - whole).max() < 1e-14


@pytest.mark.tiers(0, 1)
def test_noise_of_a_step_has_the_covariance_of_fluctuation_and_dissipation():
    h, kT, count = 0.9, 1.3, 40000
    free = compiled("svi:1", **{**CHAIN, "lagrangian": CHAIN["lagrangian"].split(" - ")[0]},
                    dissipation="g*(a_dot - c_dot)**2/2", temperature="kT")  # fmt: skip
    rest = np.zeros((count, 3))
    p = free.integrate_ensemble(rest, rest, h=h, steps=1, seed=3).p[-1]
    friction = 0.7 * np.outer([1, 0, -1], [1, 0, -1])
    decay = expm(-friction @ np.linalg.inv(MASS) * h)
    expected = kT * (MASS - decay @ MASS @ decay.T)
    assert np.abs(p.T @ p / count - expected).max() < 4 * kT * np.sqrt(2 / count)
    assert np.abs(p.mean(axis=0)).max() < 4 * np.sqrt(kT / count)


def test_noise_is_a_function_of_seed_trajectory_and_step():
    well = compiled("svi:2", "well", **WELL)
    every = well.integrate([1.0], [0.0], h=0.3, steps=60, seed=7)
    assert "seed 7" in repr(every)
    saved = well.integrate([1.0], [0.0], h=0.3, steps=60, seed=7, save_every=7)
    assert (every.q[::7] == saved.q).all()
    assert (every.q[1:] != well.integrate([1.0], [0.0], h=0.3, steps=60).q[1:]).all()
    run = well.start([1.0], [0.0], h=0.3, seed=7)
    run.advance(23)
    resumed = well.from_checkpoint(run.checkpoint())
    resumed.advance(37)
    assert (resumed.q[0], resumed.p[0], resumed.bath.heat) == (every.q[-1, 0], every.p[-1, 0], every.heat())
    start = np.tile([1.0], (9, 1))
    runs = well.integrate_ensemble(start, 0 * start, h=0.3, steps=60, seed=7, threads=1)
    assert (runs.q == well.integrate_ensemble(start, 0 * start, h=0.3, steps=60, seed=7, threads=4).q).all()
    assert (runs.q[:, 0] == every.q).all()
    assert len(np.unique(runs.q[-1])) == 9


CHAIN_OF_TWO = {
    "coordinates": ["x", "y"],
    "lagrangian": "x_dot**2/2 + y_dot**2 - (x**2 - 1)**2 - x*y/2 - y**4",
    "parameters": {"kT": 1, "g": 1, "s": 1},
    "dissipation": "g*(x_dot - y_dot)**2/2",
    "noise": {"y": "s/(1 + x**2)"},
}


@pytest.mark.second
@pytest.mark.parametrize("temperature", ["kT", "kT*(2 - t)"])
def test_lanes_have_the_bits_of_single_runs_and_return_to_the_state_before_a_failure(temperature):
    pair = compiled("stoermer-verlet", "pair", **CHAIN_OF_TWO, temperature=temperature)
    assert pair.ensemble is not None
    q, p = np.random.default_rng(1).normal(size=(2, 13, 2))
    values = {"kT": np.linspace(0.5, 2, 13), "s": np.linspace(0, 1, 13)}
    settings = {"h": 0.07, "steps": 40, "seed": 3, "parameters": values}
    runs = pair.integrate_ensemble(q, p, **settings, threads=2)
    own = {name: column[0] for name, column in values.items()}
    arguments = q[0], p[0], {**settings, "parameters": own}
    if temperature == "kT":
        single = pair.integrate(*arguments[:2], **arguments[2])
    else:
        with pytest.raises(sc.StepFailedError, match="must not be negative") as failure:
            pair.integrate(*arguments[:2], **arguments[2])
        single = failure.value.trajectory
    assert (runs.status == ("ok" if temperature == "kT" else "not finite")).all()
    assert len(single) - 1 == runs.steps[0] == (40 if temperature == "kT" else 28)
    assert (runs.q[: len(single), 0] == single.q).all()
    saved = pair.integrate_ensemble(q, p, **settings, save_every=4)
    assert np.array_equal(saved.q, runs.q[::4], equal_nan=True)
    extremes = pair.integrate_ensemble(q, p, **{**settings, "steps": 20}, observe="extremes").observed
    assert (extremes[1, :, :2] == runs.q[:21].max(axis=0)).all()
    reverse = {name: column[::-1] for name, column in values.items()}  # the middle member has its stream
    others = pair.integrate_ensemble(q[::-1], p[::-1], **{**settings, "parameters": reverse})
    assert np.array_equal(others.q[:, 6], runs.q[:, 6], equal_nan=True)
    assert (others.q[1:20] != runs.q[1:20, ::-1]).any(axis=(0, 2)).sum() == 12


STIFF = {**WELL, "lagrangian": "x_dot**2/2*(1 + x**2) - 50*x**4"}
PLAIN = {"parameters": {"kT": 1, "g": 1}, "temperature": "kT"}
ROD = PLAIN | {
    "coordinates": ["x", "y"],
    "lagrangian": "(x_dot**2 + 2*y_dot**2)/2 - y",
    "constraints": ["x**2 + y**2 = 1"],
    "damping": "g",
}
SPHERICAL = ROD | {
    "coordinates": ["x", "y", "z"],
    "lagrangian": "(x_dot**2 + y_dot**2 + z_dot**2)/2 - z",
    "constraints": ["x**2 + y**2 + z**2 = 1"],
}
LAGRANGIAN_OF_BODY = "(omega_1**2 + 2*omega_2**2 + 5*omega_3**2/2)/2 + 2*R_33"
DIPOLE = PLAIN | {"rotations": {"R": "omega"}, "lagrangian": LAGRANGIAN_OF_BODY, "damping": "g"}


@pytest.mark.second
@pytest.mark.parametrize("method", ["stoermer-verlet", "composition:4"])
def test_lanes_accept_and_reject_as_single_runs(method):
    """Also steps that are not finite; with the other direction of time, and with one to 33 trajectories."""
    steep = compiled(method, "steep", **{**WELL, "lagrangian": "x_dot**2/2 - x**16"})
    assert steep._ensemble_binding.constant("HAS_METROPOLIS")
    settings = {"h": 0.7, "steps": 60, "seed": 3, "metropolis": True}
    q, p = np.random.default_rng(2).normal(size=(2, 33, 1))
    whole = steep.integrate_ensemble(q, p, **settings)
    single = steep.integrate(q[0], p[0], **settings)
    assert 0.1 < single.acceptance < 0.9
    assert (whole.status == "ok").all()
    for count in (1, 2, 7, 33):
        runs = steep.integrate_ensemble(q[:count], p[:count], **settings, threads=2)
        assert np.array_equal(runs.p, whole.p[:, :count])
        assert np.array_equal(runs.q[:, 0], single.q)
    seen = steep.integrate_ensemble(q, p, **settings, observe="extremes").observed
    assert np.array_equal(seen[1, :, 0], whole.q[..., 0].max(axis=0))


@pytest.mark.second
def test_zero_temperature_is_plain_damping_and_heat_balances_the_energy():
    well = compiled("composition:4", "well", **WELL)
    cold = [well.integrate([1.0], [0.3], h=0.01, steps=300, seed=seed, parameters={"kT": 0}) for seed in (1, 2)]
    assert (cold[0].q == cold[1].q).all()
    assert len(well.integrate([1.0], [0.0], h=0.1, steps=3, parameters={"g": -1, "kT": 0})) == 4
    plain = {key: value for key, value in WELL.items() if key != "temperature"}
    damped = compiled("svi:4", "damped", **plain).integrate([1.0], [0.3], h=0.01, steps=300)
    assert np.abs(cold[0].q - damped.q).max() < 1e-5  # the splitting has order 2
    warm = well.integrate([1.0], [0.3], h=0.01, steps=300)
    energy = warm.energy()
    assert abs(energy[-1] - energy[0] - warm.heat()) < 1e-7 < abs(warm.heat())


@pytest.mark.second
def test_metropolis_with_a_magnetic_field_has_a_direction_variable():
    # a charge in B = 2 and an asymmetric potential; flipped momenta would bias <x> by -.155 and <y^2> by .67
    charge = compiled(
        "svi:1",
        "charge",
        coordinates=["x", "y"],
        lagrangian="(x_dot**2 + y_dot**2)/2 + x*y_dot - y*x_dot - (x**2 + y**2)/2 - x**4/4 - 7*y*x**2/20",
        parameters={"kT": 1},
        damping=0.5,
        temperature="kT",
    )
    grid = np.linspace(-6, 6, 601)
    x, y = np.meshgrid(grid, grid, indexing="ij")
    weight = np.exp(-(x**2 + y**2) / 2 - x**4 / 4 - 7 * y * x**2 / 20)
    exact = np.array([(weight * f).sum() / weight.sum() for f in (x, x**2, y**2)])

    def observe(q):
        return np.stack([q[..., 0], q[..., 0] ** 2, q[..., 1] ** 2], axis=-1)

    assert agrees(*averages(charge, [0, 0], 0.8, 6000, observe, metropolis=True), exact, 0.02)
    start = {"q": [[0.0, 0.0]], "velocity": [[0.0, 0.0]], "h": 0.1, "steps": 3, "observe": "extremes"}
    with pytest.raises(sc.MethodError, match="observe='extremes' is not available with metropolis=True"):
        charge.integrate_ensemble(**start, metropolis=True)
    assert np.isfinite(charge.integrate_ensemble(**start).q).all()


@pytest.mark.tiers(0, 1)
def test_rods_by_constraints_and_by_angles_agree_with_quadrature():
    angle = (np.arange(800) + 0.5) * np.pi / 400
    a, b = np.meshgrid(angle, angle, indexing="ij")
    weight = np.exp((3 * np.cos(a) + 2 * np.cos(b)) / 2) * np.sqrt(6 - (2 * np.cos(a - b)) ** 2)
    exact = np.array([(weight * f).sum() / weight.sum() for f in (np.cos(a), np.cos(b), np.cos(a - b))])
    lagrangian = "((1+m)*a_dot**2 + m*b_dot**2 + 2*m*a_dot*b_dot*cos(a-b))/2 + g*((1+m)*cos(a) + m*cos(b))"
    angles = compiled("svi:2", "angles", coordinates=["a", "b"], lagrangian=lagrangian, **RODS)
    rods = compiled(
        "svi:2",
        "rods",
        coordinates=["x1", "y1", "x2", "y2"],
        lagrangian="(x1_dot**2 + y1_dot**2 + m*(x2_dot**2 + y2_dot**2))/2 - g*(y1 + m*y2)",
        constraints=["x1**2 + y1**2 = 1", "(x2 - x1)**2 + (y2 - y1)**2 = 1"],
        **RODS,
    )

    def of_angles(q):
        return np.cos(np.stack([q[..., 0], q[..., 1], q[..., 0] - q[..., 1]], axis=-1))

    def of_rods(q):
        x1, y1, x2, y2 = np.moveaxis(q, -1, 0)
        return np.stack([-y1, y1 - y2, y1 * (y2 - y1) + x1 * (x2 - x1)], axis=-1)

    assert agrees(*averages(angles, [0, 0], 0.2, 6000, of_angles), exact, 0.02)
    assert agrees(*averages(rods, [0, -1, 0, -2], 0.2, 6000, of_rods, metropolis=True), exact, 0.02)
    run = rods.integrate([0, -1, 0, -2], [0, 0, 0, 0], h=0.2, steps=300)
    assert np.abs(rods.constraint_values(run.q, run.p)).max() < 1e-13


@pytest.mark.second
def test_additive_noise_heats_at_its_rate():
    # E H = H0 + sigma^2 t / 2, which SVI preserve for quadratic H
    noisy = compiled(
        "svi:2", "noisy", coordinates=["x"], lagrangian="x_dot**2/2 - x**2/2", parameters={"s": 0.5}, noise={"x": "s"}
    )
    rest = np.zeros((4000, 1))
    runs = noisy.integrate_ensemble(rest, rest, h=0.5, steps=40, seed=1)
    energy = (runs.q[-1] ** 2 + runs.p[-1] ** 2) / 2
    assert abs(energy.mean() - 0.5**2 * 20 / 2) < 4 * energy.std() / np.sqrt(4000)


@pytest.mark.second
def test_failed_steps_are_repeated_in_halves():
    """Without friction, runs have the bits of single steps that a recursion halves where they fail."""
    stepper, levels = compiled("svi:1", "stiff", **STIFF), set()

    def halved(q, p, h, level=0):
        levels.add(level)
        try:
            return stepper.step(q, p, h)[:2]
        except sc.StepFailedError:
            return halved(*halved(q, p, h / 2, level + 1), h / 2, level + 1)

    for q, p in np.random.default_rng(0).normal(size=(60, 2, 1)) * [[4], [12]]:
        run = stepper.integrate(q, p, h=0.6, steps=1, parameters={"kT": 0, "g": 0})
        assert np.array_equal((run.q[1], run.p[1]), halved(q, p, 0.6))
    assert levels == {0, 1, 2}
    well = compiled("svi:1", "edge", **{**WELL, "lagrangian": "x_dot**2/2 + sqrt(x)"})
    with pytest.raises(sc.StepFailedError):  # at the edge of the domain of L
        well.integrate([1.0], [-100.0], h=1.0, steps=1, parameters={"kT": 0, "g": 0})


@pytest.mark.second
@pytest.mark.parametrize("arguments", [SPHERICAL, DIPOLE], ids=["rod", "dipole"])
def test_noise_is_a_continuous_function_of_the_state(arguments):
    """Of equal frictions, whose eigenvectors are arbitrary."""
    stepper = compiled("svi:2", **arguments)
    q = np.eye(stepper.dimension)[0]
    p = np.eye(stepper.dimension)[1]
    for seed in range(4):
        first, second = (stepper.integrate(q, p * x, h=0.05, steps=60, seed=seed) for x in (1.0, 1.0 + 1e-10))
        assert 0 < np.abs(first.p - second.p).max() < 1e-7


@pytest.mark.tiers(0, 1)
def test_steps_to_spurious_roots_are_repeated_in_halves():
    """Energies in thermal bounds where single steps jump, with and without friction."""
    pendulum = compiled(
        *("svi:1", "jumping"),
        coordinates=["a", "b"],
        lagrangian="a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a - b) + 2*cos(a) + cos(b)",
        parameters={"kT": 2.0, "g": 0.5},
        damping="g",
        temperature="kT",
    )
    for seed in range(8):  # P(energy > 40) < 1e-7 for the two degrees of freedom, of potential energies from -3 to 3
        assert pendulum.integrate([0.3, 0.2], [0.0, 0.0], h=0.3, steps=300, seed=seed).energy().max() < 40
    q = np.tile([0.3, 0.2], (16, 1))
    assert pendulum.integrate_ensemble(q, 0 * q, h=0.3, steps=300, seed=0).energy().max() < 40
    jumps = 0
    for q, p in np.random.default_rng(0).normal(size=(400, 2, 2)) * [[[3.0], [2.5]]]:
        run = pendulum.integrate(q, p, h=0.3, steps=1, parameters={"g": 0.0})
        with suppress(sc.StepFailedError):
            whole = pendulum.step(q, p, 0.3)[:2]
            is_jump = abs(pendulum.energy(*whole) - pendulum.energy(q, p)) > 60
            assert not (is_jump and np.array_equal((run.q[1], run.p[1]), whole))
            jumps += is_jump
    assert jumps > 0


@pytest.mark.second
def test_metropolis_rejects_steps_that_fail_or_do_not_return():
    """Each step from the saved state: O, Phi of the present direction, energies, Phi back, or the other direction."""
    h, kT, count = 2.0, 2.0, 60
    arguments = {**WELL, "lagrangian": "x_dot**2/2*(1 + x**4) - x**2", "parameters": {"kT": kT, "g": 1.0}}
    stepper, way, reasons = compiled("svi:1", "folded", **arguments), 1, []
    run = stepper.integrate([1.0], [0.0], h=h, steps=count, seed=4, metropolis=True)
    draws, chances = (normal_numbers(4, 0, np.arange(count), purpose, 0) for purpose in (0, 1))

    def heated(q, p, xi):
        kept = np.exp(-h / 2)
        return kept * p + np.sqrt(kT * (1 + q**4) * (1 - kept**2)) * xi

    for n in range(count):
        q, reason = run.q[n], "accepted"
        p = heated(q, run.p[n], draws[n].real)
        before = stepper.energy(q, p)
        try:
            there = stepper.step(q, p, way * h)[:2]
            back = stepper.step(*there, -way * h)[0]
        except sc.StepFailedError:
            reason = "failed"
        else:
            log_chance = -(abs(chances[n]) ** 2) / 2  # of the same words, r^2 = -2 log(chance)
            if log_chance > (before - stepper.energy(*there)) / kT:
                reason = "energy"
            elif abs(back - q).max() > 1e-8 * (abs(q) + abs(there[0] - q)).max():
                reason = "does not return"
        reasons.append(reason)
        q, p, way = (*there, way) if reason == "accepted" else (q, p, -way)
        assert np.abs([run.q[n + 1] - q, run.p[n + 1] - heated(q, p, draws[n].imag)]).max() < 1e-9
    assert run.acceptance == reasons.count("accepted") / count
    assert min(map(reasons.count, ("failed", "energy", "does not return"))) > 0


@pytest.mark.second
def test_the_remedy_of_kinks_exists_in_a_bath():
    with pytest.warns(sc.MethodWarning, match=r"Use short steps \(h=\) or, with named coordinates, metropolis=True"):
        compiled("svi:1", **{**WELL, "lagrangian": "x_dot**2/2 - abs(x)"})


@pytest.mark.tiers(0, 1)
def test_model_files_and_generated_programs_have_the_same_noise(tmp_path):
    model = sc.Model(system=sc.LagrangianSystem.from_text("well", **WELL), method="svi:2", q=[1.0], p=[0.0], h=0.1,
                     steps=50, save_every=50, seed=0)  # fmt: skip
    sc.save_model(model, tmp_path / "well.toml")
    again = sc.load_model(tmp_path / "well.toml").integrate()
    assert (again.q == model.integrate().q).all()
    subprocess.run(
        ["scvi-codegen", "generate", "well.toml", "-o", "program"], cwd=tmp_path, check=True, capture_output=True
    )
    subprocess.run(["make", "run"], cwd=tmp_path / "program", check=True, capture_output=True)


def test_words_of_philox_and_normals_of_c():
    """Known answers of Random123 (kat_vectors), and the noise of a free particle after a step, sqrt(h/2) (xi + xi')."""
    words = 0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8
    chance, turn = ((high << 21 | low >> 11) * 2.0**-53 for high, low in (words[:2], words[2:]))
    known = np.sqrt(-2 * np.log(chance + 2.0**-53)) * np.exp(2j * np.pi * turn)
    assert normal_numbers(0, 0, 0, 0, 0) == pytest.approx(known, rel=1e-15)
    free = compiled("stoermer-verlet", "free", coordinates=["x"], lagrangian="x_dot**2/2", noise={"x": "1"})
    seed, rest = 2**40 + 3, np.zeros((5, 1))
    momenta = free.integrate_ensemble(rest, rest, h=0.5, steps=9, seed=seed).p[:, :, 0]
    pairs = normal_numbers(seed, np.arange(5), np.arange(9)[:, np.newaxis], 0, 1)
    assert np.abs(np.diff(momenta, axis=0) - (pairs.real + pairs.imag) / 2).max() < 1e-14


def test_coloured_noise_is_the_exact_sequence_of_each_trajectory():
    ramp = compiled(
        *("svi:1", "ramp"), coordinates=["x"], lagrangian="x_dot**2/2", forces={"x": "u + w"}, inputs=["w", "u"]
    )
    h, (sigma, tau), rest = 0.25, (0.7, 1.5), np.zeros((3, 1))
    inputs = {"u": sc.ColouredNoise(sigma, tau), "w": 0.0}
    runs = ramp.integrate_ensemble(rest, rest, h=h, steps=20, inputs=inputs, seed=5)
    u = np.diff(runs.p[:, :, 0], axis=0) / h  # the force in each step
    xi = normal_numbers(5, np.arange(3), np.arange(20)[:, np.newaxis], 2, 1).real
    expected = sigma * xi
    for n in range(1, 20):
        expected[n] = np.exp(-h / tau) * expected[n - 1] + sigma * np.sqrt(1 - np.exp(-2 * h / tau)) * xi[n]
    assert np.abs(u - expected).max() < 1e-13
    single = ramp.integrate(rest[0], rest[0], h=h, t_end=2.6, inputs=inputs, seed=5)
    assert (single.p[:11] == runs.p[:11, 0]).all()
    assert single.p[11, 0] - single.p[10, 0] == pytest.approx(0.1 * expected[10, 0])
    back = ramp.integrate(rest[0], rest[0], h=-h, steps=5, inputs=inputs, seed=5)
    assert np.diff(back.p[:, 0]) == pytest.approx(-h * expected[:5, 0])
    many = normal_numbers(1, np.arange(20000), np.arange(3)[:, np.newaxis], 2, 0).real
    values = sc.ColouredNoise(sigma, tau).values(h, many)
    for lag in range(3):  # covariance sigma^2 e^(-lag h / tau) within four standard errors
        exact = sigma**2 * np.exp(-lag * h / tau)
        assert abs((values[2 - lag] * values[2]).mean() - exact) < 4 * np.sqrt((sigma**4 + exact**2) / 20000)
    with pytest.raises(sc.StateError, match="requires fixed steps"):
        ramp.integrate(rest[0], rest[0], t_end=1.0, inputs=inputs)
    with pytest.raises(sc.StateError, match="tau > 0"):
        sc.ColouredNoise(1.0, 0.0)
