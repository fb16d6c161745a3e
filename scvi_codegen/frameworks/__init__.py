"""What other libraries take: steps as functions that JAX and CasADi call in C, bodies for REBOUND."""
