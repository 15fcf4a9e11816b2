"""Emulated laboratories: plants, instruments, and the wire servers that answer for them."""
