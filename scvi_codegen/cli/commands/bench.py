"""Command ``scvi-codegen bench``: timings of this package and of other integrators at equal error."""

from __future__ import annotations

from pathlib import Path

import click

from scvi_codegen.benchmark import PEERS, Plan, benchmark
from scvi_codegen.cli.frame import INTERRUPTED, CommandFailure, check_writable, note, reporting, tell

__all__ = ["bench"]


@click.command()
@click.argument("sections", nargs=-1, metavar="[SECTION ...]")
@click.option("--peers", metavar="NAME,..", help="Only these of heyoka, rebound, cyrk, jitcode, scipy; none: ''.")
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="All measurements as JSON, into a file.")
@click.option("--plot", type=click.Path(), metavar="FILE", help="Work-precision plot, .png or .svg.")
@click.option("--repeats", type=int, default=5, show_default=True, help="Timed rounds.")
@click.option("--resume", is_flag=True, help="Keep what FILE of -o has, and add to it.")
@click.option("--quick", is_flag=True, help="Short spans and few settings, to see that everything works.")
@reporting
def bench(
    sections: tuple[str, ...],
    peers: str | None,
    output: str | None,
    plot: str | None,
    repeats: int,
    resume: bool,
    quick: bool,
) -> None:
    """Time this project and the installed peers in turn, and compare them at equal error.

    SECTION is a problem (planar-pendulum, duffing, kepler:0.2, kepler:0.5, henon-heiles, outer-solar-system,
    double-pendulum, relativistic-particle, fput-chain:8, :64, :256), one with friction and a drive (forced:duffing,
    :cart-pole, :double-pendulum, :chain:5), rods as constraints beside their angles (constrained:pendulum,
    :double-pendulum, :chain:5, :chain:20), 64 trajectories of one at once
    (ensemble:planar-pendulum, ensemble:kepler:0.2, ensemble:outer-solar-system), adaptive (steps that choose their
    length, beside fixed steps, transformed time, heyoka and IAS15: adaptive:kepler:0.9, ..), drift (the energy over ten
    million steps), tables (6 and 7 of the paper), compositions (explicit ones), hand-written (C), start-up, compile
    (larger systems, from text to first step), mechanisms (of SymPy, beside lambdify and PyDy), held (bodies held by
    rods, beside MuJoCo), samples (of controllers), sums (over indices: lattices, fields, many bodies), growth (with
    their number of coordinates), threads (that share their steps), energies (theirs, over a hundred thousand steps),
    cluster (a thousand bodies beside REBOUND) or builds (other compilers and processors); by default all; kepler is
    both of its kind.
    Install the peers with 'scvi-codegen[bench]'. Sections are printed, and written to the JSON, as they are measured;
    Ctrl-C ends it with these, and with --resume it goes on from there.

    \b
    Examples:
      scvi-codegen bench kepler:0.5 --peers heyoka --plot kepler.svg
      scvi-codegen bench drift hand-written -o measured.json
    """
    if resume and output is None:
        raise click.UsageError("--resume goes on from the FILE of -o: give it")
    for path, hint in ((output, "'-o'"), (plot, "'--plot'")):
        if path is not None:
            check_writable(Path(path), hint)
    names = tuple(PEERS) if peers is None else tuple(filter(None, peers.split(",")))
    plan = Plan(peers=names, repeats=repeats, quick=quick)
    report = benchmark(sections, plan, json_path=output, plot_path=plot, resume=resume, say=note, show=tell)
    tell(**report.data())
    if report.interrupted:
        raise CommandFailure(f"interrupted in '{report.interrupted}'; what was measured before is above", INTERRUPTED)
