"""Support headers satisfy ``.clang-format``; generated sources are short."""

import subprocess
from pathlib import Path

import pytest
from style import CLANG_FORMAT, STYLE

from scvi_codegen import SVI, LagrangianSystem, generate_source
from scvi_codegen.codegen.rendering.environment import support_text
from scvi_codegen.common.cache import template_folder

FOLDER = Path(__file__).parents[2] / "generated"
SUPPORT = sorted((template_folder() / "support").glob("*/*.h"))


@pytest.mark.rotated
def test_support_headers_and_generated_files_have_the_project_style(tmp_path):
    """As ``check_style``, in one process for all of them."""
    texts = [support_text(str(path.relative_to(template_folder()))) for path in SUPPORT]
    texts += [path.read_text() for path in (*FOLDER.glob("kepler_svi_4.[ch]"), *FOLDER.glob("support/**/*.h"))]
    for number, text in enumerate(texts):
        (tmp_path / f"{number}.c").write_text(text)
        assert [line for line in text.splitlines() if len(line) > 120] == []
        assert "\n\n\n" not in text
    command = [str(CLANG_FORMAT), f"--style=file:{STYLE}", "--dry-run", "--Werror", *map(str, tmp_path.glob("*.c"))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("name", "most"), [("two_point_pendulum", 250), ("kepler_svi_4", 400)])
def test_generated_method_fits_a_few_pages(name, most):
    assert len((FOLDER / f"{name}.c").read_text().splitlines()) < most


def test_long_titles_are_wrapped():
    words = "a system whose name nobody would want to say twice, "
    system = LagrangianSystem.from_text(name=3 * words, coordinates=["q"], lagrangian="q_dot**2/2 - q**4/4")
    source = generate_source(system, SVI(3), prefix="long_name")[0]
    assert [line for text in source.files.values() for line in text.splitlines() if len(line) > 120] == []
