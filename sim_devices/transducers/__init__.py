"""Emulated transducers: quantities of a plant as voltages at the inputs of an instrument."""
