"""The paper's figures on Kepler's problem."""
