"""Emulated transducers: what a plant does, as voltages at the inputs of an instrument."""
