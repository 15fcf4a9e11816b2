"""Excitations and the design of experiments."""
