"""Steps as functions of other libraries: what JAX and CasADi differentiate and call, and optimal control by these."""
