"""Jumps of L across surfaces u(q, t) = 0: momenta are refracted or reflected. Closed forms, and features by system."""

import warnings

import numpy as np
import pytest
from notation import hamilton, lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.runs.stepping.features import require

PLANE = "(x_dot**2 + y_dot**2)/2"


def compiled(text, coordinates="x y", method="svi:4", **given):
    return sc.compile_stepper(lagrange("jump", coordinates, text, **given), method, flags=QUICK_FLAGS)


def end(run):
    return np.concatenate([run.q[-1], run.p[-1]])


@pytest.mark.second
@pytest.mark.parametrize("plan", [{"t_end": 5.0}, {"h": 0.17, "steps": 30}], ids=["adaptive", "fixed"])
def test_snells_law_total_reflection_and_scattering(plan):
    """Index of refraction n = sqrt(1 - 2 V): sin(a) = n sin(b) up to the critical angle."""
    step, n = compiled(f"{PLANE} - V*unit_step(x)", V=0.3), np.sqrt(0.4)
    for angle in (0.0, 0.3, np.arcsin(n) - 1e-6, np.arcsin(n) + 1e-6, 1.2):
        run = step.integrate([-0.3, 0.0], [np.cos(angle), np.sin(angle)], **plan)
        exact = np.sqrt(n**2 - np.sin(angle) ** 2) if np.sin(angle) < n else -np.cos(angle)
        assert run.p[-1] == pytest.approx([exact, np.sin(angle)], abs=1e-12)
        assert run.switches[0].side.tolist() == [np.sign(exact)]
    # a disc turns by 2 (b - a), sin(a) = impact parameter, sin(b) = sin(a)/n, or by pi - 2 a where sin(a) > n
    disc = compiled(f"{PLANE} - V*unit_step(1 - x**2 - y**2)", V=1.0)
    for V, s in [(-0.7, 0.3), (-0.7, -0.9), (0.4, 0.0), (0.4, 0.3), (0.4, 0.8), (0.4, 0.7)]:
        run = disc.integrate([-3.0, s], [1.2, 0.0], **plan, parameters={"V": V})
        n, a = np.sqrt(1 - 2 * V / 1.44), np.arcsin(s)
        turned = 2 * (np.arcsin(s / n) - a) if abs(s) < n else np.pi - 2 * a
        assert np.arctan2(*run.p[-1, ::-1]) == pytest.approx(turned, abs=2e-15)
        assert run.energy_error() < 1e-15


@pytest.mark.second
def test_a_square_well_and_a_moving_step():
    well = compiled("x_dot**2/2 - V*(1 - unit_step(x + 1)*unit_step(1 - x))", "x", V=2.0)
    run = well.integrate([0.3], [1.1], t_end=400 / 1.1)
    assert sum(map(len, run.switches)) == 200
    assert end(run) == pytest.approx([0.3, 1.1], abs=1e-11)
    moving = compiled("x_dot**2/2 - V*unit_step(x - c*t)", "x", V=0.3, c=0.4)
    for v, x in ((1.5, -1.0), (1.1, -1.0), (-1.0, 1.0)):
        before = v - 0.4  # in the frame of the step
        squared, met = before**2 - np.copysign(0.6, v), -x / before
        after = np.copysign(np.sqrt(squared), v) if squared > 0 else -before
        exact = [x + v * met + (after + 0.4) * (4 - met), after + 0.4]
        assert end(moving.integrate([x], [v], t_end=4.0)) == pytest.approx(exact, abs=2e-15)


