"""Variables of the environment that make no sense are ignored, or refused by an error of the package."""

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import scvi_codegen as sc
from scvi_codegen.codegen.native import building, compilers
from scvi_codegen.codegen.rendering.source import Source


def refused(act: Callable[[], Any]) -> sc.ScviCodegenError | None:
    """The error of the package, if there is one; every other exception is one of the test."""
    with warnings.catch_warnings(action="ignore"):
        try:
            act()
        except sc.ScviCodegenError as error:
            return error
    return None


ENVIRONMENT = [
    ("CC", "gcc 'x"), ("CC", "true"), ("CC", "false"), ("CC", "/tmp"), ("CC", "/etc/passwd"), ("CC", "no-such-program"),
    ("CC", "' '"), ("CC", "cc -nonsense"), ("SCVI_CODEGEN_CFLAGS", "-O0 'x"), ("SCVI_CODEGEN_CFLAGS", "-nonsense"),
    ("SCVI_CODEGEN_CACHE", "/proc/none"), ("SCVI_CODEGEN_CACHE", "/dev/null"), ("SCVI_CODEGEN_CACHE", "x" * 5000),
    ("SCVI_CODEGEN_CACHE_SIZE", "huge"), ("SCVI_CODEGEN_CACHE_SIZE", "-1"), ("TMPDIR", "/no/such/folder"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "value"), ENVIRONMENT, ids=lambda text: text[:20])
def test_invalid_environment_variables_are_rejected(
    name: str, value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "double answer(void);\n"
    code = '#include "tiny.h"\ndouble answer(void) { return 1.0; }\n'
    tiny = Source(prefix="tiny", header=text, code=code, declarations=text)
    monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(tmp_path))
    monkeypatch.setattr(building, "_loaded", {})
    monkeypatch.setenv(name, value)
    compilers.compiler_version.cache_clear()
    error = refused(lambda: building.load(tiny, flags=("-O0",)))
    assert error is None or isinstance(error, sc.BuildError)
    assert os.environ[name] == value
