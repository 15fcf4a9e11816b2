"""Operators and inverses with a memory of their own, one sample at a time."""