@pytest.mark.rotated
def test_masses_relativistic_energies_and_constraints():
    mass = compiled("(1 + 3*unit_step(x))*x_dot**2/2", "x")
    assert end(mass.integrate([-1.0], [1.0], t_end=3.0)) == pytest.approx([1.0, 2.0], abs=1e-15)
    fast = compiled("-sqrt(1 - x_dot**2 - y_dot**2) - V*unit_step(x)", V=0.2)
    for p, after in ((1.0, np.sqrt((np.sqrt(6) - 0.2) ** 2 - 5)), (0.4, -0.4)):
        assert fast.integrate([-0.5, 0.0], [p, 2.0], t_end=3.0).p[-1, 0] == pytest.approx(after, abs=1e-14)
    rod = compiled(f"{PLANE} - y - V*unit_step(x - 0.2)", constraints=["x**2 + y**2 - 1"], V=0.3)
    angle = compiled("a_dot**2/2 + cos(a) - V*unit_step(sin(a) - 0.2)", "a", "svi:8", V=0.3)
    a = angle.integrate([-np.arcsin(0.6)], [0.9], t_end=5.0).q[-1, 0]
    run = rod.integrate([-0.6, -0.8], [0.72, -0.54], h=0.05, steps=100)
    assert run.q[-1] == pytest.approx([np.sin(a), -np.cos(a)], abs=1e-11)


@pytest.mark.rotated
def test_energy_is_kept_over_ten_thousand_crossings():
    box = f"{PLANE} - x**2/2 - 0.9*y**2 - V*unit_step(x - 0.1) - W*unit_step(y + x/5)"
    stepper = compiled(box, method="svi:8", V=0.3, W=0.2)
    run = stepper.integrate([-1.0, 0.4], [0.7, 0.3], t_end=14000.0, check_growth=False)
    assert sum(map(len, run.switches)) > 10000
    assert np.abs(run.energy() - run.energy()[0]).max() < 2e-13


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("method", "order"), [("svi:1", 2), ("svi:2", 4), ("svi:4", 8)])
def test_orders_and_tolerances_across_crossings(method, order):
    step = compiled("x_dot**2/2 - x**2/2 - V*unit_step(x)", "x", method, V=0.3)
    exact = 1.4**0.5 * np.array([np.sin(3.0 - np.pi / 4), np.cos(3.0 - np.pi / 4)])
    run = lambda **plan: np.abs(end(step.integrate([-1.0], [1.0], **plan)) - exact).max()  # noqa: E731
    errors = [run(h=3.0 / n, steps=n) for n in (4, 8)]
    assert np.log2(errors[0] / errors[1]) > order - 0.5
    assert order == 2 or run(t_end=3.0, tolerance=1e-8) < 1e-7


@pytest.mark.rotated
def test_derivatives_through_refraction_are_those_of_runs():
    text = f"{PLANE} + y*x_dot*b*unit_step(x - c*t**2) - V*unit_step(x - c*t**2 + y/3)*(1 + m*x_dot**2)"
    free, disc = compiled(text, b=0.2, c=0.2, V=0.3, m=0.1), compiled(f"{PLANE} - V*unit_step(1 - x**2 - y**2)", V=0.9)
    for stepper, z in ((free, [-1.5, 0.2, 1.6, 0.2]), (free, [1.5, 0.2, -1.6, 0.2]), (disc, [-3.0, 0.4, 1.2, 0.0])):
        x, k = np.array(z), np.array(stepper.defaults)
        plan = {"t_end": 3.0} if stepper is disc else {"h": 0.1, "steps": 30}
        run = lambda d: stepper.integrate(x[:2] + d[:2], x[2:] + d[2:4], parameters=k + d[4:], **plan)  # noqa: B023, E731
        varied = np.eye(4 + len(k))[: 4 + len(k) - len(stepper.modes)]
        found = run(np.zeros(4 + len(k))).sensitivity()
        exact = [(end(run(1e-6 * d)) - end(run(-1e-6 * d))) / 2e-6 for d in varied]
        by = np.hstack([found.state[-1], found.parameters[-1][:4]])[:, : len(varied)]
        assert by == pytest.approx(np.transpose(exact), abs=1e-8)


