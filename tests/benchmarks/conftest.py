"""Fixtures of the tests of benchmarks."""

from pathlib import Path

import pytest

from scvi_codegen.common.cache import CACHE_VARIABLE


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def own_cache(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile and store references in a folder of the file, not in the user's cache."""
    monkeypatch.setenv(CACHE_VARIABLE, str(folder))
