"""The twin of a specimen: an emulated laboratory made from what was measured on it.

`recording` reads the runs, from which `response`, `correction`, `disturbances`, `unevenness` and `reading_time` find
its parts; `specimen` computes what it does; `tables` and `rig_text` keep it. No device is touched.
"""
