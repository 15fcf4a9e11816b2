"""An excursion of every actuator of a rig at once, with readings all along."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bench.devices import Limits, Switch
from bench.protocol import Dwell, Messages, ProtocolDefinition, ProtocolParameters, Step
from bench.rig import RigDescription, RoleTable

COUNT = 16
"""Number of steps."""
DWELL = 2.0
"""Hold at each step, s."""
_LEVELS = 7
"""Set-points of an actuator; a prime, so that each stride comes to all of them."""


def setpoints(rig: RigDescription, share: float) -> dict[str, tuple[float, ...]]:
    """Return the set-points of each actuator, one a step.

    They begin at the rest of its role, and go over a share of its range; each actuator takes its levels in an order
    of its own, so that a stale reading of one differs from the present one.

    Parameters
    ----------
    rig : RigDescription
        The connected rig.
    share : float
        Of the range, 0 to 1; a switch goes on and off.
    """
    roles = {role.device: role for role in rig.file.roles.values() if role.device}
    found = {}
    for number, (name, limits) in enumerate(rig.limits.items()):
        start, end = _ends(roles.get(name), limits, share)
        fractions = [step * (1 + number % (_LEVELS - 1)) % _LEVELS / (_LEVELS - 1) for step in range(COUNT)]
        if issubclass(rig.devices[name].kind, Switch):
            fractions, start, end = [float(round(each)) for each in fractions], 0.0, 1.0
        found[name] = tuple(start + each * (end - start) for each in fractions)
    return found


def _ends(role: RoleTable | None, limits: Limits, share: float) -> tuple[float, float]:
    low, high = (role and role.range) or (limits.low, limits.high)
    low, high = max(low, limits.low), min(high, limits.high)
    rest = role.rest if role and role.rest is not None else 0.0
    start = min(max(rest, low), high)
    way = share * (high - low)
    return start, min(start + way, high) if high - start >= start - low else max(start - way, low)


def excursion(ways: Mapping[str, Sequence[float]]) -> ProtocolDefinition:
    """Return the protocol that takes each device through its set-points."""

    def steps(parameters: ProtocolParameters) -> Messages:  # noqa: ARG001 - a protocol's form
        for step in range(COUNT):
            yield Step({device: points[step] for device, points in ways.items()}, Dwell(DWELL))

    return ProtocolDefinition(
        name="excursion",
        summary="Move every actuator",
        description="Move every actuator of a rig, with readings all along.",
        needs=tuple(ways),
        controls="",
        parameters=ProtocolParameters,
        generator=steps,
    )
