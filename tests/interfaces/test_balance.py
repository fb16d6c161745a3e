"""The balance of energy that ``run`` prints where forces or damping act: E - E0 - W, of the run's own steps."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import output_of

from scvi_codegen import SVI, Event, LagrangianSystem, Model, StateError, compile_stepper, generate_package, save_model
from scvi_codegen.runs.results.energy import MOST_BALANCED_COORDINATES, MOST_BALANCED_STEPS, energy_account

pytestmark = [pytest.mark.usefixtures("here"), pytest.mark.rotated]
MODEL = """
[system]
name = "damped pair"
coordinates = ["x", "y"]
lagrangian = "(x_dot**2 + y_dot**2)/2 - (x - y)**4/4"

[forces]
x = "-x_dot/10"

[initial]
q = [1.0, 0.0]
q_dot = [0.0, 0.5]

[method]
method = "svi:4"

[run]
step = 0.1
steps = 70
save_every = 7
"""


def printed(model, *words):
    Path("model.toml").write_text(model)
    return output_of("run", "model.toml", *words)


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "changed",
    [
        {"(x - y)**4/4": "(2 + cos(t))*(x - y)**4/12"},
        {"svi:4": "radau-iia:2"},
        {"steps = 70": f"steps = {MOST_BALANCED_STEPS + 1}"},
        {'[forces]\nx = "-x_dot/10"\n': ""},
    ],
    ids=["L has time", "a method without account", "many steps", "no forces"],
)
def test_conservative_systems_have_no_balance(changed):
    model = MODEL
    for old, new in changed.items():
        assert old in model
        model = model.replace(old, new)
    assert "E - E0 - W" not in printed(model)
    found = json.loads(printed(model, "--json"))
    assert found["work"] is None
    assert found["energy_balance"] is None


@pytest.mark.parametrize("sizes", [{"N": MOST_BALANCED_COORDINATES + 1}, None])
def test_many_coordinates_have_no_balance_unless_it_is_asked_for(sizes):
    system = LagrangianSystem.from_text(
        "chain", ["q[N]"], "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)", dissipation="sum(i in N, q_dot[i]**2/20)"
    )
    stepper, n = compile_stepper(system, "svi:3", sizes=sizes), MOST_BALANCED_COORDINATES + 1
    run = stepper.integrate({"q": [1.0] * n}, {"q": [0.0] * n}, h=0.1, steps=20)
    assert energy_account(run, limited=True).title == "energy change |E - E0|: forces act"
    assert energy_account(run).title == "energy balance |E - E0 - W| / |E0|"
    assert run.energy_error() < 1e-7 < 0.1 < abs(run.energy() - run.energy()[0]).max()


PENDULUM = "q_dot**2/2 + cos(q)"
KINDS = {
    "damped": ({"lagrangian": PENDULUM, "forces": {"q": "-q_dot/5"}}, {}, "energy balance"),
    "falling": (
        {"lagrangian": "q_dot**2/2 - q"},
        {"events": Event("q", direction=-1, then={"p_q": "-9*p_q/10"})},
        "energy balance",
    ),
    "driven": ({"lagrangian": f"{PENDULUM} + q*sin(t)"}, {}, "energy change |E - E0|: L depends on time"),
    "driven and damped": (
        {"lagrangian": f"{PENDULUM} + q*sin(t)", "forces": {"q": "-q_dot/5"}},
        {},
        "energy change |E - E0|: forces act",
    ),
    "free": ({"lagrangian": PENDULUM}, {}, "relative energy error"),
}


@pytest.mark.parametrize("name", KINDS)
def test_a_change_with_a_reason_is_no_error(name):
    """Of energy_error(), plots and the generated program."""
    fields, options, title = KINDS[name]
    system = LagrangianSystem.from_text(name, ["q"], **fields)
    run = compile_stepper(system, "svi:4").integrate([1.0], [0.3], h=0.05, steps=100, **options)
    changed = abs(run.energy() - run.energy()[0]).max()
    assert (changed > 0.05) == (name != "free")
    axes = run.plot.energy()
    shown = max(np.nanmax(abs(line.get_ydata())) for line in axes.get_lines())
    assert shown == pytest.approx(changed) if name != "free" else shown < 1e-6
    assert axes.get_title().startswith("energy change E - E0: " if name != "free" else title)
    assert ("beside the work" in axes.get_title()) == title.startswith("energy balance")
    if title.startswith("energy change"):
        with pytest.raises(StateError, match=r"changes \((L depends on time|forces act)\).* no error: use energy\(\)"):
            run.energy_error()
    else:
        assert run.energy_error() < 1e-6
    if not options:
        model = Model(system=system, method=SVI(2), q=(1.0,), velocity=(0.3,), h=0.05, steps=100)
        text = (generate_package(model, Path("generated")) / "main.c").read_text()
        assert ("energy_error" in text) == (name == "free")
        assert ("energy_change" in text) == (name != "free")
        assert all(title.partition(" |")[0] in text for text in reports_of(model))


def reports_of(model):
    """Yield what the command line prints of a run, a recorded run and an ensemble of a model."""
    save_model(model, "model.toml")
    Path("grid.toml").write_text("[grid]\nq = [0.5, 1.0]\n")
    for words in ((), ("-o", "states.run"), ("--ensemble", "grid.toml")):
        yield (
            output_of("run", "model.toml", *words)
            .replace("energy: forces act, it changed", "energy change")
            .replace("energy: L depends on time, it changed", "energy change")
        )


def test_balance_of_an_ensemble_is_the_largest_of_its_trajectories():
    Path("grid.toml").write_text("[grid]\nx = [0.5, 1.0, 1.5]\n")
    found = json.loads(printed(MODEL, "--ensemble", "grid.toml", "--json"))["energy_balance"]
    single = [json.loads(printed(MODEL.replace("1.0, 0.0", f"{x}, 0.0"), "--json")) for x in (0.5, 1.0, 1.5)]
    assert found == pytest.approx(max(each["energy_balance"] for each in single), rel=1e-3)
    changed = printed(MODEL.replace("(x - y)**4/4", "(2 + cos(t))*(x - y)**4/12"), "--ensemble", "grid.toml")
    assert "it changed by" in changed
    assert "E - E0 - W" not in changed
