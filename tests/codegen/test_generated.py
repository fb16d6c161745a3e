"""The integrators in ``generated/`` are those of today's generator, and compile with every warning an error."""

import difflib
import importlib.util
from functools import cache
from pathlib import Path

import pytest
from programs import needs
from strict_c import STRICT, run

FOLDER = Path(__file__).parents[2] / "generated"
REMEDY = "run: python generated/remake.py"


@cache
def fresh() -> dict[str, str]:
    """Text by file name, as the generator makes it now."""
    spec = importlib.util.spec_from_file_location("remake", FOLDER / "remake.py")
    assert spec is not None
    assert spec.loader is not None
    remake = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(remake)
    return remake.texts()


def stored() -> dict[str, str]:
    """Return the text of each file of the folder, by name."""
    return {path.name: path.read_bytes().decode("utf-8") for path in sorted(FOLDER.glob("*.[ch]"))}


def test_no_file_is_missing_or_orphaned():
    assert sorted(stored()) == sorted(name for name in fresh() if "/" not in name), REMEDY


def test_no_file_is_outdated():
    old, new = stored(), fresh()
    changes = [
        line
        for name in sorted(set(old) & set(new))
        for line in difflib.unified_diff(
            old[name].splitlines(True), new[name].splitlines(True), f"generated/{name}", f"{name} as generated now"
        )
    ]
    if changes:
        pytest.fail(f"generated files are stale, {REMEDY}\n{''.join(changes)}", pytrace=False)


@pytest.mark.rotated
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_every_file_compiles_with_all_warnings_as_errors(compiler, tmp_path):
    needs(compiler)
    for name, text in fresh().items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    sources = [name for name in stored() if name.endswith(".c")]
    assert sources
    run([compiler, *STRICT, "-O2", "-c", *sources], tmp_path)
