"""Certificates of fields on meshes, at a state and a step size that verify chooses."""

import pytest

import scvi_codegen as sc

PERIODIC = {"x": "periodic"}
CASES = [
    pytest.param(
        sc.FieldSystem.from_text(
            "Schroedinger",
            ["a"],
            {"x": (-5, 5)},
            hamiltonian="(a_x**2 + b_x**2)/4 - (a**2 + b**2)**2/4",
            momenta=["b"],
            boundary=PERIODIC,
        ),
        ("finite-differences", {"order": 2, "points": 6}),
        id="differences",
    ),
    pytest.param(
        sc.FieldSystem.from_text(
            "sine-Gordon", ["u"], {"x": (0, 6)}, "u_t**2/2 - u_x**2/2 + cos(u)", boundary=PERIODIC
        ),
        ("fourier", {"points": 6, "derivative": "fft"}),
        id="fourier",
        marks=pytest.mark.full,
    ),
    pytest.param(
        sc.FieldSystem.from_text(
            "string", ["u"], {"x": (0, 1)}, "u_t**2/2 - u_x**2/2", boundary={"x": ("sin(t)", "natural")}
        ),
        ("spectral-elements", {"degree": 2, "elements": 4}),
        id="elements",
        marks=pytest.mark.full,
    ),
]


@pytest.mark.rotated
@pytest.mark.parametrize(("field", "mesh"), CASES)
def test_integrators_of_meshes_have_their_properties(field, mesh):
    method, options = mesh
    certificate = sc.verify(field.discretise(method, **options).system, "svi:1")
    assert not certificate.violated, certificate.to_text()
    satisfied = {check.name for check in certificate.checks if check.outcome == "satisfied"}
    assert {"unrolled system", "symplecticity", "order", "rates", "energies"} <= satisfied
