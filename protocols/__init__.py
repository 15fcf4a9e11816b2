"""Operator scripts, one file a protocol."""
