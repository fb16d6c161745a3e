"""Chaos indicators: growth of tangent vectors."""
