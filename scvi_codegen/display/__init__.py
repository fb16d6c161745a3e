"""How things show themselves: notebook cards, MathML, tables of numbers, pages of HTML."""
