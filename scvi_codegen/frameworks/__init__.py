"""What other libraries take: steps as functions of JAX and CasADi, optimal control by these, bodies for REBOUND."""
