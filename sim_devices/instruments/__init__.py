"""Emulated instruments: range, resolution, noise, protection, watchdogs, and what firmware does."""
