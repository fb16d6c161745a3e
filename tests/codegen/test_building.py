"""The cache, the compilers and their failures."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from programs import needs, script

from scvi_codegen.codegen.native import building, compilers
from scvi_codegen.codegen.rendering.source import TEXTS, Contents, Source
from scvi_codegen.common.errors import BuildError, ScviCodegenError

FAST = ("-O0",)
HERE = Path(__file__).parent


def source(code: str = "double tiny_answer(void)\n{\n  return 42.0;\n}\n") -> Source:
    """An integrator reduced to what building looks at."""
    declaration = "double tiny_answer(void);\n"
    return Source(prefix="tiny", header=declaration, code=f'#include "tiny.h"\n{code}', declarations=declaration)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    """An empty cache on disk, and nothing remembered in memory."""
    folder = tmp_path / "cache"
    monkeypatch.setenv(building.CACHE_VARIABLE, str(folder))
    forget(monkeypatch)
    return folder


def forget(monkeypatch) -> None:
    """Clear caches, as in a new process."""
    monkeypatch.setattr(building, "_loaded", {})
    compilers.compiler_version.cache_clear()


def answer() -> float:
    return building.load(source(), flags=FAST).lib.tiny_answer()


def entries(cache: Path) -> list[Path]:
    return sorted(cache.iterdir())


def compiler_runs(monkeypatch) -> list[list[str]]:
    """A growing list of the commands run from now on."""
    commands: list[list[str]] = []
    run = building.running

    def recorded(command, folder):
        commands.append(command)
        return run(command, folder)

    monkeypatch.setattr(building, "running", recorded)
    return commands


# The cache.


def test_cache_hit_runs_no_compiler(cache, monkeypatch):
    answer()
    forget(monkeypatch)
    commands = compiler_runs(monkeypatch)
    assert answer() == 42.0
    assert commands == []


def twice() -> float:
    """The answer of a second part, which calls the first."""
    declaration = "double twice_answer(void);\n"
    code = '#include "tiny.h"\n#include "twice.h"\ndouble twice_answer(void)\n{\n  return 2.0 * tiny_answer();\n}\n'
    part = Source(prefix="twice", header=declaration, code=code, declarations=declaration)
    return building.load(replace(source(), beside=part), flags=FAST).lib.twice_answer()


@pytest.mark.parametrize("change", ["none", "corrupt object", "no object", "another command", "no library"])
def test_a_part_that_is_compiled_already_is_linked(change, cache, monkeypatch):
    answer()
    (entry,) = entries(cache)
    manifest = entry / "manifest.json"
    {
        "none": lambda: None,
        "corrupt object": lambda: flip(entry / "tiny.o"),
        "no object": lambda: (entry / "tiny.o").unlink(),
        "another command": lambda: manifest.write_text(manifest.read_text().replace("-fPIC", "-fpic")),
        "no library": lambda: building._library(entry).unlink(),
    }[change]()
    commands = compiler_runs(monkeypatch)
    assert twice() == 84.0
    compiled = [name for command in commands for name in command if name.endswith(".c")]
    assert sorted(compiled) == (["twice.c"] if change == "none" else ["tiny.c", "twice.c"])
    (linked,) = {*entries(cache)} - {entry}
    assert not [*linked.glob("*.o")]


def compiler_reporting(tmp_path: Path, version: str, name: str = "own-cc") -> str:
    """Return a compiler that only reports a version."""
    return script(tmp_path / name, f"#!/bin/sh\necho '{version}'\n")


def other_compiler(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", compiler_reporting(tmp_path, "1.0", "other-cc"))


def compiler_renewed(tmp_path, monkeypatch):
    compiler_reporting(tmp_path, "1.0, mended")
    compilers.compiler_version.cache_clear()


def compiler_of_several_words(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", f"{tmp_path / 'own-cc'} -pipe")


def more_flags(tmp_path, monkeypatch):
    monkeypatch.setenv(building.FLAGS_VARIABLE, "-O1")


def other_cffi(tmp_path, monkeypatch):
    monkeypatch.setattr(compilers._cffi_backend, "__version__", "0.0")


@pytest.mark.parametrize(
    "change", [other_compiler, compiler_renewed, compiler_of_several_words, more_flags, other_cffi]
)
def test_cache_key_contains_everything_the_binary_depends_on(change, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", compiler_reporting(tmp_path, "1.0"))
    monkeypatch.delenv(building.FLAGS_VARIABLE, raising=False)
    before = building.fingerprint(source(), flags=FAST)
    assert building.fingerprint(source(), flags=FAST) == before
    change(tmp_path, monkeypatch)
    assert building.fingerprint(source(), flags=FAST) != before


def test_cache_key_contains_every_part_of_the_source():
    whole = replace(source(), support=(("support/a.h", "/* a */"),), beside=source())
    changed = [
        replace(whole, prefix="other"),
        replace(whole, header=f"{whole.header}/* more */"),
        replace(whole, code=f"{whole.code}/* more */"),
        replace(whole, declarations=f"{whole.declarations}double more(void);"),
        replace(whole, support=(("support/a.h", "/* b */"),)),
        replace(whole, support=(("support/b.h", "/* a */"),)),
        replace(whole, beside=None),
        replace(whole, contents=Contents(divided=True)),
        replace(whole, beside=source("double tiny_answer(void)\n{\n  return 43.0;\n}\n")),
    ]
    assert {field.name for field in fields(Source)} == {"prefix", *TEXTS, "support", "beside", "contents"}
    names = [building.fingerprint(each, flags=FAST) for each in (whole, *changed)]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("where", ["flags", "environment", "compiler", "not at all"])
def test_processor_specific_code_is_not_shared_between_processors(where, tmp_path, monkeypatch):
    native, names = "-march=native", []
    monkeypatch.setenv(building.FLAGS_VARIABLE, native if where == "environment" else "")
    monkeypatch.setenv("CC", f"{compiler_reporting(tmp_path, '1.0')} {native if where == 'compiler' else '-pipe'}")
    for processor in ("one", "another"):
        monkeypatch.setattr(compilers, "_processor", lambda processor=processor: processor)
        names.append(building.fingerprint(source(), flags=(*FAST, native) if where == "flags" else FAST))
    assert (names[0] == names[1]) == (where == "not at all")


@pytest.mark.parametrize(
    "line", ["model name\t: other", "flags\t\t: fpu avx512f", "Features\t: sve", "CPU part\t: 0xd40"]
)
def test_processors_are_distinguished_by_tuning_features(line, monkeypatch):
    def processor(text: str) -> str:
        monkeypatch.setattr(Path, "read_text", lambda self: text)
        return compilers._processor.__wrapped__()

    common = "processor\t: 0\nmodel name\t: some\nflags\t\t: fpu avx\nFeatures\t: asimd\nCPU part\t: 0xd0c\n"
    key = line.split(":")[0]
    other = "".join(f"{line if each.startswith(key) else each}\n" for each in common.splitlines())
    assert processor(common) != processor(other)
    assert processor(common) == processor(common.replace("processor\t: 0", "processor\t: 1"))


def flags_of_each_command(monkeypatch, flags: tuple[str, ...], given: Source) -> list[list[str]]:
    commands = compiler_runs(monkeypatch)
    building.load(given, flags=flags)
    return commands


def test_environment_flags_follow_explicit_flags(monkeypatch):
    """Declarations that depend on the processor, the text, and the library made of it."""
    monkeypatch.setenv(building.FLAGS_VARIABLE, "-O1 -pipe")
    chosen = f"#ifdef __OPTIMIZE__\n{source().declarations}#endif\n"
    commands = flags_of_each_command(monkeypatch, FAST, replace(source(), declarations=chosen))
    kinds = {next((flag for flag in ("-E", "-c", "-shared") if flag in command), ""): command for command in commands}
    assert set(kinds) == {"-E", "-c", "-shared"}
    for kind, command in kinds.items():
        assert {"-O1", "-pipe"} <= set(command)
        assert kind == "-shared" or command.index("-O0") < command.index("-O1")


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.unlink()
    path.write_bytes(data)


def truncate(path: Path) -> None:
    data = path.read_bytes()[:100]
    path.unlink()
    path.write_bytes(data)


DAMAGE = {
    "corrupt": lambda entry: flip(building._library(entry)),
    "truncated": lambda entry: truncate(building._library(entry)),
    "empty": lambda entry: (building._library(entry).unlink(), building._library(entry).touch()),
    "corrupt binding": lambda entry: flip(building._binding(entry)),
    "no binding": lambda entry: building._binding(entry).unlink(),
    "no library": lambda entry: building._library(entry).unlink(),
    "no manifest": lambda entry: (entry / "manifest.json").unlink(),
    "manifest of garbage": lambda entry: (entry / "manifest.json").write_bytes(b"\xff{"),
    "manifest of another shape": lambda entry: (entry / "manifest.json").write_text("[1, 2]"),
    "no folder but a file": lambda entry: (shutil.rmtree(entry), entry.write_text("not a folder")),
    "empty folder": lambda entry: (shutil.rmtree(entry), entry.mkdir()),
}


@pytest.mark.tiers(5)
@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_entry_is_rebuilt(damage, cache, monkeypatch):
    answer()
    (entry,) = entries(cache)
    DAMAGE[damage](entry)
    forget(monkeypatch)
    commands = compiler_runs(monkeypatch)
    assert answer() == 42.0
    assert commands
    assert entries(cache) == [entry]
    assert building._is_intact(entry)


def of_another_processor(data: bytes) -> bytes:
    """The header of an ELF file with another machine in it, RISC-V."""
    return data[:18] + b"\xf3\x00" + data[20:]


def of_another_system(_data: bytes) -> bytes:
    return b"MZ: not for this system"


LOADING = "import test_building; print(test_building.answer())"


@pytest.mark.rotated
@pytest.mark.parametrize("changed", [of_another_processor, of_another_system])
@pytest.mark.skipif(sys.platform == "darwin", reason="the header is that of ELF files")
def test_foreign_library_with_matching_manifest_is_rebuilt(changed, cache):
    answer()
    (entry,) = entries(cache)
    library = building._library(entry)
    data = changed(library.read_bytes())
    library.unlink()
    library.write_bytes(data)
    (entry / "manifest.json").write_text(json.dumps({"sha256": building._checksum(entry)}))
    assert building._is_intact(entry)
    # In another process, because this one has the library open under its name.
    result = subprocess.run(
        [sys.executable, "-c", LOADING],
        cwd=HERE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.stdout, result.stderr) == ("42.0\n", "")
    assert entries(cache) == [entry]
    assert library.read_bytes() != data


def test_unwritable_cache_is_replaced_by_a_temporary_folder(tmp_path, monkeypatch):
    blocking = tmp_path / "file"
    blocking.write_text("no folder can be made below a file, by root neither")
    monkeypatch.setenv(building.CACHE_VARIABLE, str(blocking / "cache"))
    assert answer() == 42.0
    assert blocking.read_text().startswith("no folder")


# Compilers.


def test_cc_is_used_with_its_arguments(cache, monkeypatch):
    monkeypatch.setenv("CC", "cc -DUNUSED='1 2'")
    commands = compiler_runs(monkeypatch)
    assert answer() == 42.0
    assert all(command[1] == "-DUNUSED=1 2" for command in commands)


def without_compilers(monkeypatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(compilers.shutil, "which", lambda _: None)


def test_missing_compiler_names_what_to_install(monkeypatch):
    without_compilers(monkeypatch)
    monkeypatch.setattr(compilers.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(
        BuildError, match=r"apt install gcc.*pip install 'scvi-codegen\[compiler\]' \(ziglang\)"
    ) as error:
        answer()
    assert isinstance(error.value, ScviCodegenError)


def test_the_compiler_from_the_wheel_is_the_last_resort(monkeypatch):
    without_compilers(monkeypatch)
    monkeypatch.setattr(compilers.importlib.util, "find_spec", lambda _: SimpleNamespace())
    assert compilers.find_compiler() == (sys.executable, "-m", "ziglang", "cc")


WITHOUT_VECTOR_FUNCTIONS = """#!/bin/sh
case "$*" in *-lmvec*) echo "no libmvec here" >&2; exit 1 ;; esac
exec cc "$@"
"""


def test_missing_vector_functions_are_replaced_by_scalar_ones(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", script(tmp_path / "plain-cc", WITHOUT_VECTOR_FUNCTIONS))
    commands = compiler_runs(monkeypatch)
    assert building.load(source(), flags=building.TUNED_FLAGS).lib.tiny_answer() == 42.0
    assert "-lmvec" not in commands[-1]


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_gcc_only_passes_are_not_given_to_other_compilers(compiler, monkeypatch):
    """Large systems are split into functions; clang rejects unknown options."""
    needs(compiler)
    monkeypatch.setenv("CC", compiler)
    cut = source("#define DIVIDED_KERNELS\ndouble tiny_answer(void)\n{\n  return 42.0;\n}\n")
    assert building.load(cut, flags=("-O3",)).lib.tiny_answer() == 42.0


@pytest.mark.parametrize(
    ("library", "machine", "flags", "vectors"),
    [
        (("glibc", "2.36"), "x86_64", building.TUNED_FLAGS, True),
        (("glibc", "2.22"), "x86_64", building.TUNED_FLAGS, True),
        (("glibc", "2.17"), "x86_64", building.TUNED_FLAGS, False),
        (("", ""), "x86_64", building.TUNED_FLAGS, False),
        (("glibc", "2.36"), "aarch64", building.TUNED_FLAGS, False),
        (("glibc", "2.36"), "x86_64", ("-O2",), False),
    ],
)
def test_vector_functions_are_those_of_recent_glibc(library, machine, flags, vectors, monkeypatch):
    monkeypatch.setattr(building.platform, "libc_ver", lambda: library)
    monkeypatch.setattr(building.platform, "machine", lambda: machine)
    tried = building._mathematics(flags)
    assert tried[-1] == ([], ["-lm"])
    assert [define for define, _ in tried[:-1]] == [["-DSCVI_LIBMVEC"]] * vectors
