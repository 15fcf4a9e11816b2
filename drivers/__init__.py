"""Drivers: one module or folder per instrument, which speaks its real protocol on a real wire."""
