"""The rigs: one folder each, with its rig files and the parts that only this rig has.

A folder may hold a laboratory (the emulated instruments and what they are connected to), identification and
controllers, a study (what `bench study` carries out) and commands. They are registered as entry points in
`pyproject.toml`; no other package imports this one.
"""
