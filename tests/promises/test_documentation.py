"""Tests of the documentation: code, links, API reference, site and search.

``test_extension_points.py`` runs the code of ``docs/extending*.md``, ``frameworks/test_page_lines.py`` that of
``docs/frameworks.md``.
"""

import ast
import importlib.util
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from os.path import normpath
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import UNREADABLE, VIEWS, looked_at
from docutils.utils.math.latex2mathml import tex2mathml
from pages import BLOCK, ROOT, Part, agree, run_command, run_page, runnable
from scipy import signal, special

import scvi_codegen
from scvi_codegen.systems.formulas.expressions import CONSTANTS, FUNCTIONS

pytestmark = pytest.mark.long  # a page takes up to a minute

DOCS = ROOT / "docs"
PAGES = {str(path.relative_to(DOCS)): path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md"))}
ELSEWHERE = ("extending.md", "extending_runs.md", "frameworks.md")
RUN = [name for name, page in PAGES.items() if name not in ELSEWHERE and any(runnable(page))]
GENERATED = ("features.md",)
"""Pages of one table that a program writes."""
MINUTES = "scvi-codegen reproduce all"
"""Command that takes minutes of processor time."""
PICTURE = re.compile(r"!\[[^]]+\]\((\w+\.(?:svg|gif))\)")
"""Image that the code of a page draws."""
PEERS = ("astropy", "casadi", "cupy", "fmpy", "heyoka", "rebound")
"""Optional libraries of pages; a page is skipped if one of them is not installed."""
SHOWN = {"python", "text", "console", "sh", "toml", "c", "julia", "diff"}
"""Permitted languages of code blocks."""


def imported(page: str) -> set[str]:
    """Return the modules that the Python code of a page imports."""
    trees = [ast.parse(part.text) for part in runnable(page) if part.kind == "python"]
    nodes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Import)]
    return {alias.name.split(".")[0] for node in nodes for alias in node.names}


@pytest.mark.parametrize("name", PAGES)
def test_code_blocks_have_known_languages_and_links_have_targets(name):
    page = PAGES[name]
    assert len(BLOCK.findall(page)) == len(re.findall(r"^```\w+$", page, re.MULTILINE))
    assert {language for _, language, _ in BLOCK.findall(page)} <= SHOWN
    assert imported(page) is not None  # all Python blocks are parsed
    prose = BLOCK.sub("", page)
    targets = re.findall(r"\]\((?!https?:)([^)#\s]+)(?:#[^)]*)?\)", prose)
    assert [target for target in targets if not ((DOCS / name).parent / target).exists()] == []


def paragraphs(page: str) -> list[str]:
    """Return the paragraphs and list items of a page, without code, tables and headings."""
    prose = re.sub(r"^\s*```.*?^\s*```$|^[|#].*$", "\n", page, flags=re.MULTILINE | re.DOTALL)
    return re.split(r"\n\s*\n|\n(?=\s*(?:[-*] |\d+\. ))", prose)


def test_no_paragraph_of_the_guide_exceeds_80_words_and_no_page_2000():
    guide = {name: paragraphs(page) for name, page in PAGES.items() if "/" not in name}
    assert [(name, text) for name, texts in guide.items() for text in texts if len(text.split()) > 80] == []
    assert {name for name, page in PAGES.items() if len(page.split()) > 2000} <= set(GENERATED)


def test_pages_of_the_gallery_have_index_words_by_which_they_are_found():
    assert [name for name, page in PAGES.items() if name.startswith("gallery/") and "<!-- index: " not in page] == []


def test_the_reference_contains_every_public_name_once():
    pages = "".join(page for name, page in PAGES.items() if name.startswith("reference/"))
    assert sorted(re.findall(r"^\.\. auto\w+:: (\w+)", pages, re.MULTILINE)) == sorted(scvi_codegen.__all__)


def test_functions_of_formulas_are_listed_for_readers_and_for_the_editor_of_the_site():
    names = {*FUNCTIONS, *CONSTANTS}
    script = (DOCS / "_static" / "motions.js").read_text(encoding="utf-8")
    assert {*re.findall(r'FUNCTIONS = new Set\("([^"]*)"', script)[0].split()} == names | {"t", "sum"}
    section = PAGES["systems.md"].partition("## Functions in formulas")[2].partition("```python")[0]
    assert names - {*re.findall(r"`(\w+)", section)} == {"acos", "acosh", "asinh", "atan", "atanh"}  # "their inverses"


