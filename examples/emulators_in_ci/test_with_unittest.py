"""The same with the standard library: `python -m unittest`."""

import unittest

import serial

from sim_devices.serving.process import serve


class Controller(unittest.TestCase):
    """Its tests share one served rig."""

    @classmethod
    def setUpClass(cls) -> None:
        """Serve the rig until the last test of the class."""
        cls.rig = cls.enterClassContext(serve("vo2"))

    def test_it_tells_its_name(self) -> None:
        """The answer is that of the device specification."""
        with serial.serial_for_url(self.rig.port("tec"), 57600, timeout=10) as line:
            line.write(b"#0115AA?IF257D\r")
            assert line.read_until(b"\r").startswith(b"!0115AA8065-TEC SW")


if __name__ == "__main__":
    unittest.main()
