"""The contracts of the roles as tests, for the devices of the bench and for those of others.

To check a device of your own on a rig file of your own::

    pytest --pyargs bench.contracts --device my_module:MyDevice --rig my_rig.toml

runs the contract of each role that the class plays against each device of that class on the rig; `--device` may
also be the name of one device. An emulated rig runs on the virtual clock. On a real rig an actuator moves only
between the two values of `--set-points`, but is asked to refuse values just beyond its limits. Each test connects
the rig anew, and afterwards makes its devices safe and closes them.

To go further, subclass a contract of `bench.contracts.devices`, `roles` or `faults` in a test module, or that of
`bench.contracts.operators` for a model of your own, and provide its fixtures: the classes say which ones they need,
and which others a subclass may override.

Needs pytest; nothing else of the bench does.
"""

import pytest

pytest.register_assert_rewrite(*(f"{__name__}.{module}" for module in ("devices", "roles", "faults", "operators")))
