"""Display of objects: notebook cards, MathML, tables of numbers, pages of HTML."""
