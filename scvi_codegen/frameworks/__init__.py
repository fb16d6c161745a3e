"""Steps as differentiable functions of other libraries: what JAX and CasADi call in C, without Python between."""
