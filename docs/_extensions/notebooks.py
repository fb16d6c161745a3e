"""Notebooks as pages: they are executed when the site is built, and the results are shown below their cells.

A page that consists of ``{notebook} PATH`` is replaced by the notebook of that path. Notebooks are saved without
outputs, so results on the site are always those of the current code. Each runs in a process of its own, with the
libraries of this one: cells share a namespace, the value of a last expression is shown unless a semicolon follows, and
figures become SVG.
"""

import base64
import html
import io
import json
import os
import re
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

__all__ = ["execute", "run_in_process", "setup", "to_markdown"]

DIRECTIVE = re.compile(r"```\{notebook\} (\S+)\n```\s*")
STYLE = {"svg.fonttype": "path", "svg.hashsalt": "scvi", "figure.facecolor": "white"}


def execute(path: Path) -> list[list[dict[str, str]]]:
    """Run the code cells in order and return the results of each, by their kinds: ``text``, ``html``, ``svg``.

    Raises:
        RuntimeError: If a cell fails. The message names notebook and cell.
    """
    import ast

    import matplotlib as mpl

    mpl.use("agg")
    mpl.rcParams.update(STYLE)
    import matplotlib.pyplot as plt

    namespace: dict[str, Any] = {"__name__": "__main__"}
    found = []
    for number, cell in enumerate(cells(path)):
        results: list[dict[str, str]] = []
        if cell["cell_type"] == "code":
            source, printed, value = "".join(cell["source"]), io.StringIO(), None
            name = f"{path.name}, cell {number + 1}"
            try:
                tree = ast.parse(source, name)
                last = None
                if tree.body and isinstance(tree.body[-1], ast.Expr):
                    last = ast.Expression(tree.body.pop().value)
                with redirect_stdout(printed):
                    exec(compile(tree, name, "exec"), namespace)
                    if last is not None:
                        value = eval(compile(last, name, "eval"), namespace)
            except Exception as error:
                raise RuntimeError(
                    f"{name} failed: {type(error).__name__}: {error}"
                ) from error
            if printed.getvalue():
                results.append({"text": printed.getvalue()})
            if value is not None and not source.rstrip().endswith(";"):
                shown = getattr(value, "_repr_html_", lambda: None)()
                results.append({"html": shown} if shown else {"text": f"{value!r}\n"})
            for figure in map(plt.figure, plt.get_fignums()):
                drawn = io.StringIO()
                figure.savefig(drawn, format="svg", metadata={"Date": None})
                results.append({"svg": drawn.getvalue()})
            plt.close("all")
        found.append(results)
    return found


def cells(path: Path) -> list[dict[str, Any]]:
    """Return the cells of a notebook."""
    return list(json.loads(path.read_text(encoding="utf-8"))["cells"])


def run_in_process(path: Path) -> "subprocess.Popen[str]":
    """Begin to execute a notebook in a new process, which prints the results as JSON."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "error", __file__, str(path)]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, stdout=pipe, stderr=pipe, text=True, encoding="utf-8", env=environment
    )


def to_markdown(path: Path, results: list[list[dict[str, str]]]) -> str:
    """Return the page of an executed notebook: text, code, results and a link to the file."""
    parts = []
    for cell, shown in zip(cells(path), results, strict=True):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(
                source.replace("](../../docs/", "](../").replace(".ipynb)", ".md)")
            )
            continue
        parts.append(f"```python\n{source}\n```")
        for result in shown:
            ((kind, text),) = result.items()
            if kind == "text":
                parts.append(f"```text\n{text.rstrip()}\n```")
            elif kind == "html":
                parts.append(f"````{{raw}} html\n{text}\n````")
            else:
                data = base64.b64encode(text.encode()).decode()
                alt = html.escape(cell["metadata"]["alt"])
                parts.append(
                    f"```{{image}} data:image/svg+xml;base64,{data}\n:alt: {alt}\n```"
                )
    heading, *rest = parts
    parts = [
        heading,
        f"{{download}}`Notebook <../../examples/notebooks/{path.name}>` of this page.",
        *rest,
    ]
    return "\n\n".join(parts) + "\n"


def setup(app: Any) -> dict[str, Any]:
    """Run the notebooks of outdated pages before any page is read, and put the results in their place."""
    pages: dict[str, tuple[Path, str]] = {}

    def run(app: Any, environment: Any, names: list[str]) -> None:
        processes = {}
        for name in names:
            page = Path(environment.doc2path(name))
            match = DIRECTIVE.fullmatch(page.read_text(encoding="utf-8"))
            if match:
                path = (page.parent / match[1]).resolve()
                processes[name] = path, run_in_process(path)
        for name, (path, process) in processes.items():
            output, errors = process.communicate()
            if process.returncode:
                raise RuntimeError(f"{path.name} failed:\n{errors[-3000:]}")
            pages[name] = path, output

    def replace(app: Any, name: str, source: list[str]) -> None:
        if name in pages:
            path, output = pages[name]
            app.env.note_dependency(str(path))
            source[0] = to_markdown(path, json.loads(output))

    app.connect("env-before-read-docs", run)
    app.connect("source-read", replace)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


if __name__ == "__main__":
    print(json.dumps(execute(Path(sys.argv[1]))))
