"""Analog inputs of a LabJack T7: their settings, bursts that the instrument averages, and single conversions.

Sources: LabJack T-series datasheet 14.1.7 for averaging in the instrument, 14.3.0 for the analog inputs. The
datasheet gives the highest scan rate of each resolution index in appendix A-1: the instrument refuses a burst at a
higher rate, and the error says so.

Assumption: one request for the averages of several inputs carries out their bursts one after the other.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Annotated, Self, TypeVar

import numpy as np
from pydantic import Field, field_validator, model_validator

from bench.base import Clock, DeviceError
from bench.devices import Device
from drivers.labjack_t7.device import T7ConnectionSettings, T7Device
from drivers.labjack_t7.registers import (
    AIN,
    AIN_EF_INDEX,
    AIN_EF_READ_AVERAGE,
    AIN_EF_READ_MAXIMUM,
    AIN_EF_READ_MINIMUM,
    AIN_EF_SAMPLES,
    AIN_EF_SCAN_RATE,
    AIN_NEGATIVE_CH,
    AIN_RANGE,
    AIN_RESOLUTION_INDEX,
    AIN_SETTLING_US,
    STREAM_RESOLUTION_INDEX,
    STREAM_SETTLING_US,
    Floats,
    LabJackT7,
    Packet,
    Register,
    Span,
)

CHANNELS = 14
RAIL = 0.999
"""Share of the nominal range from which on a reading counts as over-range."""

_SINGLE_ENDED = 199
_AVERAGE_MIN_MAX = 3  # AIN_EF_INDEX, datasheet 14.1.7
_LONGEST_BURST = 0.18  # s, datasheet 14.1.7
_MOST_SAMPLES = 16384
_MISSED_SAMPLE = -9999.0  # what a stream puts in place of a sample that it had to leave out
_LARGEST_RANGE = 10.0  # V


Channel = Annotated[int, Field(ge=0, lt=CHANNELS)]


class T7InputSettings(T7ConnectionSettings):
    """How analog inputs are read; every sensor on a T7 extends it."""

    channels: tuple[Channel, ...] = Field(default=(0,), description="analog inputs, 0 to 13")
    range: float = Field(default=10.0, description="input range in V: 10, 1, 0.1 or 0.01, either sign")
    resolution_index: int = Field(
        default=4, ge=0, le=8, description="resolution index, 0 (instrument's default) to 8 (least noise, slowest)"
    )
    settling_us: float = Field(
        default=0.0, ge=0.0, le=4400.0, description="settling time of an input in µs, 0 (automatic) to 4400"
    )
    samples: int = Field(
        default=10, ge=1, le=_MOST_SAMPLES, description="conversions averaged in one measurement, 1 to 16384"
    )
    sample_rate: float = Field(
        default=1000.0, gt=0.0, le=100_000.0, description="conversions in a second in Hz, above 0 to 100000"
    )

    @field_validator("range")
    @classmethod
    def _check_range(cls, value: float) -> float:
        if value not in (10.0, 1.0, 0.1, 0.01):
            raise ValueError(f"allowed are 10, 1, 0.1 and 0.01 V, got {value:g}")
        return value

    @model_validator(mode="after")
    def _check_burst(self) -> Self:
        if len(set(self.channels)) != len(self.channels):
            raise ValueError(f"channels: expected different ones, got {list(self.channels)}")
        duration = self.samples / self.sample_rate
        if self.samples > 1 and duration > _LONGEST_BURST:
            raise ValueError(
                f"samples / sample_rate: a T7 averages over at most {_LONGEST_BURST:g} s, got {duration:g} s"
            )
        if len(self.channels) * duration >= self.timeout:
            raise ValueError(f"timeout: a measurement alone takes {len(self.channels) * duration:g} s")
        return self


InputSettingsT = TypeVar("InputSettingsT", bound=T7InputSettings)


class T7InputDevice(T7Device[InputSettingsT]):
    """A device on a LabJack T7 that is read by analog inputs.

    `measure` has the instrument average a burst of `samples` conversions of each input, `glance` takes one
    conversion; each is one request. Both raise `DeviceError` if a conversion is not valid or over the range, as
    clipped conversions would shift the mean.

    The settings of bursts (STREAM_RESOLUTION_INDEX, STREAM_SETTLING_US) are common to all inputs of one instrument:
    give sensors on the same one the same `resolution_index` and `settling_us`.
    """

    def __init__(self, name: str, settings: InputSettingsT, clock: Clock, line: LabJackT7) -> None:
        super().__init__(name, settings, clock, line)
        self._limit = RAIL * settings.range
        self._conversions = _spans(AIN, settings.channels)
        self._averages = Packet.of(
            [
                span
                for register in (AIN_EF_READ_AVERAGE, AIN_EF_READ_MAXIMUM, AIN_EF_READ_MINIMUM)
                for span in _spans(register, settings.channels)
            ]
        )
        self._packet = Packet.of(self._conversions)

    def _start(self) -> None:
        settings, instrument = self._settings, self._line
        instrument.claim(self._clock)
        instrument.set({STREAM_RESOLUTION_INDEX: settings.resolution_index})
        instrument.set({STREAM_SETTLING_US: settings.settling_us})
        for channel in settings.channels:
            instrument.set({AIN_RANGE.of(channel): settings.range})
            instrument.set({AIN_NEGATIVE_CH.of(channel): _SINGLE_ENDED})
            instrument.set({AIN_RESOLUTION_INDEX.of(channel): settings.resolution_index})
            instrument.set({AIN_SETTLING_US.of(channel): settings.settling_us})
            # Off first, so that nothing of an earlier set-up remains.
            instrument.set({AIN_EF_INDEX.of(channel): 0})
            if settings.samples > 1:
                instrument.set({AIN_EF_INDEX.of(channel): _AVERAGE_MIN_MAX})
                instrument.set({AIN_EF_SAMPLES.of(channel): settings.samples})
                instrument.set({AIN_EF_SCAN_RATE.of(channel): settings.sample_rate})

    def measure(self) -> dict[str, float]:
        """Measure every signal, by the means of `samples` conversions."""
        return self._values(*self._average())

    def glance(self) -> dict[str, float]:
        """Measure every signal by one conversion of each input; raises what `measure` does."""
        return self._taken(self._read())

    def _taken(self, voltages: Sequence[float]) -> dict[str, float]:
        """Return the signals of one conversion of each input."""
        return self._values(*self._check(voltages))

    def joins(self, other: Device) -> bool:
        """Return whether another device can be read in one request with this one: on the same connection."""
        return isinstance(other, T7InputDevice) and other.is_on(self._line)

    def joined(self, others: Sequence[Device]) -> Callable[[], dict[str, float]]:
        """Return what glances at this device and others behind it in one request."""
        spans: list[Span] = []
        parts = []
        begin = 0
        limit = math.inf
        for device in (self, *others):
            assert isinstance(device, T7InputDevice)
            spans += device.conversions
            end = begin + len(device._settings.channels)
            parts.append((begin, end, device._taken, device._put))
            begin, limit = end, min(limit, device._limit)
        packet = Packet.of(spans)
        lowest, highest = -limit, limit

        def glance() -> dict[str, float]:
            # Over the line of the moment, as it may have been renewed.
            voltages = self._line.read_packet(packet)
            values: dict[str, float] = {}
            for volts in voltages:
                if not lowest < volts < highest:
                    # Each device knows its own limit.
                    for begin, end, taken, _ in parts:
                        values.update(taken(voltages[begin:end]))
                    return values
            for begin, _, _, put in parts:
                put(values, voltages, begin)
            return values

        return glance

    @property
    def conversions(self) -> tuple[Span, ...]:
        """What `glance` reads."""
        return self._conversions

    def is_on(self, instrument: LabJackT7) -> bool:
        """Return whether it shares this connection to its instrument."""
        return self._line.shares_connection(instrument)

    def converted(self, voltages: Floats) -> Floats:
        """Return the signals (a row each) of conversions of each input (a row each, V).

        Raises what `glance` does for the first of the conversions that is wrong.
        """
        if not (np.abs(voltages) < self._limit).all():
            for row in voltages.tolist():
                self._check(row)
        return self._converted(voltages)

    def _converted(self, voltages: Floats) -> Floats:
        return np.array([list(self._values(*row).values()) for row in voltages.tolist()])

    def _values(self, *volts: float) -> dict[str, float]:
        """Return the signals of a voltage of each input."""
        values: dict[str, float] = {}
        self._put(values, volts, 0)
        return values

    @abstractmethod
    def _put(self, values: dict[str, float], voltages: Sequence[float], begin: int) -> None:
        """Put the signals among the values; the voltages of this device begin there."""

    def _average(self) -> Sequence[float]:
        """Get the mean of `samples` conversions of each input in V; the inputs are averaged one after the other."""
        if self._settings.samples == 1:
            return self._check(self._read())
        # The averages come first: reading one starts the burst and waits for its end.
        values = self._line.read_packet(self._averages)
        count = len(self._settings.channels)
        means, maxima, minima = (values[start : start + count] for start in range(0, 3 * count, count))
        self._check(maxima)
        self._check(minima)
        return self._check(means)

    def _read(self) -> tuple[float, ...]:
        if len(self._conversions) == 1:
            return self._line.read_span(self._conversions[0])
        return self._line.read_packet(self._packet)

    def _check(self, voltages: Sequence[float]) -> Sequence[float]:
        """Return one voltage for each input; raise `DeviceError` for one that is not valid or over the range."""
        limit = self._limit
        for volts in voltages:
            if not -limit < volts < limit:
                raise self._invalid(voltages)
        return voltages

    def _invalid(self, voltages: Sequence[float]) -> DeviceError:
        limit = self._settings.range
        for channel, volts in zip(self._settings.channels, voltages, strict=True):
            if not math.isfinite(volts) or volts == _MISSED_SAMPLE:
                return DeviceError(
                    self.name,
                    f"AIN{channel} gave no valid conversion; choose a lower `sample_rate` or `resolution_index`",
                )
            if abs(volts) >= self._limit:
                break
        larger = "choose a larger `range`, or " if limit < _LARGEST_RANGE else ""
        return DeviceError(
            self.name,
            f"AIN{channel} reads {volts:.4g} V and is over its range of ±{limit:g} V; {larger}bring "
            "what is measured back into it",
        )


def _spans(register: Register, channels: Sequence[int]) -> tuple[Span, ...]:
    """Return what to read for every input: one span where they are neighbours."""
    if tuple(channels) == tuple(range(channels[0], channels[0] + len(channels))):
        return (Span.of(register.of(channels[0]), len(channels)),)
    return tuple(Span.of(register.of(channel)) for channel in channels)
