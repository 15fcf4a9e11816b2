"""Compiled loops of the identification."""
