"""The notch against a resonance."""

import math

import numpy as np
import pytest
from scipy import signal

from bench.control.notch_loop import NotchLoopParameters, notch
from rigs.hybrid.model import PUBLISHED_DYNAMICS


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


@pytest.mark.parametrize(
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
