"""Fixtures of the contracts on an emulated rig."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from bench.base import Clock, VirtualClock
from bench.devices import Device
from bench.rig import EMULATED, JOIN, Rig, load_rig


class OnEmulatedRig:
    """Connects the device under test on its emulated rig. It stands before the contracts.

    ::

        class TestContract(OnEmulatedRig, ActuatorContract, RestartedActuatorContract):
            rig_file, device_name = "frame.toml", "frame"

    Attributes
    ----------
    rig_file : str
        The rig file, from the folder of the test on.
    device_name : str
        The device, by its name in the rig file. The fixture `twin` is the emulated instrument at its port: the
        contract of a restart calls its `power_cycle`, and reads the true output, 0 when it is off, as its `output`.
    """

    rig_file: ClassVar[str]
    device_name: ClassVar[str]

    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        """Connect the rig; make its devices safe and close them afterwards. A rig that is real is refused."""
        file = load_rig(str(Path(inspect.getfile(type(self))).parent / self.rig_file))
        if not file.emulated:
            pytest.fail(f"{file.path} is a real rig, whose devices would move; use pytest --pyargs bench.contracts")
        with Rig(file, VirtualClock(), seed=0) as rig:
            yield rig

    @pytest.fixture
    def device(self, rig: Rig) -> Device:
        """Return the device under test."""
        return rig.devices[self.device_name]

    @pytest.fixture
    def clock(self, rig: Rig) -> Clock:
        """Return the clock of the rig."""
        return rig.clock

    @pytest.fixture
    def twin(self, rig: Rig) -> Any:  # noqa: ANN401 - of any class
        """Return the emulated instrument of the device."""
        (settings,) = (entry.settings for entry in rig.file.devices if entry.name == self.device_name)
        laboratory: Any = rig.laboratory
        port = getattr(settings, "port", "").removeprefix(EMULATED)
        # On a shared line the instrument has the name of its device.
        return laboratory.instruments[self.device_name if JOIN in port else port]

    @pytest.fixture
    def restart(self, twin: Any) -> Callable[[], object]:  # noqa: ANN401 - of any class
        """Return what switches the instrument off and on again."""
        restart: Callable[[], object] = twin.power_cycle
        return restart

    @pytest.fixture
    def output(self, twin: Any) -> Callable[[], float]:  # noqa: ANN401 - of any class
        """Return what tells the true output of the instrument."""
        return lambda: float(twin.output)
