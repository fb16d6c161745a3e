"""The paper's figures on systems of one degree of freedom: oscillator, pendulum, Duffing."""
