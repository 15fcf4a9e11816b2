"""A driver's tests against an emulated instrument: the fixture comes with the package `actuator-bench`."""

import serial


def test_the_controller_tells_its_name(emulated_rig):
    with serial.serial_for_url(emulated_rig("vo2").port("tec"), 57600, timeout=10) as line:
        line.write(b"#0115AA?IF257D\r")
        assert line.read_until(b"\r").startswith(b"!0115AA8065-TEC SW")


def test_an_over_current_switches_the_output_off(emulated_rig):
    rig = emulated_rig("vo2")
    rig.control.fault("tec-over-current")
    assert rig.control.state()["tec_output"] == 0
