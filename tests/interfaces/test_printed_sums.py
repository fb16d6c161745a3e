"""Printed derivations of array systems, read back from text: gradients, masses and complete steps."""

import re
from typing import Any

import numpy as np
import pytest
from printed_formulas import mp

import scvi_codegen as sc
from scvi_codegen.extras.derivation.equations import derive

COUNT, H, T, K = 5, 0.125, 0.375, 0.6875
MASSES = [1.25, 0.75, 1.5, 2.0, 0.875]
RING = sc.LagrangianSystem.from_text(
    name="ring",
    coordinates=["q[N]"],
    parameters={"k": 1.0, "m[N]": 1.0},
    lagrangian="sum(i in N, m[i]*q_dot[i]**2/2 - cos(t)*q[i]**2/3)"
    " - sum(i in N periodic, k*(q[i+1] - q[i])**2/2 + (q[i+1] - q[i])**4/4)",
)
ROTORS = sc.HamiltonianSystem.from_text(
    name="rotors",
    coordinates=["q[N]"],
    momenta=["p[N]"],
    parameters={"k": 1.0},
    hamiltonian="sum(i in N, p[i]**2*(1 + q[i]**2)/2) + sum(i in N periodic, k*cos(q[i+1] - q[i]))",
)
Q = [0.5, -0.25, 0.875, 0.125, -0.625]
P = [0.25, 0.5, -0.375, 0.625, 0.125]


def ring_force(q: Any, t: Any) -> Any:
    apart = np.roll(q, -1) - q
    pulls = K * apart + apart**3
    return pulls - np.roll(pulls, 1) - 2 * mp.cos(t) * q / 3


def rotor_rates(q: Any, p: Any) -> tuple[Any, Any]:
    turns = np.array([K * mp.sin(x) for x in np.roll(q, -1) - q], dtype=object)
    return p * (1 + q**2), -(p**2) * q + np.roll(turns, 1) - turns


class Around(list):  # type: ignore[type-arg]
    """A ring: places beyond the last are the first."""

    def __getitem__(self, place: Any) -> Any:
        return list.__getitem__(self, place % len(self))


def numbers(values: Any) -> Any:
    return np.array([mp.mpf(x) for x in values], dtype=object)


def whole(text: str) -> str:
    """Numbers as they are written, in 60 digits."""
    return re.sub(r"(?<![\w.])(\d+(?:\.\d+)?(?:e[+-]?\d+)?)", r"mpf('\1')", text)


def scope(**more: Any) -> dict[str, Any]:
    arrays = {"q": Around(numbers(Q)), "p": Around(numbers(P)), "m": Around(numbers(MASSES))}
    return {"mpf": mp.mpf, "cos": mp.cos, "sin": mp.sin, "k": mp.mpf(K), "t": mp.mpf(T)} | arrays | more


def at(text: str, i: int) -> Any:
    """A formula with index i: places are whole numbers."""
    placed = re.sub(r"\[i([+-]\d+)?\]", lambda found: f"<{i + int(found[1] or 0)}>", text)
    return eval(whole(re.sub(r"<", "[", placed)).replace(">", "]").replace("[mpf('", "[int('"), scope())


@pytest.mark.parametrize("system", [RING, ROTORS], ids=lambda system: system.name)
def test_gradients_of_terms_sum_to_forces(system):
    text = derive(system, sc.SVI(2) if system is RING else sc.Gauss(2)).to_text()
    added: dict[str, Any] = {"q": numbers([0] * COUNT), "p": numbers([0] * COUNT)}
    partials = re.findall(r"^    by (\w)\[i([+-]\d+)?\]: (.*)$", text, re.MULTILINE)
    assert len(partials) == text.count("    by ")
    for letter, shift, formula in partials:
        for i in range(COUNT):
            added[letter][(i + int(shift or 0)) % COUNT] += at(formula, i)
    if system is RING:
        assert np.max(np.abs(added["q"] - ring_force(numbers(Q), mp.mpf(T)))) < mp.mpf("1e-50")
        assert "  for i in N: m[i] at q[i]\n" in text
    else:
        rates, kicks = rotor_rates(numbers(Q), numbers(P))
        assert np.max(np.abs(-added["p"] - rates)) < mp.mpf("1e-50")
        assert np.max(np.abs(added["q"] - kicks)) < mp.mpf("1e-50")


def stepped(system: Any, method: Any) -> tuple[Any, Any]:
    """The C's step."""
    parameters = {"k": K, "m": MASSES} if system is RING else {"k": K}
    run = sc.compile_stepper(system, method).start(Q, P, h=H, t=T, parameters=parameters)
    run.advance(1)
    return run.q["q"], run.p["q"]


@pytest.mark.second
@pytest.mark.parametrize("method", [sc.StoermerVerlet(), sc.Composition(8)], ids=lambda method: method.name)
def test_kicks_and_drifts_are_the_step(method):
    q, p = numbers(Q), numbers(P)
    lines = derive(RING, method).to_text().partition("the force on it):\n")[2].splitlines()
    for line in lines:
        kick = re.fullmatch(r"  p \+= h\*\((.*)\)\*F at t \+ h\*\((.*)\)", line)
        drift = re.fullmatch(r"  q \+= h\*\((.*)\)\*p/m", line)
        if kick:
            p = p + mp.mpf(H) * mp.mpf(kick[1]) * ring_force(q, mp.mpf(T) + mp.mpf(H) * mp.mpf(kick[2]))
        else:
            q = q + mp.mpf(H) * mp.mpf(drift[1]) * p / numbers(MASSES)
    for found, expected in zip((q, p), stepped(RING, method), strict=True):
        np.testing.assert_allclose(found.astype(float), expected, rtol=1e-14, atol=1e-15)


@pytest.mark.rotated
@pytest.mark.parametrize(("system", "method"), [(RING, sc.SVI(2)), (RING, sc.Gauss(3)), (ROTORS, sc.Gauss(2))])
def test_points_and_ends_are_the_step(system, method):
    """Lines as they stand, again and again until they converge."""
    lines = derive(system, method).to_text().partition("of all):\n")[2].splitlines()
    known = scope(q=numbers(Q), p=numbers(P), m=numbers(MASSES), h=mp.mpf(H))
    known |= {f"{letter}_{n}": numbers([0] * COUNT) for letter in "FV" for n in range(3)}
    for _ in range(40):
        for line in lines:
            name, _, right = line.strip().partition(" = ")
            formula, _, time = right.partition(" at ")
            known[name.replace("'", "1")] = eval(whole(formula), known)
            if time:
                known[f"F{name[1:]}"] = ring_force(known[name], eval(whole(time), known))
            elif name.startswith("P_"):
                n = name[2:]
                known[f"V_{n}"], known[f"F_{n}"] = rotor_rates(known[f"Q_{n}"], known[name])
    for found, expected in zip((known["q1"], known["p1"]), stepped(system, method), strict=True):
        np.testing.assert_allclose(found.astype(float), expected, rtol=2e-14, atol=1e-15)
