"""Variational equations of systems, compared with differences of motions."""

import numpy as np
import pytest
import sympy
from notation import lagrange
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.derived_systems import with_tangent_vectors


def test_tangent_vectors_satisfy_the_variational_equations():
    """x'' = -sin x - k x y^2 + cos t, and so on: forces of changes are the Hessian times these, masses the same."""
    system = lagrange(
        "two", "x y", "(m*x_dot**2 + y_dot**2)/2 + cos(x) - k*x**2*y**2/2", m=2.0, k=0.5, forces={"x": "cos(t)*y"}
    )
    varied = with_tangent_vectors(system, 2)
    assert [q.name for q in varied.coordinates] == [
        *("x", "y"),
        *("x_change_1", "y_change_1"),
        *("x_change_2", "y_change_2"),
    ]
    x, y, u, w, *_ = varied.coordinates
    k, m = sympy.symbols("k m", real=True)
    forces = forms_of(varied).force
    assert forms_of(varied).mass == {(i, i): (m, sympy.S.One)[i % 2] for i in range(6)}
    assert forces[:2] == forms_of(system).force
    wanted = -sympy.cos(x) * u - k * (y**2 * u + 2 * x * y * w) + sympy.cos(system.time) * w
    assert sympy.expand(forces[2] - wanted) == 0
    assert sympy.expand(forces[3] + k * (x**2 * w + 2 * x * y * u)) == 0
    assert forms_of(varied).separable


def test_reserved_names_are_avoided():
    system = lagrange("taken", "x x_change_1", "(x_dot**2 + x_change_1_dot**2)/2 - x**2*x_change_1")
    assert len({q.name for q in with_tangent_vectors(system, 2).coordinates}) == 6


def test_variable_masses_have_no_variational_equations():
    assert with_tangent_vectors(sc.problem("double-pendulum").system, 1) is None
    magnetic = lagrange("magnetic", "x y", "(x_dot**2 + y_dot**2)/2 + x*y_dot - y**2")
    assert with_tangent_vectors(magnetic, 1) is None


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "method", [sc.SVI(5), sc.SVI(3, "gauss-lobatto:5"), sc.Gauss(3)], ids=["svi", "other points", "gauss"]
)
def test_tangents_by_iteration_are_the_derivative_of_the_computed_flow(method):
    """Steps commute with differentiation: the tangent map of the run, also of a Hamiltonian, and symplectic."""
    kepler, (q, p) = sc.problem("kepler").system, ([0.5, 0.0], [0.0, 3**0.5])
    tangent = sc.compile_stepper(kepler, method, flags=QUICK_FLAGS).integrate(q, p, h=0.1, steps=63).tangent()[-1]
    made, directions = (
        sc.compile_stepper(sc.variational_system(sc.hamiltonian_of(kepler), 4), method, flags=QUICK_FLAGS),
        np.eye(4),
    )
    starts = (np.concatenate([own, of.T.ravel()]) for own, of in ((q, directions[:2]), (p, directions[2:])))
    end = made.integrate(*starts, h=0.1, steps=63)
    found = np.vstack([end.q[-1, 2:].reshape(4, 2).T, end.p[-1, 2:].reshape(4, 2).T])
    assert_allclose(found, tangent, rtol=0, atol=1e-11 * np.abs(tangent).max())
    omega = np.kron([[0, 1], [-1, 0]], np.eye(2))
    assert np.abs(found.T @ omega @ found - omega).max() < 1e-14 * np.abs(found).max() ** 2
