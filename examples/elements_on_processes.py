"""Domain decomposition of spectral elements: processes exchange the forces of shared points, s numbers per border.

Each process has the elements of its part with all of their points, so that neighbours share one. It computes the forces
of its own elements; at a shared point both processes add the forces of both sides (direct stiffness summation). That
is the partition and the messages of a decomposition over MPI (docs/decomposition.md), here with processes of one
machine. The sine-Gordon breather has the same bits on 1, 2 and 4 processes, and the states of the compiled integrator.
"""

from __future__ import annotations

import numpy as np
from field_on_two_processes import MOST, STAGES, STEPS, H, Part, on_processes, tables

import scvi_codegen as sc

DEGREE, ELEMENTS = 8, 32
FIELD = sc.FieldSystem.from_text(
    "sine-Gordon",
    fields=["u"],
    space={"x": (-64.0, 64.0)},
    boundary={"x": "periodic"},
    density="u_t**2/2 - u_x**2/2 - (1 - cos(u))",
)
MESH = FIELD.discretise("spectral-elements", degree=DEGREE, elements=ELEMENTS)
HALF = 64.0 / ELEMENTS


def forces(x: np.ndarray) -> np.ndarray:
    """Return the forces of elements at (stages, points), without those of elements of other processes."""
    (axis,) = MESH.axes
    weights = np.array([float(each) for each in axis.quadrature])
    derivative = np.array([[float(each) for each in row] for row in axis.operators[1]])
    stiffness = derivative.T @ (weights[:, None] * derivative) / HALF
    elements = np.stack([x[:, a : x.shape[1] - DEGREE + a : DEGREE] for a in range(DEGREE + 1)], axis=2)
    local = -HALF * weights * np.sin(elements)
    for b in range(DEGREE + 1):  # sums in a fixed order have the same bits for any number of elements
        local -= elements[:, :, b, None] * stiffness[b]
    ends = np.zeros((len(x), elements.shape[1] + 1))
    ends[:, 1:] = local[:, :, -1]
    ends[:, :-1] += local[:, :, 0]
    inner = local[:, :, :-1].reshape(len(x), -1)
    inner[:, ::DEGREE] = ends[:, :-1]
    return np.append(inner, ends[:, -1:], axis=1)


def run(part: Part, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the positions after all steps and the number of iterations, with the first point of the next part."""
    (a, b, c), iterations, turn = tables(), 0, 0

    def with_next(values: np.ndarray, turn: int) -> np.ndarray:
        _, right = part.neighbours(np.tile(values, (STAGES, 1)), turn)
        return np.append(values, right[0])

    q, v = with_next(q, 0), with_next(v, 1)
    masses = MESH.weights[np.arange(len(q)) % DEGREE]

    def accelerations(x: np.ndarray, turn: int) -> np.ndarray:
        f = forces(x)
        left, right = part.neighbours(f, turn)
        f[:, :1], f[:, -1:] = left + f[:, :1], f[:, -1:] + right
        return f / masses

    for _ in range(STEPS):
        straight = q + H * c[:, None] * v
        x, change = straight, np.inf
        for _ in range(MOST):
            moved = straight + H * H * (a @ a @ accelerations(x, turn)) - x
            x, before, change = x + moved, change, part.total(moved[:, :-1], turn)
            iterations, turn = iterations + 1, 1 - turn
            if change == 0.0 or (change >= before and change < 1e-24 * MESH.weights.size):
                break
        f = accelerations(x, turn)
        turn = 1 - turn
        q, v = q + H * v + H * H * (b @ a @ f), v + H * (b @ f)
    return q[:-1], iterations


def main() -> None:
    """Compare the bits of one, two and four processes, and the states of the compiled integrator."""
    x = MESH.points["x"]
    rate = 3.2 / np.cosh(0.8 * x)
    exact = sc.compile_stepper(MESH.system, "gauss:4").integrate({"u": 0 * x}, velocity={"u": rate}, h=H, steps=STEPS)
    ends = [on_processes(count, 0 * x, rate, run)[0] for count in (1, 2, 4)]
    print("two and four processes have the bits of one:", bool((ends[0] == ends[1:]).all()))
    print("and the states of the compiled integrator:", bool(np.abs(ends[0] - exact.q["u"][-1]).max() < 1e-13))
    print(f"numbers sent across a border in an iteration: {2 * STAGES}")


if __name__ == "__main__":
    main()
