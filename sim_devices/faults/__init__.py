"""Faults of an emulated laboratory: of its lines, of its instruments, and of what they measure and drive.

`fault` says what a fault is, `line` disturbs the bytes between a wire server and its clients, `sensor` and `supply`
stand between plant and instrument, and `calendar` makes faults begin and end at their instants.
"""
