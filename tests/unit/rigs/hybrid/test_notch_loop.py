"""The notch against a resonance."""

import math

import numpy as np
import pytest
from cases import cases
from scipy import signal

from bench.base import ConvergenceError
from bench.models import PrandtlIshlinskii
from rigs.hybrid.model import PUBLISHED_DYNAMICS
from rigs.hybrid.notch_loop import NotchLoop, NotchLoopParameters, notch


def test_notch():
    section = notch(PUBLISHED_DYNAMICS.frequency, 2e4, 0.0039)
    frequencies = np.array([0.0, 100.0, 693.7, 2000.0, 9999.0])
    _, found = signal.sosfreqz(section[None, :], worN=frequencies, fs=2e4)
    assert abs(found[0]) == pytest.approx(1.0, abs=1e-12)
    # At the frequency itself: the ratio of the dampings.
    _, centre = signal.sosfreqz(section[None, :], worN=[PUBLISHED_DYNAMICS.frequency / (2.0 * math.pi)], fs=2e4)
    assert abs(centre[0]) == pytest.approx(0.0039 / 0.7, rel=1e-6)
    assert abs(found[-1]) == pytest.approx(1.0, rel=1e-3)
    # The bilinear transform of the continuous one, its axis warped about the notch.
    warp = 2.0 * math.pi * frequencies[1:4]
    s = (
        1j
        * PUBLISHED_DYNAMICS.frequency
        * np.tan(0.5 * warp / 2e4)
        / math.tan(0.5 * PUBLISHED_DYNAMICS.frequency / 2e4)
    )
    w = PUBLISHED_DYNAMICS.frequency
    expected = (s**2 + 2 * 0.0039 * w * s + w**2) / (s**2 + 2 * 0.7 * w * s + w**2)
    assert found[1:4] == pytest.approx(expected, rel=1e-9)


def test_notch_takes_the_resonance_out_of_the_step():
    rate = 2e4
    section = notch(PUBLISHED_DYNAMICS.frequency, rate, PUBLISHED_DYNAMICS.damping)
    step = signal.sosfilt(section[None, :], np.ones(6000))
    unit = PUBLISHED_DYNAMICS.normalised()
    with_notch = unit.simulate(step, 1.0 / rate)
    assert unit.simulate(np.ones(6000), 1.0 / rate).max() > 1.26
    assert with_notch.max() < 1.01
    assert np.abs(with_notch[200:] - 1.0).max() < 0.005


@cases(
    ("make", "message"),
    [
        (lambda: notch(7e4, 2e4, 0.0), "frequency: expected rad/s between"),
        (lambda: notch(4e3, 2e4, -0.1), "zero_damping: expected a number >= 0"),
        (lambda: notch(4e3, 2e4, 0.1, 0.0), "pole_damping: expected a positive"),
        (lambda: NotchLoopParameters(rate=0.0, integral=1.0, stroke=1.0), "rate: expected a positive"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


RATE = 2e4
STIFF = PrandtlIshlinskii(
    np.array([0.0]), np.array([1.0]), input_range=(-10.0, 10.0), input_unit="V", output_unit="m"
)  # without hysteresis


def follow(size, delay, gain=1.0, reserve=10.0, seconds=0.1):
    """Step an ideal actuator with its resonance, seen later by a number of samples; return the deflections."""
    parameters = NotchLoopParameters(rate=RATE, integral=300.0, stroke=reserve)
    w, damping = PUBLISHED_DYNAMICS.frequency, PUBLISHED_DYNAMICS.damping
    loop = NotchLoop(STIFF, w, damping, lambda t: size if t >= 0.01 else 0.0, parameters)
    count = round(seconds * RATE)
    voltages, outputs = np.zeros(count), np.zeros(count)
    numerator, denominator, _ = signal.cont2discrete(([w * w], [1.0, 2 * damping * w, w * w]), 1 / RATE)
    # One sample sooner: what a voltage does until the next sample.
    section = np.array([*numerator[0, 1:], 0.0, *denominator])
    state = np.zeros((1, 2))
    for k in range(count):
        seen = outputs[k - delay] if k >= delay else 0.0
        (voltages[k],) = loop.update(k / RATE, (seen,))
        if k + 1 < count:
            out, state = signal.sosfilt(section[None, :], [voltages[k]], zi=state)
            outputs[k + 1] = gain * out[0]
    return outputs


def test_a_step_settles_without_overshoot():
    outputs = follow(5.0, delay=0)
    assert outputs.max() < 5.0 * 1.02
    assert outputs[-1] == pytest.approx(5.0, rel=1e-3)


def test_a_delay_that_makes_it_overshoot_ends_it():
    with pytest.raises(ConvergenceError, match=r"% beyond a step of 5.*lower its integral gain"):
        follow(5.0, delay=40)


@cases(
    ("height", "beyond", "samples", "ends"),
    [
        (5.0, 0.051, 11, True),
        (-5.0, 0.051, 11, True),
        (5.0, 0.051, 10, False),
        (5.0, 0.05, 40, False),
        (1.0, 0.3, 11, True),
        (0.999, 0.3, 40, False),
    ],
)
def test_more_than_5_percent_beyond_a_step_for_more_than_half_a_millisecond_end_it(height, beyond, samples, ends):
    # Steps below 5 % of the stroke, here 20, are not judged.
    parameters = NotchLoopParameters(rate=RATE, integral=300.0, stroke=10.0)
    loop = NotchLoop(STIFF, PUBLISHED_DYNAMICS.frequency, 0.0039, lambda t: height * (t > 0.0), parameters)

    def see(overshoot, times):
        for _ in range(times):
            see.sample += 1
            loop.update(see.sample / RATE, (height * (1.0 + overshoot),))

    see.sample = 0
    loop.update(0.0, (0.0,))
    see(beyond, min(samples, 10))
    see(0.0, 1)
    if ends:
        with pytest.raises(ConvergenceError, match=f"beyond a step of {height:g}"):
            see(beyond, samples)
    else:
        see(beyond, samples)


def test_an_actuator_at_the_end_of_its_stroke_ends_it():
    with pytest.raises(ConvergenceError, match=r"at the end of its stroke, 2 short of the reference 9"):
        follow(9.0, delay=0, gain=0.7)


def test_it_waits_50_ms_at_the_end_of_the_stroke():
    parameters = NotchLoopParameters(rate=RATE, integral=300.0, stroke=10.0)
    loop = NotchLoop(STIFF, PUBLISHED_DYNAMICS.frequency, 0.0039, lambda _: 9.0, parameters)
    # Nothing moves: the integral comes to the end of the stroke after 10 / (300 / RATE * 9) samples.
    for k in range(math.floor(10.0 / (300.0 / RATE * 9.0)) + round(0.05 * RATE)):
        loop.update(k / RATE, (0.0,))
    with pytest.raises(ConvergenceError, match="at the end of its stroke"):
        loop.update(k / RATE, (0.0,))


def test_the_reach_is_less_than_the_stroke():
    parameters = NotchLoopParameters(rate=RATE, integral=300.0, stroke=4.0)
    loop = NotchLoop(STIFF, PUBLISHED_DYNAMICS.frequency, 0.0039, float, parameters)
    assert loop.reach == pytest.approx((-3.8, 3.8))
