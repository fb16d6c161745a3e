"""Times of generated programs relative to the recorded ones: ``golden_speed.py [rounds [name ...]]``.

Three programs take turns: the recorded one, the one generated now, and the recorded one compiled again, whose ratio to
the first shows how far minima may be trusted on this machine.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "oracles"))

from golden_cells import TIMED, build, program, recorded

from scvi_codegen.codegen.native.building import NO_UNROLL_FLAGS, TUNED_FLAGS

FLAGS = ("-std=gnu99", *TUNED_FLAGS, "-w", "-DSCVI_THREADS", "-pthread", "-DSCVI_LIBMVEC", "-lmvec")


def ratios(name: str, rounds: int) -> tuple[float, float, float]:
    """Time of the recorded program in milliseconds; relative to it, of the new one and of the recorded one again."""
    rolled = () if any(word in name for word in ("many", "newton", "ring", "rotors")) else NO_UNROLL_FLAGS
    with tempfile.TemporaryDirectory() as place:
        programs = []
        for number, each in enumerate((recorded()[name], program(name), recorded()[name])):
            folder = Path(place, str(number))
            folder.mkdir()
            programs.append(build(each, folder, (*FLAGS, *rolled)))
        shortest = [float("inf")] * 3
        for _ in range(rounds):
            for k, each in enumerate(programs):
                done = subprocess.run([each, "5"], check=True, capture_output=True, text=True)
                shortest[k] = min(shortest[k], float(done.stdout.split()[-1]))
    before, now, again = shortest
    return before / 1e6, now / before, again / before


def main() -> None:
    """Print a line for each program."""
    rounds, *names = sys.argv[1:] or ["30"]
    for name in names or TIMED:
        before, now, again = ratios(name, int(rounds))
        print(f"{name:24s} {before:8.3f} ms {now:6.3f} (again {again:.3f})", flush=True)


if __name__ == "__main__":
    main()
