"""Peers for partial differential equations: py-pde, split steps with SciPy's FFT by hand, and differences in Numba."""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks.cases.unforced import Array, Case
from benchmarks.report import Contender
from scvi_codegen.methods.composition import Composition

MESHES = ((128, 1e-4), (512, 1e-6), (2048, 1e-8))
"""Points of an axis and tolerance of py-pde, whose differences are of order 2."""
MODES = (96, 128, 192, 256, 384)
STEPS = tuple(25 * 2**k for k in range(7))
STENCIL = (-205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560)
"""Second difference of order 8."""
LARGEST = {1: 2048, 2: 512}
"""Most points of an axis by the number of axes."""


def composed(order: int) -> tuple[Array, Array]:
    """Return kicks and drifts of leapfrog, Suzuki's composition of order 4 or that of this package of order 8."""
    if order != 4:
        kicks, drifts = Composition(order).kicks_and_drifts
        return np.array(kicks, dtype=float), np.array(drifts, dtype=float)
    p = 1.0 / (4.0 - 4.0 ** (1 / 3))
    parts = [p, p, 1.0 - 4.0 * p, p, p]
    halves = [(one + other) / 2 for one, other in zip([0.0, *parts], [*parts, 0.0], strict=True)]
    return np.array(halves), np.array([*parts, 0.0])


def _axes(field: Any, count: int) -> list[Array]:
    """Return the coordinates of equidistant points of the periodic axes, without the ends."""
    return [low + (high - low) / count * np.arange(count) for low, high in field.field.space.values()]


def _points(axes: list[Array]) -> dict[str, Array]:
    return dict(zip("xyz", np.meshgrid(*axes, indexing="ij"), strict=False))


def _contender(
    field: Any, points: Any, names: tuple[str, str], seconds: float, prepare: Callable[[], Any]
) -> Contender:
    error = partial(field.error, points)
    return Contender(*names, "", seconds, lambda _: prepare(), starts=1, error=error)


def pde_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield py-pde's Runge-Kutta-Fehlberg method with adaptive steps, compiled by Numba."""
    import pde

    field = case.field
    ends = list(field.field.space.values())
    for count, tolerance in MESHES[: 1 if quick else None]:
        if count > LARGEST[len(ends)]:
            continue
        grid = pde.CartesianGrid(ends, count, periodic=True)
        points = {axis: grid.cell_coords[..., k] for k, axis in enumerate("xyz"[: len(ends)])}
        first, second = field.exact(points, 0.0)
        parts = [first + 1j * second] if field.complex else [first, second]
        start: Any = pde.FieldCollection([pde.ScalarField(grid, part, dtype=part.dtype) for part in parts])
        start = start[0] if field.complex else start
        began = time.perf_counter()
        solver = pde.RungeKuttaSolver(pde.PDE(field.pde), backend="numba", adaptive=True, tolerance=tolerance)
        step = solver.make_stepper(start, 1e-3)
        step(start.copy(), 0.0, 1e-3)
        seconds = time.perf_counter() - began

        def prepare(step: Any = step, start: Any = start) -> Callable[[], Any]:
            state = start.copy()

            def integrate() -> Callable[[], Array]:
                step(state, 0.0, field.span)
                return final

            def final() -> Array:
                return np.array([state.data.real, state.data.imag] if field.complex else [state[0].data])

            return integrate

        yield _contender(field, points, ("py-pde", f"{count} points, tol={tolerance:.0e}"), seconds, prepare)


