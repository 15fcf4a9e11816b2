"""Protocols: the vocabulary of operator scripts, their parameters, their plan, and their discovery."""

from bench.binding import Slot, Slots
from bench.protocol.discovery import Packaged, digest_of, find_protocol, is_installed, packaged_protocols, source_of
from bench.protocol.parameters import (
    ParameterHelp,
    ProtocolDefinition,
    ProtocolParameters,
    from_slot,
    parameter,
    protocol,
    unit_of,
)
from bench.protocol.plan import Plan, plan
from bench.protocol.views import Views
from bench.protocol.vocabulary import (
    LATENESS,
    TRACES,
    Caution,
    Control,
    FixedRate,
    KeptModel,
    Message,
    Messages,
    Note,
    Phase,
    Prompt,
    Reading,
    Step,
    Summary,
)
from bench.settling import Arrived, Dwell, Settle, Settled, UntilSteady

__all__ = [
    "LATENESS",
    "TRACES",
    "Arrived",
    "Caution",
    "Control",
    "Dwell",
    "FixedRate",
    "KeptModel",
    "Message",
    "Messages",
    "Note",
    "Packaged",
    "ParameterHelp",
    "Phase",
    "Plan",
    "Prompt",
    "ProtocolDefinition",
    "ProtocolParameters",
    "Reading",
    "Settle",
    "Settled",
    "Slot",
    "Slots",
    "Step",
    "Summary",
    "UntilSteady",
    "Views",
    "digest_of",
    "find_protocol",
    "from_slot",
    "is_installed",
    "packaged_protocols",
    "parameter",
    "plan",
    "protocol",
    "source_of",
    "unit_of",
]
