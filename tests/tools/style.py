"""C style as specified by clang-format."""

import subprocess
import sysconfig
from pathlib import Path

STYLE = Path(__file__).parents[2] / ".clang-format"
CLANG_FORMAT = Path(sysconfig.get_path("scripts")) / "clang-format"


def check_style(text: str) -> None:
    assert [line for line in text.splitlines() if len(line) > 120] == []
    assert "\n\n\n" not in text
    command = [str(CLANG_FORMAT), f"--style=file:{STYLE}", "--assume-filename=integrator.c"]
    formatted = subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout
    assert formatted == text
