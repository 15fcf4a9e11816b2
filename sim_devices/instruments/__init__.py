"""Emulated instruments: range, resolution, noise, protection, watchdogs, and firmware behaviour."""
