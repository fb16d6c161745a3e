"""Shell completion, tested in the shells."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from programs import needs

pytestmark = pytest.mark.full

ASKED = {
    "bash": """
compopt() {{ :; }}
eval "$(_SCVI_CODEGEN_COMPLETE=bash_source scvi-codegen)"
COMP_WORDS=({words}) COMP_CWORD={last}
_scvi_codegen_completion scvi-codegen
printf '%s\\n' "${{COMPREPLY[@]}}"
""",
    "zsh": """
compdef() {{ :; }}
_path_files() {{ :; }}
compadd() {{ while [[ $1 != -a ]]; do shift; done; print -l -- ${{(P)2}}; }}
_describe() {{ print -l -- ${{${{(P)3}}%%:*}}; }}
words=({words}) CURRENT=$(({last} + 1))
eval "$(_SCVI_CODEGEN_COMPLETE=zsh_source scvi-codegen)"
_scvi_codegen_completion
""",
    "fish": """
_SCVI_CODEGEN_COMPLETE=fish_source scvi-codegen | source
complete -C '{words}' | cut -f 1
""",
}
"""What fills the shell's list as its own completion would; what works in an editor of lines
alone is left out."""


def completed(shell: str, *words: str) -> set[str]:
    needs(shell)
    script = ASKED[shell].format(words=" ".join(words), last=len(words) - 1)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    result = subprocess.run(
        [shell, "-c", script], env=os.environ | {"PATH": path}, capture_output=True, text=True, check=True, timeout=60
    )
    assert result.stderr == ""
    return set(result.stdout.split())


@pytest.mark.parametrize("shell", ASKED)
def test_commands_problems_and_methods_are_completed(shell):
    assert completed(shell, "scvi-codegen", "do") == {"doctor"}
    assert completed(shell, "scvi-codegen", "run", "kep") == {"kepler"}
    assert "--method" in completed(shell, "scvi-codegen", "run", "--met")
