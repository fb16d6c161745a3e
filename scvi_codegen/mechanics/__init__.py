"""What moves: systems given by L or H, what follows from them, and what they conserve."""
