"""Derivation of the equations of a step: text, LaTeX, and table entries in radicals."""

import scvi_codegen as sc

pendulum = sc.problem("planar-pendulum").system

print("Two-point pendulum: degree 1, trapezoidal rule")
print()
equations = sc.derive(pendulum, sc.SVI(1, "gauss-lobatto:2"))
print(equations.to_text())
print("The same in LaTeX")
print()
print(equations.to_latex())
print()
print("Degree 2, two Gauss points, in radicals")
print()
print(sc.derive(pendulum, sc.SVI(2), radicals=True).to_text())
