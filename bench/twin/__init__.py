"""The twin of a specimen: an emulated laboratory made from what was measured on it.

`recording` reads the runs, `actuator`, `response` and `disturbances` identify its parts, `reading_time` what a reading
takes, `specimen` computes what it does, and `parameters` and `rig_text` keep it: numbers in, numbers out, no device.
"""
