"""The cache folder: what is in it, what leaves it, what is not believed."""

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from commands import output_of

import scvi_codegen as sc
from scvi_codegen import BuildError, CacheWarning
from scvi_codegen.codegen import pipeline
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common import cache

FAST = ("-O0",)


def source(number: int) -> Source:
    declaration = f"double answer_{number}(void);\n"
    code = f'#include "small.h"\ndouble answer_{number}(void)\n{{\n  return {number}.0;\n}}\n'
    return Source(prefix="small", header=declaration, code=code, declarations=declaration)


def answer(number: int) -> float:
    building._loaded.clear()  # as a new process would
    return getattr(building.load(source(number), flags=FAST).lib, f"answer_{number}")()


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """An empty cache on disk, and nothing remembered in memory."""
    path = tmp_path / "cache"
    monkeypatch.setenv(cache.CACHE_VARIABLE, str(path))
    monkeypatch.delenv(cache.SIZE_VARIABLE, raising=False)
    monkeypatch.setattr(building, "_loaded", {})
    return path


def entry(folder: Path, number: int) -> Path:
    return folder / f"_scvi_{building.fingerprint(source(number), flags=FAST)}"


def entries_in(folder: Path) -> set[int]:
    return {number for number in range(10) if entry(folder, number).exists()}


def spring() -> sc.Stepper:
    building._loaded.clear()
    text = sc.LagrangianSystem.from_text(name="spring", coordinates=["q"], lagrangian="q_dot**2/2 - q**2/2")
    return sc.compile_stepper(text, sc.StoermerVerlet(), flags=FAST)


class TestSize:
    def test_least_recently_used_entries_are_removed_above_the_limit(self, folder, monkeypatch):
        for number in range(3):
            answer(number)
            os.utime(entry(folder, number), (number, number))
        monkeypatch.setenv(cache.SIZE_VARIABLE, str(int(3 * cache._size(entry(folder, 1)) / cache.FILLED) + 500))
        answer(0)  # used again, from the cache
        answer(3)
        assert entries_in(folder) == {0, 2, 3}
        answer(4)
        assert entries_in(folder) == {0, 3, 4}

    def test_sources_and_reference_solutions_count_towards_the_size(self, folder, monkeypatch):
        spring()
        (folder / "references").mkdir()
        (folder / "references" / "kepler.npz").write_bytes(bytes(1000))
        info = sc.cache_info()
        assert (info.integrators, info.texts, info.references) == (1, 2, 1)  # source and key of the system
        assert info.size == sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        monkeypatch.setenv(cache.SIZE_VARIABLE, "1K")
        answer(0)
        assert (entries_in(folder), sc.cache_info().texts, sc.cache_info().references) == ({0}, 0, 0)

    @pytest.mark.parametrize("given", ["huge", "-1", "1X", "1e9"])
    def test_invalid_size_is_named(self, given, monkeypatch):
        monkeypatch.setenv(cache.SIZE_VARIABLE, given)
        with pytest.raises(BuildError, match=f"SCVI_CODEGEN_CACHE_SIZE is '{given}': it must be a size"):
            answer(0)


