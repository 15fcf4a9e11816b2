"""Operator scripts of the thermo-piezoelectric hybrid."""
