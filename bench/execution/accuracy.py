"""The accuracy that is asked of a run, beside what the uncertainty budget of its controlled signal supports."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base import ConfigurationError, difference_unit, read_quantity
from bench.protocol import ProtocolDefinition, ProtocolParameters
from bench.rig import LEVEL, RigDescription, Slots

_PLACES = 9
"""Values of the controlled signal at which its budget is looked at. Derivation: an uncertainty is straight between
them but for a nonlinearity, which is the same everywhere."""


def check_accuracy(
    asked: str,
    definition: ProtocolDefinition,
    parameters: ProtocolParameters,
    description: RigDescription,
    slots: Slots,
) -> dict[str, Any]:
    """Check that the budget of the controlled signal supports an accuracy; return both for the record of the run.

    It is looked at from the lowest to the highest target of the protocol, otherwise over the range of the slot.

    Parameters
    ----------
    asked : str
        Largest expanded uncertainty for 95 %: a number in the unit of the signal, or with a unit.
    definition, parameters, description, slots
        What is run, and on which rig.

    Raises
    ------
    ConfigurationError
        If it is no positive number with a unit of the signal, the protocol controls nothing, the uncertainty is not
        stated, or it is larger; names the component that limits it.
    """
    option = f"accuracy {asked or repr(asked)}"
    signal = definition.controlled(slots)
    if not signal:
        raise ConfigurationError(f"{option}: protocol {definition.name} controls no signal; leave it out")
    unit = description.unit(signal)
    try:
        wanted = read_quantity(asked, difference_unit(unit))
    except ValueError as error:
        raise ConfigurationError(f"{option}: {error}") from None
    if not 0.0 < wanted < np.inf:
        raise ConfigurationError(f"{option}: expected a number above 0 {unit}")
    low, high = _range(definition, parameters, slots, option)
    signals = description.uncertain()
    budgets = [signals.at(signal, value).budget() for value in np.linspace(low, high, _PLACES).tolist()]
    worst = max(budgets, key=lambda budget: budget.expanded)
    if not worst.stated:
        raise ConfigurationError(f"{option}: cannot be promised. {worst.advice()}")
    if worst.expanded > wanted:
        shown = worst.in_fitting_unit()
        raise ConfigurationError(
            f"{option}: the budget of {signal} supports {shown.expanded:.2g} {shown.unit} ({100.0 * LEVEL:.0f} %) at "
            f"{shown.value:.4g} {shown.unit}. {shown.advice()}"
        )
    return {"signal": signal, "unit": unit, "asked": wanted, "supported": worst.expanded, "level": LEVEL}


def _range(
    definition: ProtocolDefinition, parameters: ProtocolParameters, slots: Slots, option: str
) -> tuple[float, float]:
    if definition.targets is not None:
        targets = definition.targets(parameters, slots)
        return float(targets.min()), float(targets.max())
    slot = slots.get(definition.controls)
    if slot is None or slot.table.range is None:
        raise ConfigurationError(f"{option}: the rig file gives no range of {definition.controls}")
    return slot.table.range
