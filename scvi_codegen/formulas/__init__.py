"""Text and SymPy to one exact canonical expression; its derivatives, its value, and back to text."""
