"""Identification of models with time."""
