"""Artificial muscles (SMA wire, McKibben, super-coiled polymer): coupled hysteresis of voltage, force and length."""
