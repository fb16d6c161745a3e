"""Memory of runs over arrays: nothing that a caller changes later, and no damaged bytes, lead C out of its arrays."""

import copy
import json
import pickle
from typing import Any

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.runs.stepping.memory import RANGES
from scvi_codegen.runs.stepping.saving import DIGEST, MAGIC, sealed

BONDS = [[0, 1], [1, 2]]
Q = [1.0, 2.5, 3.0]
K = np.array([1.0, 2.0])


@pytest.fixture(scope="module")
def chain() -> sc.Stepper:
    text = "sum(i in N, q_dot[i]**2/2) - sum(b in B, k[b]*(q[bonds[b, 1]] - q[bonds[b, 0]])**2/2)"
    system = lagrange(
        "chain", "q[N]", text, tables=["bonds[B, 2]"], parameters={"k[B]": 1.0}, inputs="F", forces={"q[0]": "F"}
    )
    return sc.compile_stepper(system, "svi:3", flags=QUICK_FLAGS)


@pytest.fixture(scope="module")
def pendulums() -> sc.Stepper:
    """Return pendulums with constraints, whose memory depends on positions."""
    text = "sum(i in N, x_dot[i]**2/2 + y_dot[i]**2/2 - y[i])"
    system = lagrange("pendulums", "x[N] y[N]", text, constraints=["x[i]**2 + y[i]**2 - 1 for i in N"])
    return sc.compile_stepper(system, "stoermer-verlet", flags=QUICK_FLAGS)


def start(stepper: sc.Stepper, **given: Any) -> Any:
    """A run of either system."""
    if stepper.interface.layout.constraints:
        return stepper.start({"x": [0.6, 1.0], "y": [0.8, 0.0]}, **({"h": 0.05} | given))
    return stepper.start(Q, **({"h": 0.05, "tables": {"bonds": BONDS}, "parameters": {"k": K, "F_0": 0.5}} | given))


class TestWhatACallerChangesLater:
    @pytest.mark.parametrize("value", [10**6, 10**4, -50])
    @pytest.mark.parametrize("order", ["C", "F"])
    def test_later_changes_of_tables_and_fields_do_not_affect_the_run(self, chain: Any, value: int, order: Any) -> None:
        table, k = np.array(BONDS, dtype=np.int32, order=order), K.copy()
        run = start(chain, tables={"bonds": table}, parameters={"k": k, "F_0": 0.5})
        other = start(chain)
        table[0, 0], k[0] = value, 1e300
        for each in (run, other):
            each.advance(3)
        assert (run.q["q"] == other.q["q"]).all()

    @pytest.mark.parametrize("table", [[[0, 1], [1]], [[0, [1]], [1, 2]], [[0, 2**70], [1, 2]], "ab"])
    def test_table_that_is_not_an_array_is_named(self, chain: Any, table: Any) -> None:
        with pytest.raises(sc.StateError, match="the table 'bonds'"):
            start(chain, tables={"bonds": table})


class TestPickles:
    @pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda run: pickle.loads(pickle.dumps(run))])
    @pytest.mark.parametrize("given", [{}, {"h": None, "t_end": 20.0, "tolerance": 1e-6}], ids=["h", "t_end"])
    def test_pickled_run_continues_identically(self, chain: Any, copied: Any, given: Any) -> None:
        run = start(chain, **given, options=sc.SolverOptions(max_iterations=40), threads=2)
        run.advance(3)
        other = copied(run)
        for name in ("t", "h", "plan", "options", "steps", "iterations"):
            assert getattr(other, name) == getattr(run, name), name
        assert other.stepper.problem.threads == 2
        for each in (run, other):
            each.advance(5)
        assert (run.q["q"] == other.q["q"]).all()
        run.advance(1)  # of its own
        assert run.steps == 9
        assert other.steps == 8

    def test_input_that_is_not_set_remains_not_set(self, chain: Any) -> None:
        run = start(chain, parameters={"k": K})
        for other in (copy.copy(run), chain.from_checkpoint(run.checkpoint())):
            with pytest.raises(sc.StateError, match="the input 'F' is not set"):
                other.advance(1)


def parts(saved: bytes) -> tuple[dict[str, Any], bytes]:
    """Header of a saved run, and its arrays and memory."""
    text, _, rest = saved[len(MAGIC) + DIGEST :].partition(b"\n")
    return json.loads(text), rest


