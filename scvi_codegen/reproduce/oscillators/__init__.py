"""Figures of the paper on systems with one degree of freedom: oscillator, pendulum, Duffing."""
