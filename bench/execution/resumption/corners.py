"""The shortest sequence of set-points that leaves a specimen with hysteresis as a whole record left it."""

from __future__ import annotations

from collections.abc import Sequence


def corners(values: Sequence[float]) -> list[int]:
    """Return where the corners of a sequence stand that a rate-independent hysteresis still remembers.

    The first is the largest excursion, to either side: what was before is wiped out by it. From there on maxima and
    minima alternate, each the last of its height, down to the last value (the wiping-out property; see
    `bench.models.MemoryCurve`, whose corners these are).

    Parameters
    ----------
    values : sequence of float, shape (N,)
        What an actuator was set to, in its order.

    Returns
    -------
    list of int
        Indices into `values`, ascending; empty if there are none.

    Examples
    --------
    >>> corners([20.0, 80.0, 40.0, 45.0, 42.0, 70.0, 60.0])
    [0, 1, 2, 5, 6]
    """
    found: list[int] = []
    if not values:
        return found
    highest = max(range(len(values)), key=lambda i: (values[i], i))
    lowest = min(range(len(values)), key=lambda i: (values[i], -i))
    at, rising = min(highest, lowest), lowest < highest
    found.append(at)
    last = len(values) - 1
    while at < last:
        rest = range(at + 1, last + 1)
        at = max(rest, key=lambda i: (values[i], i)) if rising else min(rest, key=lambda i: (values[i], -i))
        # A plateau is one corner, and its end counts.
        if values[at] == values[found[-1]]:
            found[-1] = at
        else:
            found.append(at)
        rising = not rising
    return found
