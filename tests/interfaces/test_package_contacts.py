"""Generated folders of contacts: no warning of an optimising compiler, which sees more than one that does not."""

import subprocess

from commands import invoke
from programs import needs

BALL = """
[system]
name = "ball"
coordinates = ["y"]
lagrangian = "y_dot**2/2 - 9.81*y"
[[contacts]]
gap = "y"
restitution = 0.5
[initial]
q = [1.0]
q_dot = [0.0]
[run]
step = 0.01
span = 1.0
"""


def test_contacts_without_friction_compile_without_warnings_when_optimised(tmp_path):
    """There is no slip: its length is 0, of whose components none is read."""
    (tmp_path / "ball.toml").write_text(BALL)
    invoke("generate", str(tmp_path / "ball.toml"), "--method", "svi:2", "-o", str(tmp_path / "ball_svi"))
    flags = ["-O2", "-std=c99", "-Wall", "-Wextra", "-Wno-psabi", "-Werror", "-c", "-o"]
    command = [needs("gcc"), *flags, str(tmp_path / "events.o"), str(tmp_path / "ball_svi" / "ball_svi_events.c")]
    subprocess.run(command, check=True)
