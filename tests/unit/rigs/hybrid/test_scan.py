"""The sensors of the hybrid in one compiled call: the same readings as one conversion after the other."""

import pytest
from cases import cases

from bench.base import VirtualClock
from bench.rig import Rig, load_rig

SIGNALS = ("displacement_position", "base_temperature", "tip_temperature")


def readings(*, scanned, then=None, **emulation):
    """Return what a fast loop reads while heat and voltage change; `then` is done to the laboratory halfway."""
    overrides = {f"emulation.{key}": str(value) for key, value in emulation.items()}
    with Rig(load_rig("hybrid", overrides), VirtualClock(), 5) as bench:
        laboratory = bench.laboratory
        if not scanned:
            laboratory.t7.scan_by(None)
        read = bench.quick_reader(SIGNALS)
        bench.devices["tec"].set(0.1)
        found = []
        for k in range(400):
            bench.clock.sleep(0.0137)
            bench.devices["piezo"].set(10.0 * (k % 7) - 30.0)
            if k == 200 and then is not None:
                then(laboratory)
            found.append(read())
        laboratory.t7.thaw()
        return found


class TestScan:
    @cases("emulation", [{}, {"sensors": "ideal"}, {"tip_thermistor": "{lag = 0.5}"}])
    def test_the_readings_are_those_of_single_conversions_to_the_last_bit(self, emulation):
        assert readings(scanned=True, **emulation) == readings(scanned=False, **emulation)

    @cases("fault", ["tip.drifting", "displacement.noisy", "base.stuck", "cantilever-stuck"])
    def test_they_are_while_a_fault_goes_on(self, fault):
        def then(laboratory):
            laboratory.inject(fault, duration=1.0)

        assert readings(scanned=True, then=then) == readings(scanned=False, then=then)

    def test_they_are_of_an_instrument_that_hangs(self):
        def then(laboratory):
            laboratory.t7.freeze()

        found = readings(scanned=True, then=then)
        assert found == readings(scanned=False, then=then)
        assert found[200] == found[-1]

    def test_a_broken_wire_is_seen(self):
        def then(laboratory):
            laboratory.inject("open-thermistor")

        with pytest.raises(Exception, match="thermistor open"):
            readings(scanned=True, then=then)

    def test_a_scan_is_used(self):
        with Rig(load_rig("hybrid"), VirtualClock(), 5) as bench:
            calls = []
            scan = bench.laboratory.t7._scan

            class Counted:
                count = scan.count

                def __call__(self, *given):
                    calls.append(scan(*given))
                    return calls[-1]

            bench.laboratory.t7.scan_by(Counted())
            read = bench.quick_reader(SIGNALS)
            read()
            read()
            assert len(calls) > 0
            assert all(len(each) == scan.count for each in calls)
