"""Operator scripts for artificial muscles, under weights or on a stage."""
