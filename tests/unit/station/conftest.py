import pytest
from heater_laboratory import RIG

from bench.base import VirtualClock
from bench.execution.station.local import LocalStation
from bench.rig import Rig, load_rig


@pytest.fixture
def heater(tmp_path):
    """A station on the heated plate in this process, with additions to its rig file."""
    rigs = []

    def make(append="", interlock_rate=None):
        path = tmp_path / "heater.toml"
        path.write_text(RIG + append, encoding="utf-8")
        rigs.append(Rig(load_rig(str(path), {}), VirtualClock(), 0))
        return LocalStation(rigs[-1], interlock_rate), rigs[-1]

    yield make
    for rig in rigs:
        rig.close()
