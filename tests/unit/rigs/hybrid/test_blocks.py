"""Loops whose controller steps a block of samples a call: played by the T7 itself, and taken one by one."""

import numpy as np
import pytest

from bench.base import ConfigurationError, DeviceError, Interrupts, LimitError, VirtualClock
from bench.control import Playback, Trace
from bench.execution.context import trace_signals
from bench.execution.engine import Engine
from bench.execution.station.local import LocalStation
from bench.protocol import FixedRate, ProtocolParameters, find_protocol, protocol
from bench.record import FILE_NAME, Journal, Record
from bench.rig import Rig, load_rig
from rigs.hybrid.notch_loop import NotchLoop

RATE = 20e3
DEFLECTION = "displacement_position"


class Nothing(ProtocolParameters):
    pass


class Integral:
    """Integrates the mean of a block's readings; remembers what it was asked."""

    def __init__(self):
        self.level, self.blocks = 0.0, []
        self.trace = Trace()

    def step_block(self, times, readings, out):
        self.blocks.append((times.copy(), readings.copy()))
        if len(readings):
            self.level += 0.2 * (2e-6 - readings[:, 0].mean()) / 0.26e-6
        out[:] = self.level


def run(folder, message, hinder=None):
    """Return how it ended, the rows of the loop, and the rig, which is closed."""

    @protocol(needs=("piezo", DEFLECTION), controls=DEFLECTION)
    def go(parameters: Nothing):
        """Run it."""
        yield message

    folder.mkdir()
    with Rig(load_rig("hybrid"), VirtualClock(), 1) as rig:
        if hinder is not None:
            hinder(rig)
        journal = Journal(folder / FILE_NAME, (*rig.signals, *trace_signals(go, rig.description, {})), {})
        outcome = Engine(LocalStation(rig), journal, (), Interrupts()).run(go, Nothing())
        journal.close()
    with Record(folder) as record:
        ticks = record.telemetry()
    taken = np.isfinite(ticks["lateness"])
    return outcome, {name: values[taken] for name, values in ticks.columns.items()}


def loop(controller, **keys):
    keys = {"duration": 0.04, "block": 50} | keys
    return FixedRate(controller=controller, rate=RATE, inputs=(DEFLECTION,), actuators=("piezo",), **keys)


def one_by_one(rig):
    rig.devices["piezo"].can_play = lambda *_: False


def sine(t):
    return 3.0 * np.sin(2 * np.pi * 200.0 * t)


def no_look_at_the_status(rig):
    # It takes conversions, whose noise would be drawn at another place.
    rig.devices["piezo"].set(0.0)


def test_the_instrument_gives_what_single_samples_give(tmp_path):
    found = {}
    for name, message, hinder in (
        ("played", loop(Playback(sine)), None),
        ("in blocks one by one", loop(Playback(sine)), one_by_one),
        ("sample by sample", loop(Playback(sine), block=0), None),
    ):
        outcome, rows = run(
            tmp_path / name.replace(" ", "-"),
            message,
            lambda rig, hinder=hinder: (no_look_at_the_status(rig), hinder and hinder(rig)),
        )
        assert outcome.status == "completed", outcome.reason
        found[name] = rows
    reference = found.pop("sample by sample")
    assert len(reference["t"]) == 800
    for rows in found.values():
        for name in ("t", DEFLECTION, "piezo_setpoint", "lateness"):
            # Instants differ in their last bits, which a step of the sensor (10 nm) may show at worst.
            scale = {DEFLECTION: 11e-9}.get(name, 1e-9)
            np.testing.assert_allclose(rows[name], reference[name], rtol=0, atol=scale, err_msg=name)
        assert np.mean(rows[DEFLECTION] == reference[DEFLECTION]) > 0.99


def test_readings_of_a_block_act_on_the_next(tmp_path):
    controller = Integral()
    outcome, rows = run(tmp_path / "integral", loop(controller, duration=0.1025, record_every=7))
    assert outcome.status == "completed", outcome.reason
    assert [len(times) for times, _ in controller.blocks] == [50] * 41
    assert [len(readings) for _, readings in controller.blocks] == [0] + [50] * 40
    np.testing.assert_allclose(np.concatenate([times for times, _ in controller.blocks]), np.arange(2050) / RATE)
    assert controller.blocks[-1][1].mean() == pytest.approx(2e-6, abs=0.2e-6)
    start = rows["t"][0]
    np.testing.assert_allclose(rows["t"] - start, np.arange(0, 2050, 7) / RATE, atol=1e-9)


def test_what_is_beyond_the_limits_is_not_sent(tmp_path):
    sent = []

    def watch(rig):
        line = rig.devices["piezo"]._line
        play = line.play
        line.play = lambda spans, register, values, wait: (sent.append(values), play(spans, register, values, wait))[
            1
        ]

    for number, (limits, text) in enumerate(
        (
            ((), "set-point 41 V is outside of -40 to 40 V"),
            (((-2.0, 2.0),), "the controller asked for 41, beyond -2 to 2"),
        )
    ):
        sent.clear()
        outcome, _ = run(
            tmp_path / str(number), loop(Playback(lambda t: 1.0 if t < 0.0049 else 41.0), limits=limits), watch
        )
        assert isinstance(outcome.error, LimitError)
        assert outcome.reason == f"piezo: {text}"
        assert max(values.max() for values in sent) < 1.0
        assert outcome.is_safe


def test_a_reading_out_of_range_ends_the_run_safe(tmp_path):
    outcome, _ = run(tmp_path / "far", loop(Playback(sine)), lambda rig: setattr(rig.laboratory, "_beyond", 1e-3))
    assert isinstance(outcome.error, DeviceError)
    assert "over its range" in outcome.reason
    assert outcome.is_safe


def test_a_block_longer_than_the_telemetry_period_is_refused(tmp_path):
    outcome, _ = run(tmp_path / "long", loop(Playback(sine), duration=4.0, block=40_001))
    assert isinstance(outcome.error, ConfigurationError)
    assert "telemetry period" in outcome.reason


def test_a_controller_of_samples_is_no_controller_of_blocks():
    with pytest.raises(ValueError, match="step_block"):
        loop(NotchLoop.__new__(NotchLoop))


def test_the_step_of_the_piezo_in_blocks(tmp_path):
    """The protocol of the identification; its set-points are known in advance, so that a block delays nothing."""
    definition = find_protocol("piezo-step")
    positions = []
    for block in (0, 50):
        folder = tmp_path / str(block)
        folder.mkdir()
        with Rig(load_rig("hybrid"), VirtualClock(), 1) as rig:
            parameters = definition.parameters(voltage=5.0, duration=0.02, block=block)
            journal = Journal(
                folder / FILE_NAME,
                (*rig.signals, *trace_signals(definition, rig.description, rig.description.slots(definition))),
                {},
            )
            outcome = Engine(LocalStation(rig), journal, (), Interrupts()).run(definition, parameters)
            journal.close()
        assert outcome.status == "completed", outcome.reason
        with Record(folder) as record:
            ticks = record.telemetry()
        positions.append(ticks[DEFLECTION][np.isfinite(ticks["lateness"])])
    assert len(positions[0]) == 800
    assert np.ptp(positions[0]) > 1e-6
    assert np.abs(positions[1] - positions[0]).max() < 0.1e-6