def put_together(header: dict[str, Any], rest: bytes) -> bytes:
    """Bytes of such a run with the right checksum."""
    return sealed(json.dumps(header).encode() + b"\n" + rest)


class TestDamage:
    """Bytes of the whole file, numbers behind a right checksum: refused, or a run that goes on within its arrays."""

    @pytest.mark.parametrize("value", [-1, 3, 2**40, 2**63 - 1, -(2**62)])
    @pytest.mark.parametrize("name", [name for name in RANGES if name != "fallback_steps"])
    def test_invalid_counts_are_rejected(self, chain: Any, name: str, value: int) -> None:
        run = start(chain, h=None, t_end=2.0)
        run.advance(3)
        header, rest = parts(run.checkpoint())
        fields = bytearray(rest)
        fields_of = dict(run.stepper.binding._ffi.typeof(run._memory).item.fields)
        first = len(rest) - len(run.snapshot) + fields_of[name].offset - fields_of["t"].offset
        fields[first : first + 8] = np.int64(value).tobytes()
        least, most = RANGES[name]
        if least <= value <= most:
            chain.from_checkpoint(put_together(header, bytes(fields)), t_end=2.0).advance(3)
            return
        with pytest.raises(sc.StateError, match=name):
            chain.from_checkpoint(put_together(header, bytes(fields)), t_end=2.0)

    @pytest.mark.rotated
    @pytest.mark.parametrize("which", ["chain", "pendulums"])
    def test_damage_behind_a_right_checksum_is_detected(self, which: str, request: Any) -> None:
        stepper = request.getfixturevalue(which)
        run = start(stepper)
        run.advance(2)
        (header, rest), refused = parts(run.checkpoint()), 0
        size = 8 if which == "pendulums" else 4
        numbers = [
            (-(10**6), np.int32),
            (10**6, np.int32),
            (np.nan, np.float64),
            (-1e300, np.float64),
            (1e300, np.float64),
        ]
        spoiled = [
            (header, rest[:first] + kind(value).tobytes() + rest[first + kind(value).nbytes :])
            for first in range(0, len(rest) - 8, size)
            for value, kind in numbers
        ]
        spoiled += [(header, rest[:-8]), (header, rest + rest[-8:]), (header, b"")]
        for name in header:
            for value in ({}, [], [10**6], -1, None, {"N": 10**6, "B": 10**6}, {"N": -1, "B": -1}, {"N": "a"}):
                spoiled.append((header | {name: value}, rest))
        for each in spoiled:
            try:
                other = stepper.from_checkpoint(put_together(*each))
                other.advance(2)
            except (sc.StateError, sc.StepFailedError):
                refused += 1
        assert refused > 100

    def test_run_of_another_integrator_is_rejected(self, chain: Any, pendulums: Any) -> None:
        with pytest.raises(sc.StateError, match="not of 'pendulums"):
            pendulums.from_checkpoint(start(chain).checkpoint())

    def test_bytes_of_another_step_type_are_rejected(self, chain: Any) -> None:
        with pytest.raises(sc.StateError, match="give t_end"):
            chain.from_checkpoint(start(chain, h=None, t_end=2.0).checkpoint())
        with pytest.raises(sc.StateError, match="omit t_end"):
            chain.from_checkpoint(start(chain).checkpoint(), t_end=2.0)


@pytest.mark.rotated
def test_invalid_step_size_levels_are_rejected_also_for_scalar_runs() -> None:
    system = sc.LagrangianSystem.from_text(name="pendulum", coordinates=["q"], lagrangian="q_dot**2/2 + cos(q)")
    stepper = sc.compile_stepper(system, "svi:3", flags=QUICK_FLAGS)
    run = stepper.start([1.0], [0.0], t_end=5.0, tolerance=1e-6)
    run.advance(3)
    for name in ("grid_level", "change", "change_before", "direction"):
        for value in (-(2**63), 2**63 - 1, 2**20):
            before = getattr(run._memory, name)
            setattr(run._memory, name, value)
            with pytest.raises(sc.StateError, match=f"invalid saved run.*{name}"):
                stepper.from_checkpoint(run.checkpoint(), t_end=5.0, tolerance=1e-6)
            setattr(run._memory, name, before)
