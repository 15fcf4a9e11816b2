"""Measurements from files and runs."""
