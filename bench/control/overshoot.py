"""Moves of an input that overshoots, in two parts, so that it comes to rest at its set-point without passing it."""

from __future__ import annotations

import math

LEAST = 0.01
"""Overshoot, as a part of a move, below which moves are made at once.

Derivation: of a move of a twentieth of the range it is 0.05 % of that, the tolerance of an arrival.
"""
_MOST = 0.6
"""Greatest overshoot that is believed.

Derivation: e^(−πζ / √(1 − ζ²)) with a damping ζ of 0.16; a loop that is damped less is out of order.
"""
_NEW = 0.5
"""Weight of what the last move showed. Derivation: with a weight w (2 − w) / w moves count, three."""


class Overshoot:
    """How far an input overshoots, learned from its moves by their size.

    A linear input that overshoots a step by the share k of it comes to rest at its target if it is sent to
    1 / (1 + k) of the way first, and on to the target at the moment of its peak there (Smith, "Posicast control of
    damped oscillatory systems", Proceedings of the IRE 45, 1957). Where the rate of the input is limited a longer
    move overshoots less, so that each size of moves has its own share.

    Parameters
    ----------
    significant : float
        Least move that shows an overshoot, input units.
    """

    def __init__(self, significant: float) -> None:
        self._significant = significant
        self._shares: dict[int, float] = {}

    def share(self, move: float) -> float:
        """Return the overshoot that is expected of a move (input units), as a part of it; 0 if it is too small."""
        if not self._shares or abs(move) < self._significant:
            return 0.0
        size = _size(move)
        nearest = min(self._shares, key=lambda known: abs(known - size))
        share = self._shares[nearest]
        return share if share >= LEAST else 0.0

    def learn(self, move: float, share: float) -> None:
        """Take in by which part of it a move (input units) overshot, or would have if it was not divided."""
        if abs(move) < self._significant:
            return
        size, share = _size(move), min(max(share, 0.0), _MOST)
        before = self._shares.get(size, share)
        self._shares[size] = before + _NEW * (share - before)


def _size(move: float) -> int:
    """Return in which octave the size of a move is."""
    return round(math.log2(abs(move)))


class Passing:
    """How far an input passes its set-point at the end of a move.

    Parameters
    ----------
    start, setpoint : float
        Of the move, input units.
    overshoot : Overshoot
        Learns of it.
    in_one : bool
        Whether the move was made at once, as only then it shows the overshoot.
    """

    def __init__(self, start: float, setpoint: float, overshoot: Overshoot, *, in_one: bool) -> None:
        self._way, self._setpoint = setpoint - start, setpoint
        self._overshoot, self._in_one = overshoot, in_one
        self._farthest = 0.0

    def note(self, measured_input: float) -> None:
        """Take in a reading on the way."""
        if self._way:
            self._farthest = max(self._farthest, (measured_input - self._setpoint) / self._way)

    def learn(self) -> None:
        """End the move."""
        if self._in_one:
            self._overshoot.learn(self._way, self._farthest)
