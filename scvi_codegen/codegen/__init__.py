"""From the equations of a step to compiled C: representation, lowering, templates, compilers."""
