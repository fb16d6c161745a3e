"""The paper's experiments are run, written and put on one page; the page is looked at in a browser."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import toy_experiments
from commands import error_of, json_of, output_of
from html_page import Page
from toy_experiments import EXPERIMENTS, GOOD

from scvi_codegen.extras.derivation.writing import cell, prose
from scvi_codegen.extras.paper.command import experiments_table, experiments_titles
from scvi_codegen.extras.paper.experiment import Result, draw, report_html
from scvi_codegen.extras.paper.runner import Failure, run_experiments, with_needs

if TYPE_CHECKING:
    pass

TOYS = toy_experiments.__name__


@pytest.fixture(scope="module")
def results() -> dict[str, Result]:
    return {result.name: result for result in run_experiments(GOOD, 1, module=TOYS) if isinstance(result, Result)}


@pytest.fixture(scope="module")
def page(results: dict[str, Result]) -> str:
    return report_html(list(results.values()))


class TestRunner:
    def test_dependencies_run_first_and_once(self):
        assert with_needs(["table-8", "figure-4", "last"], EXPERIMENTS) == [
            "figure-4",
            "table-8",
            "broken",
            "after-broken",
            "last",
        ]

    def test_failures_stop_only_dependent_experiments(self):
        outcomes = list(run_experiments(["last", "table-8"], 1, module=TOYS))
        assert [outcome.name for outcome in outcomes if isinstance(outcome, Result)] == ["figure-4", "table-8"]
        failures = {outcome.name: outcome for outcome in outcomes if isinstance(outcome, Failure)}
        assert failures["broken"].message == "ValueError: no such luck"
        assert failures["after-broken"].message == "its dependency 'broken' failed"
        assert failures["last"].message == "its dependency 'after-broken' failed"

    @pytest.mark.rotated
    def test_parallel_processes_give_equal_results_and_survive_a_crash(self):
        seen: list[tuple[str, ...]] = []
        names = ["crash", "table-8", "unportable", "table-9", "broken"]
        outcomes = list(run_experiments(names, 2, module=TOYS, watch=lambda running: seen.append(tuple(running))))
        assert {outcome.name for outcome in outcomes if isinstance(outcome, Result)} == {
            "figure-4",
            "table-8",
            "table-9",
        }
        failures = {outcome.name: outcome.message for outcome in outcomes if isinstance(outcome, Failure)}
        assert failures["crash"] == "its process ended with exit status 7"
        assert "lambda" in failures["unportable"]
        assert failures["broken"] == "ValueError: no such luck"
        assert max(map(len, seen)) == 2
        assert seen[-1] == ()
        order = [outcome.name for outcome in outcomes]
        assert order.index("figure-4") < order.index("table-8")


M, T, N = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}", "\N{NO-BREAK SPACE}"


@pytest.mark.parametrize(
    ("text", "typeset"),
    [
        ("1.5e-09 and 1e-14, 2e+05", f"1.5{N}{T}{N}10<sup>{M}9</sup> and 10<sup>{M}14</sup>, 2{N}{T}{N}10<sup>5</sup>"),
        ("2.1e+00", "2.1"),
        ("h = -0.1, degree 2-5, e=.5", f"h{N}={N}{M}0.1, degree 2-5, e=.5"),
        ("h^2, Q^{s-1}, x^(k+1), dq ^ dp", f"h<sup>2</sup>, Q<sup>s{M}1</sup>, x<sup>k+1</sup>, dq ^ dp"),
        ("L_d, a_34, q_(k+1), lambda_1", "L<sub>d</sub>, a<sub>34</sub>, q<sub>k+1</sub>, λ<sub>1</sub>"),
        ("q_dot, add_boundary, x_max", "q_dot, add_boundary, x_max"),
        ("1 - e <= 2 >= x -> y, 0, .., +-1", f"1 {M} e ≤ 2 ≥ x → y, 0, …, ±1"),
        ("<b> & SC-like, p0e-3x", "&lt;b&gt; &amp; SC-like, p0e-3x"),
        ("q'' = -q is -J_0, not -o", f"q&#39;&#39; = {M}q is {M}J<sub>0</sub>, not -o"),
    ],
)
def test_prose_is_typeset(text, typeset):
    assert str(prose(text)) == typeset


def test_cells_are_formatted():
    given = [(None, None), (1520, None), (0.25, None), (1.24e-11, ".2g"), (float("inf"), None), ("a_1", ".3g")]
    assert [str(cell(*pair)) for pair in given] == [
        "\N{EN DASH}",
        "1520",
        "0.25",
        f"1.2{N}{T}{N}10<sup>{M}11</sup>",
        "inf",
        "a<sub>1</sub>",
    ]


class TestPage:
    @pytest.mark.rotated
    def test_page_is_complete_and_well_formed(self, page, results):
        parsed = Page(page)
        assert parsed.all("html") == [{"lang": "en"}]
        assert len(parsed.all("h1")) == 1
        assert len(parsed.all("section")) == len(parsed.all("h2")) == len(GOOD)
        (picture,) = parsed.all("img")
        assert picture["alt"] == "Figure 4. Energy errors of <SVI> & SC"
        document = base64.b64decode(picture["src"].removeprefix("data:image/svg+xml;base64,"))
        assert document == draw(results["figure-4"].picture, "svg")
        assert len(parsed.all("caption")) == len(parsed.all("table")) == 4

    @pytest.mark.rotated
    def test_page_is_self_contained(self, page):
        parsed = Page(page)
        assert parsed.all("script") == []
        for _, attributes in parsed.elements:
            for name in ("src", "href", "srcset", "data", "action", "poster"):
                assert (attributes.get(name) or "#").startswith(("#", "data:"))
        assert "http:" not in page
        assert "https:" not in page
        assert "@import" not in page


@pytest.fixture
def toys(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scvi_codegen.extras.paper.catalogue.EXPERIMENTS", EXPERIMENTS)


COMMAND = ("reproduce", "--jobs", "1")


@pytest.mark.usefixtures("toys")
class TestCommand:
    @pytest.mark.rotated
    def test_command_writes_files_and_the_page(self):
        text = output_of(*COMMAND, "section-3.1", "table-8", "-o", "made/here", "--html", "all.html")
        assert sorted(path.name for path in Path("made/here").iterdir()) == [
            "figure-4-series.csv",
            "figure-4.csv",
            "figure-4.png",
            "figure-4.svg",
            "figure-4.txt",
            "section-3.1.csv",
            "section-3.1.txt",
            "table-8.csv",
            "table-8.txt",
        ]
        assert "3 results, 2 hold in part, 1 shown\nwrote 10 files to . and made/here" in text
        assert "figure-4     holds in part  Energy errors of <SVI> & SC\n" in text
        text = Path("all.html").read_text(encoding="utf-8")
        assert text.index('<section id="section-3.1"') < text.index('<section id="figure-4"')

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["figur-4"], "did you mean 'figure-4'?"),
            ([], "give 'all' or names of experiments"),
            (["table-9", "-o", "file"], "'file' is not a folder"),
            (["table-9", "--html", "no/where.html"], "there is no folder 'no'"),
            (["table-9", "--jobs", "0"], "Invalid value for '--jobs'"),
        ],
    )
    def test_invalid_arguments_are_reported_before_the_run(self, words, message):
        Path("file").write_text("")
        assert message in error_of(*COMMAND, *words)
        assert not Path("reproduced").exists()

    def test_command_lists_experiments(self):
        listed = output_of(*COMMAND, "--list")
        assert "figure-4      Energy errors\n" in listed
        assert output_of(*COMMAND, "--list", "table-8") == "figure-4  Energy errors\ntable-8   Iterations\n"
        assert experiments_table(experiments_titles(module=TOYS)) == listed.rstrip("\n")

    @pytest.mark.rotated
    def test_json_and_quiet_output(self):
        assert json_of(*COMMAND, "--list")["experiments"]["figure-4"] == "Energy errors"
        found = json_of(*COMMAND, "broken", "table-8", status=1)
        assert {each["name"]: each["verdict"] for each in found["results"]}["figure-4"] == "holds in part"
        assert list(found["failures"]) == ["broken"]
        assert "reproduced/table-8.txt" in found["written"]
        assert output_of(*COMMAND, "table-8", "--quiet") == output_of(*COMMAND, "--list", "--quiet") == ""
