"""Notebooks: saved without outputs, and executed in processes of their own; building the site executes all."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


def loaded(path: Path):
    specification = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


notebooks = loaded(ROOT / "docs" / "_extensions" / "notebooks.py")


def by_name(path: Path) -> str:
    return path.stem


def saved(path: Path, *sources: str) -> Path:
    cells = [{"cell_type": "code", "metadata": {"alt": "a line"}, "source": [source]} for source in sources]
    path.write_text(json.dumps({"cells": [{"cell_type": "markdown", "source": ["# Title"]}, *cells]}))
    return path


@pytest.mark.parametrize("path", NOTEBOOKS, ids=by_name)
def test_notebooks_are_saved_without_outputs(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert notebook["nbformat"] == 4
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    assert [cell["outputs"] for cell in code if cell["outputs"] or cell["execution_count"] is not None] == []
    assert re.match(r"# \S", "".join(notebook["cells"][0]["source"]))
    assert sum("alt" in cell["metadata"] for cell in code) >= 2


@pytest.mark.second
def test_results_are_below_their_cells(tmp_path):
    pytest.importorskip("matplotlib.pyplot").close("all")  # of other tests in this process
    drawn = "import matplotlib.pyplot as plt\nplt.plot([0, 1]);"
    path = saved(tmp_path / "one.ipynb", "x = 2\nprint(x)\nx + 1", drawn, "x;")
    results = notebooks.execute(path)
    assert [[*result] for cell in results for result in cell] == [["text"], ["text"], ["svg"]]
    page = notebooks.to_markdown(path, results)
    assert page.startswith("# Title\n")
    assert page.count("```text\n2\n```") == page.count("```text\n3\n```") == page.count(":alt: a line") == 1


@pytest.mark.rotated
def test_error_of_a_cell_names_it(tmp_path):
    process = notebooks.run_in_process(saved(tmp_path / "one.ipynb", "1", "1/0"))
    _, errors = process.communicate(timeout=60)
    assert process.returncode
    assert "one.ipynb, cell 3 failed: ZeroDivisionError: division by zero" in errors