@pytest.mark.second
def test_corners_starts_and_grazes():
    corner = compiled(f"{PLANE} - where(x > 0, 0.3, 0) - where(y > 0, 0.2, 0)")
    for q, p in (((-1.0, -1.0), (0.4**0.5, 0.6**0.5)), ((0.0, -1.0), (1.0, 0.6**0.5)), ((0.0, 0.0), (1.0, 1.0))):
        assert corner.integrate(q, [1.0, 1.0], t_end=3.0).p[-1] == pytest.approx(p, abs=1e-15)
    along = corner.integrate([0.0, -1.0], [0.0, 1.0], t_end=3.0)  # on the surface x = 0
    assert (along.p[-1, 0], len(along.switches[0]), along.steps < 10) == (0.0, 0, True)
    swing = compiled(f"{PLANE} - y**2/2 - V*unit_step(y - 1)", V=-0.3)
    runs = [swing.integrate([0.0, 0.0], [1.0, v], t_end=20.0) for v in (1 - 1e-9, 1.0, 1 + 1e-9)]
    assert [len(run.switches[0]) for run in runs] == [0, 0, 6]


@pytest.mark.second
@pytest.mark.filterwarnings("error::scvi_codegen.common.errors.AccuracyWarning")
def test_starts_on_a_jump_have_the_energy_of_their_side():
    fall = compiled("x_dot**2/2 - x/4 - V*unit_step(x)", "x", V=0.3)
    for v in (-1.0, 0.0):
        run = fall.integrate([0.0], [v], t_end=2.0)
        assert (run.switches[0].side.tolist(), run.energy_error() < 1e-15) == ([], True)
        assert run.q[-1, 0] == pytest.approx(2 * v - 0.5, abs=1e-15)
    assert fall.integrate_ensemble([[0.0]], [[-1.0]], t_end=2.0).energy()[-1] == pytest.approx(0.5, abs=1e-15)


MODES, WARNS, REFUSED = "modes", "as formulas, with a warning once", "refused"
METHODS = ("svi:2", "gauss:2", "sc:3", "stoermer-verlet", "composition:4", "scvi:2")
ROWS = dict.fromkeys(METHODS, (MODES, MODES)) | dict.fromkeys(
    ("tau", "double-double", "arrays", "chaos_ensemble", "path", "flow"), (WARNS, REFUSED)
)
ROWS |= dict.fromkeys(("hessian", "observe_ensemble"), (REFUSED, REFUSED))
USES = {
    "tau": lambda step: of_line(step, time_transformation="1/(1 + x**2)"),
    "double-double": lambda step: of_line(step, precision="double-double"),
    "arrays": lambda step: compiled(f"sum(i in N, x_dot[i]**2/2 - {step.replace('x', 'x[i]')})", ["x[N]"]),
    "chaos_ensemble": lambda step: of_line(step).chaos_indicators_ensemble([[0.5]], [[0.3]], h=0.1, steps=9),
    "path": lambda step: of_line(step).path([0.5], [-0.3], 1.0, steps=10),
    "flow": lambda step: require(of_line(step), "flow") or True,
}


def of_line(step, method="svi:2", **given):
    system = hamilton("h", "x", f"p_x**2/2 + x**2/2 + {step}")
    system = system if method == "gauss:2" else lagrange("k", "x", f"x_dot**2/2 - x**2/2 - {step}")
    return sc.compile_stepper(system, method, flags=QUICK_FLAGS, **given)


def outcome(name, step):
    if name in METHODS:
        return {2: MODES}.get(len(of_line(step, name).integrate([0.5], [0.3], h=0.1, steps=60).switches[0]))
    with warnings.catch_warnings(record=True) as issued:
        warnings.simplefilter("always", sc.MethodWarning)
        try:
            if not USES.get(name, lambda step: of_line(step).supports(name))(step):
                return REFUSED
        except (sc.MethodError, sc.SystemDefinitionError):
            return REFUSED
    return {0: MODES, 1: WARNS}.get(sum("kinks" in str(warning.message) for warning in issued))


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("name", ROWS)
def test_features_locate_kinks_or_warn_or_refuse(name):
    assert (outcome(name, "positive_part(x)**2"), outcome(name, "unit_step(x)")) == ROWS[name]
