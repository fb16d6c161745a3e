"""Public names resolve and are documented; docstrings describe parameters that exist."""

import ast
import re
from pathlib import Path

import pytest

import scvi_codegen

PACKAGE = Path(scvi_codegen.__file__).parent


def test_public_names_resolve_and_have_docstrings():
    public = {name: getattr(scvi_codegen, name) for name in scvi_codegen.__all__}
    assert [name for name, value in public.items() if callable(value) and not value.__doc__] == []


@pytest.mark.second
def test_docstrings_describe_parameters_of_their_function():
    unknown = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "Args:" in text else ():
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                parameters = {argument.arg for argument in ast.walk(node.args) if isinstance(argument, ast.arg)}
                after = re.split(r"^Args:\n", f"{ast.get_docstring(node) or ''}\nArgs:\n", flags=re.MULTILINE)[1]
                section = re.split(r"^\S", after, flags=re.MULTILINE)[0]
                entries = re.findall(r"^    ((?:\*{0,2}\w+, )*\*{0,2}\w+):", section, re.MULTILINE)
                described = {name for names in entries for name in names.replace("*", "").split(", ")}
                unknown += [f"{path.name}:{node.lineno} {name}" for name in described - parameters]
    assert unknown == []
