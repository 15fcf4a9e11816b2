"""Exact inverses of operators."""
