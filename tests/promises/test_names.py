"""One name, one class: whoever reads a name anywhere in the package knows which class is meant."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest

import scvi_codegen

PACKAGE = Path(scvi_codegen.__file__).parent


@pytest.mark.rotated
def test_no_two_classes_have_one_name():
    homes = defaultdict(list)
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                homes[node.name].append(str(path.relative_to(PACKAGE)))
    assert len(homes) > 100
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}