def test_every_page_is_in_a_table_of_contents():
    listed, shown = {"index.md"}, 0
    for name, page in PAGES.items():
        for entries in re.findall(r"^```\{toctree\}\n(?::.*\n)*\n?((?:.+\n)*?)```$", page, re.MULTILINE):
            listed |= {normpath(Path(name).parent / f"{entry}.md") for entry in entries.split()}
            shown += len(entries.split()) * (name == "index.md")
    assert listed == set(PAGES)
    assert shown <= 40, "entries of the sidebar"


def test_equal_numbers_are_accepted():
    agree("period 6.325, kept to 3e-14, after 12 steps", "period 6.326, kept to 2e-15, after 12 steps\n")


@pytest.mark.parametrize(("message", "printed"), [("1.234", "1.237"), ("12", "13"), ("3e-14", "4e-13"), ("x 1", "y 1")])
def test_different_numbers_are_detected(message, printed):
    with pytest.raises(AssertionError, match=r"is said|said\n"):
        agree(message, printed)


CODE = re.compile(r"^```.*?^```$|`[^`\n]*`", re.MULTILINE | re.DOTALL)
DISPLAYED = re.compile(r"\$\$.*?\$\$", re.DOTALL)


@pytest.mark.parametrize("name", PAGES)
def test_formulas_translate_to_mathml(name):
    prose = CODE.sub("", PAGES[name])
    formulas = [formula.strip("$") for formula in DISPLAYED.findall(prose)]
    for formula in formulas + re.findall(r"\$([^$]*)\$", DISPLAYED.sub("", prose)):
        assert "<math" in tex2mathml(formula), formula


_TASKS = tomllib.loads((ROOT / "tests/corpus/tasks.toml").read_text(encoding="utf-8"))
TASKS = [task | {"page": page} for page, tasks in _TASKS.items() for task in tasks]
"""Problems from public threads, each with the page whose code solves it."""


@pytest.mark.usefixtures("as_users_compile")
@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.rotated(k)) for k, name in enumerate(RUN)])
def test_a_page_runs_from_top_to_bottom(name, tmp_path, monkeypatch):
    """Its output and pictures are those shown, and it solves the problems of public threads that name it."""
    missing = [peer for peer in PEERS if peer in imported(PAGES[name]) and importlib.util.find_spec(peer) is None]
    if any(words in PAGES[name] for words in ("--platform ", "scvi-codegen page ")):  # need the compiler from a wheel
        missing += [wheel for wheel in ["ziglang"] if importlib.util.find_spec(wheel) is None]
    if missing:
        pytest.skip(f"{missing[0]} is not installed")
    parts = [part for part in runnable(PAGES[name]) if not part.text.startswith(MINUTES)]
    if "{write-your-own}" in PAGES[name]:  # the form of the page writes the example
        form = (ROOT / "docs" / "_extensions" / "motions.py").read_text(encoding="utf-8")
        parts.insert(0, Part("file", re.findall(r'"Model file">(.*?)</pre>', form, re.DOTALL)[0], "model.toml"))
    names = run_page(name, parts, tmp_path, monkeypatch) | {"signal": signal, "special": special}
    assert [picture for picture in PICTURE.findall(PAGES[name]) if not (tmp_path / picture).is_file()] == []
    for task in TASKS:
        if f"{task['page']}.md" == name:
            value, expected = (eval(task[key], names) for key in ("value", "expected"))
            np.testing.assert_allclose(value, expected, 0, task.get("within", 1e-12), err_msg=task["query"])


@pytest.mark.full
def test_the_reproduction_of_the_paper_runs(here):
    [command] = [part.text for part in runnable(PAGES["paper.md"]) if part.text.startswith(MINUTES)]
    run_command(command)
    assert (here / "paper.html").is_file()


QUERIES: dict[str, set[str]] = {}
"""What users search for, and the pages of which one must be found."""
for _page, _queries in tomllib.loads((ROOT / "tests/corpus/queries.toml").read_text(encoding="utf-8")).items():
    for _query in _queries:
        QUERIES.setdefault(_query, set()).add(_page)
for _task in TASKS:
    QUERIES.setdefault(_task["query"], set()).add(_task["page"])
SEARCH = """queries => queries.map(query =>
    Search._performSearch(...Search._parseQuery(query)).reverse().slice(0, 9).map(result => result[0]))"""
"""First results of each query, pages in the order in which the search shows them."""


