"""The exact inverse of operators whose output is piecewise linear, along a monotone move, in a drive of the input."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from bench.base import Floats, checks as _checks
from bench.models.inverses.inverse import Inversion, NumericalInverse
from bench.models.operators.elements import ElementState
from bench.models.reach import Reach

_TOLERANCE = 2e-13
"""Part of the output scale within which a target counts as met.

Source: rounding of float64: a sum of 1000 elements errs by no more than 1000 times 2.2e-16.
"""


class Branch(NamedTuple):
    """The output along a monotone move to an end of the operating range: linear between its corners."""

    # Shape (n,); the drive at the corners, in the order of the move; the first is that of the present input.
    drives: Floats
    outputs: Floats  # shape (n,); the output there, output units, all rising or all falling


class Branched(Protocol):
    """What the inverse needs of an operator beside what every operator has."""

    def branch(self, state: ElementState, direction: int) -> Branch:
        """Return the branch from a state to the low (-1) or the high (1) end of the operating range."""
        ...

    def input_of(self, drive: float, direction: int) -> float:
        """Return the input of a drive on a branch of that direction."""
        ...


class BranchInverse(NumericalInverse[ElementState]):
    """The exact inverse of an operator that rises, or falls, with its input.

    From the present state one direction leads towards the target. Its branch is piecewise linear in the drive, so
    that the piece with the target and the place within are found without iteration. A target beyond the branch is
    clamped to the end of the operating range. A target counts as met within 2e-13 of the output scale.
    """

    def invert(self, state: ElementState, target: float) -> Inversion[ElementState]:
        """Return the set-point that brings the output from `state` to `target`; see `Inverse.invert`."""
        wanted = _checks.number("target", target)
        operator = self.operator
        branched: Branched = operator  # type: ignore[assignment]  # checked where this inverse is made
        ways = [branched.branch(state, direction) for direction in (-1, 1)]
        least, greatest = sorted((float(ways[0].outputs[-1]), float(ways[1].outputs[-1])))
        tolerance = _TOLERANCE * max(abs(least), abs(greatest), abs(wanted))
        here = float(ways[0].outputs[0])
        setpoint, pieces = operator.present_input(state), 1
        if abs(wanted - here) > tolerance:
            upwards = (ways[1].outputs[-1] - ways[0].outputs[-1] >= 0.0) == (wanted > here)
            direction = 1 if upwards else -1
            drives, outputs = ways[int(upwards)]
            sign = 1.0 if wanted > here else -1.0
            pieces = int(np.searchsorted(sign * outputs, sign * wanted))
            if pieces == outputs.size:
                setpoint = operator.input_range[int(upwards)] if outputs.size > 1 else setpoint
            else:
                share = (wanted - outputs[pieces - 1]) / (outputs[pieces] - outputs[pieces - 1])
                drive = drives[pieces - 1] + share * (drives[pieces] - drives[pieces - 1])
                setpoint = branched.input_of(float(drive), direction)
        after, output = operator.step(state, setpoint)
        scale = max(tolerance, 1e-12 * max(abs(least), abs(greatest), abs(here)))
        short = wanted - output
        return Inversion((setpoint,), (output,), Reach.of(abs(short) <= scale, short), pieces, after)
