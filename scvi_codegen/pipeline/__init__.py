"""Derivation of C sources: from a mechanical system and a method to the texts that are compiled."""
