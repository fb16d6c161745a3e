"""Judgement of errors: estimated from the steps of a run, or confirmed by a run that does not share its steps."""
