"""Contacts in runs: choice of their modes, impacts, and runs in pieces of constant modes."""
