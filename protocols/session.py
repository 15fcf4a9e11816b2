"""The session of a controlled specimen: what moved since its model was identified, estimated before the task."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bench.control import ADAPTATIONS, AdaptationName, time_to_rest
from bench.identification import Kind, ModelFile, parse_kinds, ramps, recalibrate
from bench.protocol import Caution, Dwell, KeptModel, Note, Phase, Reading, Slots, Step, from_slot, parameter
from bench.rig import RoleTable
from protocols.preparation import ControlledParameters, Part, reset, reset_unknown_memory

SESSION = "session"
"""Label of the steps that visit known set-points."""

ADAPTED = "adapted"
"""Name of the corrected model among those of the run."""


class SessionParameters(ControlledParameters):
    """What can be set where a session may be estimated before a controller by a model drives the specimen."""

    recalibrate: str = parameter(
        "",
        unit="",
        help="what is estimated of the session before the task and corrected in the model: some of offset, gain, "
        "input-offset, with commas; nothing if empty",
    )
    recalibrate_readings: int = parameter(
        120, unit="1", low=10, high=10000, help="readings for that, on one loop from `reset` to `hottest` and back"
    )
    recalibrate_dwell: float = parameter(
        from_slot("drive", "dwell", fallback=0.0),
        unit="s",
        low=0,
        high=3600,
        help="hold before each of these readings; 0 for the time in which the specimen of the model comes to rest",
    )
    adaptation: AdaptationName = parameter(
        "off",
        unit="",
        help="how the model is corrected while it is used: offset, gain, input offset and width of the loops "
        "(session), or its density (density)",
        choices=lambda: ADAPTATIONS,
    )


def session_kinds(parameters: SessionParameters) -> tuple[Kind, ...]:
    """Return what is estimated of the session; nothing if that is not asked for.

    Raises ValueError if it is not understood, or a controller cannot be corrected by it.
    """
    kinds = parse_kinds(parameters.recalibrate) if parameters.recalibrate else ()
    if "drift" in kinds:
        raise ValueError("recalibrate = drift: a controller has no rows; expected offset, gain, input-offset")
    return kinds


def begin_session(
    parameters: SessionParameters, slots: Slots, model: ModelFile, kinds: tuple[Kind, ...]
) -> Part[tuple[Reading, ModelFile]]:
    """Reset the memory; return the last reading and the model, corrected by what moved in the session.

    With `kinds` the drive visits known set-points on one loop of its range, and returns to the reset. What moved is
    estimated from all readings there, and noted. Raises ValueError if the readings do not tell it, or the input of
    such a model cannot be shifted; ConfigurationError if nothing says how long the specimen takes to come to rest.
    """
    if left_out := model.provenance.get("left_out"):
        yield Caution(f"the controller takes the model of an input that stands still, without {left_out}")
    if text := model.beyond([parameters.reset, parameters.hottest]).text("limits of the set-points"):
        yield Note(text)
    if "input-offset" in kinds:
        # A model that cannot be corrected is refused before anything moves.
        model.operator.shifted(0.0)
    drive, response = slots["drive"], slots["response"]
    least = _least_reset(drive.table, model)
    dwell = parameters.recalibrate_dwell or (time_to_rest(None, model, "recalibrate") if kinds else 0.0)
    reading = yield from reset_unknown_memory(parameters, slots, least)
    if not kinds:
        return reading, model
    low, high = parameters.reset, parameters.hottest
    state = model.operator.saturated_state(-1, reading[drive.signal])
    inputs, outputs = [reading[drive.signal]], [reading[response.signal]]
    yield Phase("session: known set-points")
    for target in ramps([low, high, low], 2.0 * abs(high - low) / parameters.recalibrate_readings)[1:].tolist():
        reading = yield Step({drive.device: target}, Dwell(dwell), label=SESSION)
        inputs.append(reading[drive.signal])
        outputs.append(reading[response.signal])
    found = recalibrate(model.operator, np.array(inputs), np.array(outputs), kinds, state=state)
    texts = ", ".join(f"{kind} {text}" for kind, text in found.texts(drive.unit, response.unit))
    yield Note(f"session: {texts}, from {found.rows} readings at known set-points; the model is corrected by it")
    corrected = found.corrected(model.operator)
    reading = yield from reset(slots, low, least)
    return reading, replace(model, model=corrected, memory=None, band=None)


def _least_reset(drive: RoleTable, model: ModelFile) -> float:
    """Return how long the memory is reset at least, s; 0 where the rig file has a rule for it alone."""
    if drive.dwell is None and drive.reset is not None:
        return 0.0
    return time_to_rest(drive.dwell, model, "reset")


def keep_adapted(controller: Any, model: ModelFile) -> Part[None]:  # noqa: ANN401 - of a target or a reference
    """Note what a controller has learnt, and keep its corrected model with the run; nothing if it does not adapt."""
    adaptation = getattr(controller, "adaptation", None)
    if adaptation is None:
        return
    corrected = replace(
        model,
        model=adaptation.model,
        memory=controller.state,
        initial=None,
        band=None,
        provenance={**model.provenance, "adapted": adaptation.to_json()},
    )
    text = f"adaptation by {adaptation.name}: {adaptation.summary()}; the corrected model is kept as {ADAPTED!r}"
    yield KeptModel(text, ADAPTED, corrected.to_json())
