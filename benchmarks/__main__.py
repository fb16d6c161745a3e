"""Command ``python -m benchmarks``: timings of scvi_codegen and of other integrators at equal error."""

import sys
from pathlib import Path

import click

from benchmarks import PEERS, Plan, benchmark
from benchmarks.guard import guard
from scvi_codegen.interfaces.cli.command_group import (
    INTERRUPTED,
    CommandFailure,
    check_writable,
    errors_as_messages,
    note,
    reporting,
    tell,
)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("sections", nargs=-1, metavar="[SECTION ...]")
@click.option("--peers", metavar="NAME,..", help="Peers: some of heyoka, mujoco, rebound, cyrk, ..; '' for none.")
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="Write all measurements as JSON, or as .csv.")
@click.option("--plot", type=click.Path(), metavar="FILE", help="Work-precision plot, .png or .svg.")
@click.option("--repeats", type=int, default=5, show_default=True, help="Timed rounds.")
@click.option("--quick", is_flag=True, help="Smoke test: short spans and few settings.")
@reporting
@errors_as_messages()
def main(
    sections: tuple[str, ...], peers: str | None, output: str | None, plot: str | None, repeats: int, quick: bool
) -> None:
    """Compare scvi_codegen with other installed integrators at equal error.

    SECTION is one of the following; the default is all, and a prefix (kepler) selects all sections that begin with it.

    \b
      planar-pendulum, duffing, kepler:0.2, kepler:0.5, henon-heiles, outer-solar-system, double-pendulum,
      relativistic-particle, fput-chain:8, fput-chain:64, fput-chain:256    single trajectories
      forced:double-pendulum                                                friction and driving forces
      ensemble:planar-pendulum, :kepler:0.2, :outer-solar-system            64 trajectories at once
      published:henon-heiles, :outer-solar-system, :black-hole              problems of IRKGL16's authors
      sciml:pleiades, .., heyoka:three-bodies, ..                           problems of other projects' benchmarks
      rods:1, :2, :5                                                        constraints, and the angles of the rods
      precision:kepler:0.5, ..  all degrees and peers from 1e-3 to round-off; of all cases of this list until :dumbbell
      adaptive:kepler:0.9, ..   adaptive and fixed step size; heyoka and IAS15
      rotations:free-top, :heavy-top, :dumbbell, :bodies                    rigid bodies; heyoka, MuJoCo
      robots:chain:2, :5, :10, :30, :quadruped, :four-bar                   multibody systems; MuJoCo, Pinocchio, Exudyn
      robots:tree:18:1, :tree:18:10, :tree:35:1, .., :tree:49:10            degrees of freedom and span, on a free base
      contact:rolling, :oscillator, :block, :bounces, :ladder               contact, dry friction; MuJoCo, Siconos
      contact:falls             a step of falling robots beside MuJoCo's
      mechanisms:2, :5, :10, :20                                            SymPy mechanisms; lambdify and PyDy
      fields:breather, :wave-2d, :schroedinger                              partial differential equations; py-pde
      lattices:ring:1000, ..    array systems; C by hand, REBOUND, OpenMM
      digits                    31 digits; heyoka in long double and quadruple precision
      drift                     energy over ten million steps
      families                  periodic orbits a second, by continuation
      errors                    run.error and error= beside the run
      tolerances                default runs from 1e-3 to 1e-11 beside heyoka
      first-step                time from text to the first step
      scaling, threads          a step of array systems of 10^3 to 10^6 coordinates, in one and two threads
      by-hand                   a step of a ring and of a field beside C by hand
      transforms, newton        a step on Fourier meshes beside SciPy; Newton's method at large steps
      derivatives, builds       a step with tangent vectors and gradients; by compiler and processor
      bath                      heat baths of trajectories and liquids; JAX, diffrax, OpenMM

    Install the peers by pip install -e '.[bench]'. Each section is printed, and written to the JSON file, when it is
    complete.

    \b
    Examples:
      python -m benchmarks kepler:0.5 --peers heyoka --plot kepler.svg
      python -m benchmarks drift robots -o measured.json

    `python -m benchmarks guard OLD NEW` says whether one checkout is slower than another.
    """
    for path, hint in ((output, "'-o'"), (plot, "'--plot'")):
        if path is not None:
            check_writable(Path(path), hint)
    names = tuple(PEERS) if peers is None else tuple(filter(None, peers.split(",")))
    plan = Plan(peers=names, repeats=repeats, quick=quick)
    report = benchmark(sections, plan, output=output, plot_path=plot, report_activity=note, show=tell)
    tell(**report.data())
    if report.interrupted:
        raise CommandFailure(
            f"interrupted in section '{report.interrupted}'; the results before are printed above", INTERRUPTED
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["guard"]:
        guard(sys.argv[2:], prog_name="python -m benchmarks guard")
    main()
