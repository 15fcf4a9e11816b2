"""Emulated laboratories for other processes: instruments on pseudo-terminals and TCP ports, and a control socket.

`bench rig emulate RIG` serves; `sim_devices.serving.process.serve` starts it for scripts and tests, and the fixture
`emulated_rig` for pytest.
"""
