"""The contact problem of ``templates/support/run/cone.h``, compiled by itself, and a judge of its solutions."""

import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from cffi import FFI
from numpy.typing import ArrayLike, NDArray
from programs import needs
from strict_c import STRICT

CONTACTS, ROWS = 30, 90
"""Largest numbers; contacts beyond those of a problem take no part."""
TEMPLATES = Path(__file__).parents[2] / "templates"
STRUCTURES = f"""
typedef struct {{ int normal, tangential, slips; }} contact_places;
typedef struct {{ int is_closed, pushes, sticks; double direction[2]; }} cone_mode;
typedef struct {{
  const contact_places *places;
  int contacts, rows;
  const double *W;
  double b[{ROWS}], terms[{ROWS}], f[{ROWS}];
  int takes_part[{CONTACTS}], rests[{CONTACTS}];
  double mu[{CONTACTS}], mu_static[{CONTACTS}], given[{CONTACTS}][2];
  cone_mode mode[{CONTACTS}];
  int is_static[{CONTACTS}], most_points, newtons, points;
  double compliance, residual;
}} cone_problem;
int solve_problem(const contact_places *places, cone_problem *in);
"""
SOURCE = f"""
#include <float.h>
#include <limits.h>
#include <math.h>
#include <string.h>
#define EVENT_CONTACTS {CONTACTS}
enum {{ BAND = 0, CONTACT_ROWS = {ROWS} }};
typedef struct {{ int normal, tangential, slips; }} contact_places;
static contact_places CONTACTS[EVENT_CONTACTS];
#include "support/run/cone.h"
int solve_problem(const contact_places *places, cone_problem *in);
int solve_problem(const contact_places *places, cone_problem *in)
{{
  memcpy(CONTACTS, places, sizeof CONTACTS);
  return solve_cone(in);
}}
"""
Vector = NDArray[np.float64]


class Problem(NamedTuple):
    """Data of a problem: W, b and the sizes of its terms by rows, the other ones by contacts.

    Attributes:
        places: (normal row or -1, first row of the slip, their number) of each contact.
        free: contacts that take no part.
        rests: static friction is the limit until they slip.
        friction, static: coefficients, or without a gap sizes of friction.
        given: directions of slips that have one, else 0.
    """

    W: NDArray[np.float64]
    b: Vector
    terms: Vector
    places: Sequence[tuple[int, int, int]]
    free: NDArray[np.bool_]
    rests: NDArray[np.bool_]
    friction: Vector
    static: Vector
    given: NDArray[np.float64]

    @classmethod
    def at_rest(
        cls, W: ArrayLike, b: ArrayLike, slips: int, friction: ArrayLike, *, static: Any = None, gaps: bool = True
    ) -> "Problem":
        """Return a problem whose slips rest, with rows by contacts: a normal one, if there are gaps, and the slips."""
        mu, rates, width = np.asarray(friction, float), np.asarray(b, float), gaps + slips
        starts = range(0, len(rates), width)
        places = [(first if gaps else -1, first + gaps, slips) for first in starts]
        rests = np.full(len(mu), static is not None)
        none, at_rest = np.zeros(len(mu), bool), mu if static is None else np.asarray(static, float)
        return cls(np.asarray(W, float), rates, np.abs(rates), places, none, rests, mu, at_rest, np.zeros((len(mu), 2)))

    def violation(self, f: Vector) -> float:
        """Largest violation of the conditions by forces, in rates relative to the terms of their rows.

        f_n = max(f_n - u_n / W_nn, 0), and friction is the projection of f_t - u_t / W_tt onto the disc of its limit
        (J. J. Moreau 1988): that of static friction where there is no slip, else that of sliding.
        """
        u, diagonal, largest = self.b + self.W @ f, np.diag(self.W), 0.0
        size = np.maximum(np.abs(self.b), self.terms) + np.sqrt(diagonal) * (np.sqrt(diagonal) @ np.abs(f))
        for k in np.flatnonzero(~self.free):
            n, first, count = self.places[k]
            rows = slice(first, first + count)
            if n >= 0:
                violated = abs(f[n] - max(f[n] - u[n] / diagonal[n], 0.0)) * diagonal[n]
                largest = max(largest, violated / max(size[n], np.finfo(float).tiny))
            if not count:
                continue
            scale, w = max(size[rows].max(), np.finfo(float).tiny), diagonal[rows].max()
            sticks = self.rests[k] and np.abs(u[rows]).max() <= 1e-10 * scale
            limit = (self.static if sticks else self.friction)[k] * (max(f[n], 0.0) if n >= 0 else 1.0)
            z = f[rows] - u[rows] / w
            length = float(np.linalg.norm(z))
            friction = z if length <= limit else z / length * limit
            if self.given[k].any():
                friction = -limit * self.given[k, :count]
            largest = max(largest, np.abs(f[rows] - friction).max() * w / scale)
        return float(largest)


class Solution(NamedTuple):
    """Whether there is one, forces, rates, and whether contacts stick."""

    solved: bool
    f: Vector
    u: Vector
    sticks: NDArray[np.bool_]


@cache
def _library(folder: Path) -> tuple[FFI, Any]:
    (folder / "cone.c").write_text(SOURCE)
    command = [needs("cc"), *STRICT, "-O1", "-shared", "-fPIC", f"-I{TEMPLATES}", "-o", "cone.so", "cone.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    ffi = FFI()
    ffi.cdef(STRUCTURES)
    return ffi, ffi.dlopen(str(folder / "cone.so"))


def solve(problem: Problem, folder: Path, start: ArrayLike = 0.0) -> Solution:
    """Solve a problem from given forces; the folder has the compiled header."""
    ffi, library = _library(folder)
    places, own, W = ffi.new(f"contact_places[{CONTACTS}]"), ffi.new("cone_problem *"), np.zeros((ROWS, ROWS))
    rows, contacts = len(problem.b), len(problem.places)
    W[:rows, :rows] = problem.W
    own.W = ffi.cast("const double *", W.ctypes.data)
    for k in range(CONTACTS):
        places[k] = problem.places[k] if k < contacts else (-1, -1, 0)

    def view(name: str) -> Any:
        integer = name in ("takes_part", "rests")
        return np.frombuffer(ffi.buffer(getattr(own, name)), np.int32 if integer else np.float64)

    for name, values in (("b", problem.b), ("terms", problem.terms), ("f", np.broadcast_to(start, rows))):
        view(name)[:rows] = values
    of_contacts = {"takes_part": ~problem.free, "rests": problem.rests, "mu": problem.friction}
    for name, each in (of_contacts | {"mu_static": problem.static}).items():
        view(name)[:contacts] = each
    view("given").reshape(-1, 2)[:contacts] = problem.given
    solved = bool(library.solve_problem(places, own))
    sticks = np.array([bool(own.mode[k].sticks) for k in range(contacts)])
    f = view("f")[:rows].copy()
    return Solution(solved, f, problem.b + problem.W @ f, sticks)