def fft_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield split steps: the linear part exactly in Fourier space, the rest exactly at points; orders 2, 4 and 8.

    A linear equation is solved by one such step, which is left out.
    """
    field = case.field
    if field.name == "wave-2d":
        return
    yield from _by_composition(field, quick, "FFT split steps", MODES, 0.0, partial(_split_steps, field))


def _by_composition(
    field: Any, quick: bool, name: str, counts: Sequence[int], seconds: float, prepare: Callable[..., Any]
) -> Iterator[Contender]:
    """Yield compositions of order 2, 4 and 8; ``prepare``: function of axes, kicks and drifts, number of steps."""
    for order in (2, 4, 8):
        for count in counts[: 1 if quick else None]:
            axes = _axes(field, count)
            for steps in STEPS[: 2 if quick else None] if count <= LARGEST[len(axes)] else ():
                names = (f"{name}, order {order}", f"{count} points, {steps} steps")
                prepared = partial(prepare, axes, composed(order), steps)
                yield _contender(field, _points(axes), names, seconds, prepared)


def _split_steps(field: Any, axes: list[Array], composition: Any, steps: int) -> Callable[[], Any]:
    from scipy import fft

    x, h = axes[0], field.span / steps
    k = 2 * np.pi * fft.fftfreq(len(x), x[1] - x[0])
    first, second = field.exact(_points(axes), 0.0)
    flows: dict[float, Any] = {}
    for _, b in zip(*composition, strict=True):
        w, t = np.abs(k[: len(k) // 2 + 1]), b * h
        flows[b] = (np.exp(-0.5j * t * k**2), np.cos(w * t), t * np.sinc(w * t / np.pi), w * np.sin(w * t))

    def schroedinger_step(psi: Any) -> Any:
        for a, b in zip(*composition, strict=True):
            psi = psi * np.exp(1j * a * h * np.abs(psi) ** 2) if a else psi
            psi = fft.ifft(flows[b][0] * fft.fft(psi)) if b else psi
        return psi

    def wave_step(state: Any) -> Any:
        u, v = state
        for a, b in zip(*composition, strict=True):
            v = v - a * h * np.sin(u) if a else v
            if b:
                (one, other), (_, cosine, sine, lower) = fft.rfft([u, v]), flows[b]
                u, v = fft.irfft([cosine * one + sine * other, cosine * other - lower * one], len(k))
        return u, v

    step: Any
    start: Any
    step, start = (schroedinger_step, first + 1j * second) if field.complex else (wave_step, (first, second))

    def integrate() -> Callable[[], Array]:
        state = start
        for _ in range(steps):
            state = step(state)
        return lambda: np.array([state.real, state.imag] if field.complex else [state[0]])

    return integrate


def numba_contenders(case: Case, quick: bool) -> Iterator[Contender]:
    """Yield differences of order 8 with leapfrog and compositions of order 4 and 8, in loops by Numba, for waves."""
    field = case.field
    if field.complex:
        return
    began = time.perf_counter()
    advance = _numba_waves(nonlinear=field.name == "breather")
    seconds = time.perf_counter() - began

    def prepare(axes: list[Array], composition: Any, steps: int) -> Callable[[], Any]:
        u, v = (np.array(np.atleast_2d(part)) for part in field.exact(_points(axes), 0.0))

        def integrate() -> Callable[[], Array]:
            advance(u, v, axes[0][1] - axes[0][0], field.span / steps, steps, *composition)
            return lambda: np.array([u if len(axes) > 1 else u[0]])

        return integrate

    yield from _by_composition(field, quick, "Numba differences", (64, 128, 256, 512), seconds, prepare)


def _numba_waves(*, nonlinear: bool) -> Any:
    import numba

    stencil = np.array(STENCIL)

    @numba.njit(fastmath=True)  # type: ignore[untyped-decorator]  # Numba ships no stubs
    def advance(u: Array, v: Array, dx: float, h: float, steps: int, kicks: Array, drifts: Array) -> None:
        rows, n = u.shape
        for step in range(steps * len(kicks)):
            a, b = h * kicks[step % len(kicks)], h * drifts[step % len(kicks)]
            for i in range(rows if a != 0.0 else 0):
                for j in range(n):
                    total = (2.0 if rows > 1 else 1.0) * stencil[0] * u[i, j]
                    for k in range(1, len(stencil)):
                        total += stencil[k] * (u[i, j + k - n if j + k >= n else j + k] + u[i, j - k])
                        if rows > 1:
                            total += stencil[k] * (u[i + k - rows if i + k >= rows else i + k, j] + u[i - k, j])
                    v[i, j] += a * (total / (dx * dx) - (np.sin(u[i, j]) if nonlinear else 0.0))
            if b != 0.0:
                u += b * v

    advance(np.zeros((2, 8)), np.zeros((2, 8)), 1.0, 0.0, 1, np.ones(2), np.ones(2))
    return advance
