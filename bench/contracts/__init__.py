"""The contracts of the roles as tests, for the devices of the bench and for those of others.

To check a device of your own on a rig file of your own::

    pytest --pyargs bench.contracts --device my_module:MyDevice --rig my_rig.toml

`docs/how-to/add-a-device.md` says more. Only this package needs pytest.
"""

import pytest
from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)

pytest.register_assert_rewrite(*(f"{__name__}.{module}" for module in ("devices", "roles", "faults", "operators")))
