"""Scripts in ``examples/optimal_control`` reproduce their page and agree with direct collocation."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "optimal_control"
NUMBER = r"([-+.\de]+)"

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("as_users_compile")]


@pytest.mark.parametrize(
    ("name", "steps", "cost", "apart", "off"),
    [
        ("swing_up", 40, 73.9387, 2e-5, 1e-4),
        ("reorientation", 40, 1.77200, 2e-6, 2e-4),
        ("orbit_transfer", 40, 30.4702, 1e-6, 2e-6),
    ],
)
def test_direct_and_indirect_solutions_have_equal_cost_and_end(name, steps, cost, apart, off, tmp_path):
    pytest.importorskip("casadi", reason="needs the extra 'casadi'")
    command = [sys.executable, "-W", "error", str(FOLDER / f"{name}.py"), str(steps)]
    environment = os.environ | {"PYTHONPATH": str(FOLDER.parents[1]), "MPLBACKEND": "agg"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "not solved" not in done.stdout
    rows = {
        line[:19].strip(): [float(word) for word in line[19:].split() if word[0].isdigit()]
        for line in done.stdout.splitlines()[1:3]
    }
    ours, theirs = rows["discrete mechanics"], rows["collocation"]
    assert ours[1] < 0.7 * theirs[1]
    assert ours[4] == pytest.approx(cost, rel=1e-5)
    assert theirs[4] == pytest.approx(ours[4], rel=apart)
    assert max(ours[5], theirs[5]) < off
    assert float(re.search(rf"inputs found ends {NUMBER} from", done.stdout)[1]) < 1e-6
    if name == "reorientation":
        assert ours[6] < 1e-12 < 1e-8 < theirs[6]
    assert (tmp_path / f"{name}.png").stat().st_size > 10_000
