"""Command ``scvi-codegen reproduce``: run experiments of the paper, write their files and print the verdicts."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import click

from scvi_codegen.api.commands import check_writable, progress_bar, reporting, tell
from scvi_codegen.api.text import counted, write_text
from scvi_codegen.extras.paper.experiment import Experiment, Result, report_html, tally, write_result
from scvi_codegen.extras.paper.runner import CATALOGUE, Failure, Watch, catalogue, run_experiments, with_needs
from scvi_codegen.extras.pictures.canvas import check_plot_path

EVERYTHING = "all"
Report: TypeAlias = Callable[[str], None]
SHOWN_NAMES = 40
"""Largest number of characters of the names next to the progress bar."""


@click.command()
@click.argument("names", nargs=-1, metavar="[WHAT ...]")
@click.option(
    "-o", "--output", default="reproduced", show_default=True, type=click.Path(), metavar="DIR", help="Output folder."
)
@click.option("--html", type=click.Path(), metavar="FILE", help="Write all results as one self-contained page.")
@click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Parallel processes [number of processors].")
@click.option("--list", "listing", is_flag=True, help="List the experiments without running them.")
@reporting
def reproduce(names: tuple[str, ...], output: str, html: str | None, jobs: int | None, listing: bool) -> None:
    """Reproduce figures, tables and claims of the paper, with verdicts from measurements (needs matplotlib).

    WHAT is 'all' or names of experiments ('--list' prints them); their dependencies are run, too. Each result is
    written when it is complete: NAME.txt with the verdicts, NAME.svg and NAME.png, NAME.csv with all numbers.

    Exit status: 0 if all experiments ran, whatever their verdicts; 1 if an experiment failed to run; 130 after Ctrl-C
    (files written before remain).

    \b
    Examples:
      scvi-codegen reproduce --list
      scvi-codegen reproduce all --html paper.html
      scvi-codegen reproduce figure-4 figure-5 -o figures --jobs 1
    """
    if listing:
        titles = experiments_titles(names or (EVERYTHING,))
        tell(experiments_table(titles), experiments=titles)
        return
    if not names:
        raise click.UsageError("give 'all' or names of experiments (see 'scvi-codegen reproduce --list')")
    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise click.BadParameter(f"'{folder}' is not a folder", param_hint="'-o'")
    if html is not None:
        check_writable(Path(html), "'--html'")
    done = reproduce_experiments(names, folder, Path(html) if html is not None else None, jobs, report=tell)
    tell(f"\n{done.summary()}" if done.files else "", **done.numbers())
    if done.interrupted:
        raise KeyboardInterrupt("interrupted; files written before remain")
    if done.failures:
        raise click.ClickException(done.failed())


@dataclass(kw_only=True)
class Reproduction:
    """Result of a run of experiments.

    Attributes:
        results: results in the order of completion.
        failures: experiments that raised an error.
        files: files written; the page of all results last.
        interrupted: True if Ctrl-C ended the run.
    """

    results: list[Result] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    interrupted: bool = False

    def summary(self) -> str:
        """Return the number of results by verdict, and the files written."""
        counts = [
            counted(len(self.results), "result"),
            *(text for _, text in tally([result.verdict for result in self.results])),
        ]
        folders = sorted({str(path.parent) for path in self.files})
        return f"{', '.join(counts)}\nwrote {counted(len(self.files), 'file')} to {' and '.join(folders)}"

    def numbers(self) -> dict[str, Any]:
        """Return the document of ``--json``."""
        return {
            "results": [
                {"name": result.name, "title": result.title, "verdict": result.verdict.value} for result in self.results
            ],
            "failures": {failure.name: failure.message for failure in self.failures},
            "written": self.files,
            "interrupted": self.interrupted,
        }

    def failed(self) -> str:
        """Return a line for each failure."""
        lines = [f"  {failure.name}: {failure.message}" for failure in self.failures]
        return "\n".join([f"{counted(len(lines), 'experiment')} failed to run", *lines])


def experiments_titles(names: Sequence[str] = (EVERYTHING,), *, module: str = CATALOGUE) -> dict[str, str]:
    """Return the titles of the experiments to run, by name."""
    experiments = catalogue(module)
    return {name: experiments[name].title for name in _in_order(names, experiments)}


def experiments_table(titles: Mapping[str, str]) -> str:
    """Return a line for each experiment."""
    width = max(map(len, titles), default=0)
    return "\n".join(f"{name:{width}}  {title}" for name, title in titles.items())


def reproduce_experiments(
    names: Sequence[str],
    folder: Path,
    html: Path | None,
    jobs: int | None,
    *,
    module: str = CATALOGUE,
    report: Report = click.echo,
) -> Reproduction:
    """Run experiments and those they depend on; write the files of each result, and the page at the end.

    Each result is a line passed to ``report``. Ctrl-C ends the run; files written before remain.
    """
    experiments = catalogue(module)
    ordered = _in_order(names, experiments)
    check_plot_path(folder / "picture.svg")
    folder.mkdir(parents=True, exist_ok=True)
    done, width = Reproduction(), max(map(len, ordered), default=0)
    try:
        with (
            _progress(len(ordered), report) as (show, report_above),
            closing(run_experiments(ordered, jobs, module=module, watch=show)) as outcomes,
        ):
            for outcome in outcomes:
                report_above(f"{outcome.name:{width}}  {_add(done, outcome, folder)}")
        if html is not None:
            write_text(html, report_html(sorted(done.results, key=lambda r: list(experiments).index(r.name))))
            done.files.append(html)
    except KeyboardInterrupt:
        done.interrupted = True
    return done


def _in_order(names: Sequence[str], experiments: Mapping[str, Experiment]) -> list[str]:
    return with_needs(list(experiments) if EVERYTHING in names else names, experiments)


def _add(done: Reproduction, outcome: Result | Failure, folder: Path) -> str:
    if isinstance(outcome, Failure):
        done.failures.append(outcome)
        return f"failed: {outcome.message}"
    done.files += write_result(outcome, folder)
    done.results.append(outcome)
    return f"{outcome.verdict.value:13}  {outcome.title}"


@contextmanager
def _progress(length: int, report: Report) -> Iterator[tuple[Watch, Report]]:
    """Show a bar on stderr if that is a terminal; yield functions that show names, and print a line above it."""
    done = 0

    def show(names: Sequence[str]) -> None:
        text = ", ".join(names)
        bar(done, text if len(text) <= SHOWN_NAMES else text[: SHOWN_NAMES - 2] + "..")

    def report_above(line: str) -> None:
        nonlocal done
        if is_shown:
            click.echo("\r\x1b[K", nl=False, err=True)
        report(line)
        done += 1
        bar(done)

    with progress_bar(length, "reproducing") as bar:
        is_shown = bar(0)
        yield show, report_above
