import pytest

from bench.base import DeviceError
from bench.rig import SAFE, make_safe


class Stub:
    def __init__(self, name, error=None):
        self.name = name
        self.error = error
        self.tried = 0

    def safe(self):
        self.tried += 1
        if self.error is not None:
            raise self.error


class TestMakeSafe:
    def test_tells_that_all_are_safe(self):
        assert make_safe([Stub("a"), Stub("b")]) == {"a": SAFE, "b": SAFE}

    @pytest.mark.parametrize(
        "error",
        [
            DeviceError("a", "port gone"),
            OSError(5, "Input/output error"),
            ZeroDivisionError("division by zero"),
            StopIteration(),
            Exception(),
            AssertionError("never"),
            KeyboardInterrupt(),
            SystemExit(3),
            GeneratorExit(),
        ],
        ids=lambda error: type(error).__name__,
    )
    def test_whatever_one_raises_the_others_are_tried(self, error):
        devices = [Stub("a", error), Stub("b"), Stub("c", error), Stub("d")]
        outcome = make_safe(devices)
        assert [device.tried for device in devices] == [1, 1, 1, 1]
        assert outcome["b"] == outcome["d"] == SAFE
        for name in "ac":
            assert outcome[name] != SAFE
            assert type(error).__name__ in outcome[name]

    def test_the_first_and_the_last_failing(self):
        devices = [Stub("a", OSError("gone")), Stub("b"), Stub("c", DeviceError("c", "no answer"))]
        assert make_safe(devices) == {"a": "OSError: gone", "b": SAFE, "c": "DeviceError: c: no answer"}

    def test_no_devices(self):
        assert make_safe([]) == {}
