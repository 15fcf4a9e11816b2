"""Hysteresis operators."""
