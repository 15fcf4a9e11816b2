"""Every fault of an emulated rig, each in a run of its own that is judged by instruments and plant.

`excursion` moves the actuators, `running` carries a run out with one fault, `truth` says what its record may contain,
and `commands` has the command `bench rig torture`.
"""
