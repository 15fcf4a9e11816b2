"""The contracts on an emulated rig, as a package of one's own tests its device."""

import pytest

from bench.contracts import ActuatorContract, OnEmulatedRig, RestartedActuatorContract


class TestSupply(OnEmulatedRig, ActuatorContract, RestartedActuatorContract):
    rig_file, device_name = "../../examples/bench-supply.toml", "supply"


class TestRealRig(OnEmulatedRig):
    rig_file, device_name = "../../rigs/vo2/vo2-hardware.toml", "tec"

    def test_a_real_rig_is_refused(self, request):
        with pytest.raises(pytest.fail.Exception, match="is a real rig, whose devices would move"):
            request.getfixturevalue("rig")
