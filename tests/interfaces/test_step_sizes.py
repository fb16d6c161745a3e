"""Options of adaptive steps on the command line."""

import json

import pytest
from click.testing import CliRunner

from scvi_codegen.interfaces.cli import main


@pytest.mark.parametrize("bound", [["--tolerance", "1e-8"], ["--error", "1e-6"]])
def test_options_of_adaptive_steps_replace_the_step_size_of_a_model(bound):
    """Kepler's problem of the catalogue has a fixed step size of 0.25, and would take 7 steps of this tolerance."""
    words = ["run", "kepler", *bound, "--max-step", "0.1", "--first-step", "0.05", "--span", "5", "--json"]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0
    assert json.loads(done.stdout)["steps"] >= 50
