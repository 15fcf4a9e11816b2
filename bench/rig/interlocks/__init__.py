"""Interlocks: what signals may not do while a run goes on, and what is done about it."""
