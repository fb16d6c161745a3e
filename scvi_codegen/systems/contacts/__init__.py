"""Contacts with dry friction: definitions, and the constraints and forces of their modes."""
