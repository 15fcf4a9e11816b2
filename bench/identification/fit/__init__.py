"""Constrained least squares and what belongs to one fit."""
