"""One step: compiled methods, their memory and derivatives, projections, plans of steps."""