@pytest.fixture(scope="module")
def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the site, built without warnings and without network access."""
    [command] = re.findall(
        r"^python (-m sphinx .*) site$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    if request.param == "existing":
        folder = ROOT / "site"
        newest = max(path.stat().st_mtime for path in DOCS.rglob("*") if path.suffix in (".md", ".py", ".js"))
        if not (folder / "searchindex.js").is_file() or (folder / "searchindex.js").stat().st_mtime < newest:
            pytest.skip(f"there is no site of these pages: python {command} site")
        return folder
    if any(importlib.util.find_spec(name) is None for name in ("sphinx", "myst_parser", "furo")):
        pytest.skip("sphinx, myst-parser or furo is not installed: pip install 'scvi-codegen[docs]'")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, *command.split(), str(folder), "-q"]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return folder


@pytest.mark.parametrize("site", ["existing", pytest.param("built", marks=pytest.mark.full)], indirect=True)
def test_the_search_finds_the_page_first_in_95_percent_and_among_three_always(site, browser):
    with looked_at(browser, "desk", "light") as view:
        view.goto(f"{(site / 'search.html').as_uri()}?q=start")
        view.wait_for_function("Search.hasIndex()")
        shown = view.evaluate(SEARCH, [*QUERIES])
        found = {query: list(dict.fromkeys(pages))[:3] for query, pages in zip(QUERIES, shown, strict=True)}
    first = {query: pages[0] for query, pages in found.items() if pages}
    assert {task["query"]: task["page"] for task in TASKS}.items() <= first.items()
    assert {query: pages for query, pages in found.items() if not QUERIES[query] & {*pages}} == {}
    assert sum(page in QUERIES[query] for query, page in first.items()) >= 0.95 * len(QUERIES) > 500


@pytest.mark.full
@pytest.mark.parametrize("site", ["built"], indirect=True)
class TestTheSite:
    @pytest.fixture(params=VIEWS, ids="-".join)
    def view(self, request: pytest.FixtureRequest, browser: Any) -> Iterator[Any]:
        with looked_at(browser, *request.param) as view:
            yield view

    def test_every_public_name_has_an_anchor(self, site):
        text = "".join(path.read_text(encoding="utf-8") for path in (site / "reference").glob("*.html"))
        assert [name for name in scvi_codegen.__all__ if f'id="scvi_codegen.{name}"' not in text] == []

    def test_formulas_are_mathml_and_no_page_loads_remote_files(self, site):
        pages = {path.name: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
        assert pages["galerkin.html"].count("<math") > 10
        loaded = r'<(?:script|img|link rel="stylesheet")[^>]+(?:src|href)="https?:'
        assert [name for name, page in pages.items() if re.search(loaded, page)] == []

    def test_thumbnails_show_one_panel_of_each_picture(self, site):
        page = (site / "gallery" / "index.html").read_text(encoding="utf-8")
        views = re.findall(r'src="\.\./_images/(panel_\w+\.svg)"', page)
        assert len(views) > 50
        assert all((site / "_images" / name).read_text(encoding="utf-8").count(" viewBox=") == 1 for name in views)

    def test_no_formula_is_incomplete(self, site):
        """No dollar sign remains in the text outside of code."""
        code = re.compile(r"<(pre|code|script|style)\b.*?</\1>", re.DOTALL)
        pages = {path.relative_to(site).as_posix(): path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
        assert [name for name, page in pages.items() if "$" in re.sub(r"<[^>]*>", "", code.sub("", page))] == []

    def test_pages_fit_the_screen_and_have_sufficient_contrast(self, site, view):
        wide, pale = [], []
        for path in sorted(site.rglob("*.html")):
            view.goto(path.as_uri())
            if view.evaluate("document.documentElement.scrollWidth") > view.width:
                wide.append(path.name)
            pale += [(path.name, *found) for found in view.evaluate(UNREADABLE)]
        assert wide == []
        assert pale == []
        assert {url.split(":")[0] for url in view.asked} <= {"file", "data"}
        assert view.console == []

    def test_keyboard_focus_is_visible(self, site, view):
        """Links in a drawer of a narrow screen open the drawer."""
        view.goto((site / "solar_system.html").as_uri())
        for _ in range(8):
            view.keyboard.press("Tab")
        view.wait_for_function(
            """() => {
                const box = document.activeElement.getBoundingClientRect();
                return box.width > 0 && box.left >= 0 && box.right <= innerWidth;
            }""",
            timeout=5000,
        )
