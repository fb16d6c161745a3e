"""Symmetries and what they conserve, by Noether's theorem: found, named, checked."""