class TestTrust:
    def test_world_writable_folder_is_not_used(self, folder):
        folder.mkdir()
        folder.chmod(0o777)
        with pytest.warns(CacheWarning, match=r"every user of this machine may write to it.*chmod go-w"):
            assert answer(1) == 1.0
        assert list(folder.iterdir()) == []
        with pytest.warns(CacheWarning):
            spring()
        assert list(folder.iterdir()) == []

    @pytest.mark.parametrize(
        ("owner", "me", "trusted"), [(1000, 1000, True), (0, 1000, True), (65534, 1000, False), (1000, 0, False)]
    )
    def test_folder_of_another_user_is_not_used(self, folder, monkeypatch, owner, me, trusted):
        """Folders of root are used by others, but root uses no others."""
        folder.mkdir(mode=0o755)
        stat = Path.stat

        def owned(path: Path, **given: bool) -> os.stat_result:
            found = list(stat(path, **given))
            return os.stat_result([*found[:4], owner, *found[5:]])

        monkeypatch.setattr(Path, "stat", owned)
        monkeypatch.setattr(os, "geteuid", lambda: me)
        if trusted:
            assert cache.trusted_folder() == folder
            return
        with pytest.warns(CacheWarning, match=rf"belongs to the user number {owner}, not to you \({me}\) or root"):
            assert cache.trusted_folder() is None

    def test_entries_of_another_user_are_not_loaded(self, folder, monkeypatch):
        """Other users' entries can be created only as root."""
        if os.geteuid() != 0:
            pytest.skip("only root gives files to other users")
        answer(1)
        forge(folder)
        os.chown(building._binding(entry(folder, 1)), 65534, 65534)
        assert answer(1) == 1.0
        forge(folder)
        os.chown(folder, 65534, 65534)
        with pytest.warns(CacheWarning, match="belongs to the user number 65534"):
            assert answer(1) == 1.0

    def test_world_writable_entry_is_rebuilt(self, folder, monkeypatch):
        for exposed in (entry(folder, 1), building._library(entry(folder, 1))):
            answer(1)
            forge(folder)
            exposed.chmod(0o777)
            assert answer(1) == 1.0
            assert not cache.exposed(exposed)

    def test_cache_is_private_under_a_permissive_umask(self, folder):
        with umask(0):
            spring()
        paths = [folder, *folder.rglob("*")]
        assert {"manifest.json", "texts"} <= {path.name for path in paths}
        assert [path for path in paths if path.stat().st_mode & 0o022] == []

    def test_modified_source_is_regenerated(self, folder, monkeypatch):
        first = spring()
        path = max((folder / "texts").glob("*.json"), key=lambda each: each.stat().st_size)  # not the system's key
        record = json.loads(path.read_text())
        changed = record["text"].replace("return", "return  ", 1)
        path.write_text(json.dumps(record | {"text": changed}))
        made = []
        derive = pipeline.program_of
        monkeypatch.setattr(pipeline, "program_of", lambda *args, **more: made.append(1) or derive(*args, **more))
        assert spring().source == first.source
        assert made == [1]


def forge(folder: Path) -> None:
    """Put another library, with a checksum that fits it, in the place of number 1."""
    answer(2)
    place = entry(folder, 1)
    library = building._library(place)
    library.unlink()
    library.write_bytes(building._library(entry(folder, 2)).read_bytes())
    (place / "manifest.json").write_text(json.dumps({"sha256": building._checksum(place)}))


@contextmanager
def umask(mask: int) -> Iterator[None]:
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)


class TestClearing:
    def test_clearing_removes_only_cache_entries_and_counts_bytes(self, folder):
        answer(1)
        spring()
        (folder / "thesis.tex").write_text("not ours")
        size = sc.cache_info().size
        assert sc.clear_cache() == size > 0
        assert [path.name for path in folder.rglob("*") if path.is_file()] == ["thesis.tex"]
        assert answer(1) == 1.0

    def test_remains_of_killed_processes_are_removed_after_an_hour(self, folder):
        for name, age in ((".building-old", 7200), (".building-new", 60), (".removed-old", 7200)):
            (folder / name / "inside").mkdir(parents=True)
            os.utime(folder / name, (time.time() - age,) * 2)
        answer(1)
        assert {path.name for path in folder.glob(".*")} == {".building-new"}

    def test_cache_commands_on_the_command_line(self, folder):
        answer(1)

        def message(*words: str) -> str:
            return output_of("cache", *words)

        assert message("path") == f"{folder}\n"
        assert message() == message("info")
        assert "1 compiled integrators, 0 generated texts, 0 reference solutions" in message("info")
        assert f"of 1 GiB ({cache.SIZE_VARIABLE})" in message("info")
        assert message("clear").startswith("removed ")
        assert entries_in(folder) == set()
