"""What the control socket takes: each request is a line of JSON, and is parsed strictly.

A request names itself under `do`; `docs/reference/emulate.md` shows some.
"""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bench.base import ConfigurationError, parse_json, problems
from bench.rig import ScheduledFault

_LONGEST_SKIP = 3600.0
_RIG = Field(default=None, description="which rig is meant, where several are served")


class Request(BaseModel):
    """Base of the requests; the docstring of each says what it does."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    name: ClassVar[str]


class RigRequest(Request):
    """Base of what is asked of one rig."""

    rig: str | None = _RIG


class Help(Request):
    """Say which requests there are, and the instruments and faults of each rig."""

    name = "help"


class State(RigRequest):
    """Return the true state of plant and outputs."""

    name = "state"


class Time(RigRequest):
    """Return laboratory time, clock, and the factor that it has reached."""

    name = "time"


class Wait(RigRequest):
    """Answer when the laboratory time has come."""

    name = "wait"
    until: float = Field(description="laboratory time, s")


class Advance(RigRequest):
    """Let laboratory time pass at once, on a clock xN; the clients are not served meanwhile."""

    name = "advance"
    seconds: float = Field(ge=0.0, le=_LONGEST_SKIP, description="laboratory time that passes, s")


class InjectFault(RigRequest):
    """Make a fault happen, now."""

    name = "fault"
    fault: str = Field(description="name of a fault of the laboratory, such as tec.delay")
    values: dict[str, float] = Field(default_factory=dict, description="what can be chosen of it, by name")
    duration: float | None = Field(default=None, description="laboratory time after which it ends, s")


class EndFault(RigRequest):
    """End a fault that goes on."""

    name = "end-fault"
    fault: str = Field(description="name of a fault of the laboratory")


class Schedule(RigRequest):
    """Let faults happen at instants that count from now."""

    name = "schedule"
    faults: tuple[ScheduledFault, ...] = Field(strict=False, description="as in a file of `bench run --faults`")


class Events(RigRequest):
    """Return the faults that have begun and ended."""

    name = "events"
    since: int = Field(default=0, ge=0, description="how many of the first to leave out")


class Operate(RigRequest):
    """Do by hand what a protocol's prompt asks for, such as to hang a load on a muscle."""

    name = "operate"
    task: str = Field(description="task of the operator")
    value: float = Field(description="its value, in the unit of the task")


class PlugIn(RigRequest):
    """End all faults of the line of an instrument."""

    name = "plug-in"
    instrument: str = Field(description="name of an instrument")


class EndWithConnection(Request):
    """Stop the server when this connection closes, so that it does not outlive the process that started it."""

    name = "end-with-connection"


class Stop(Request):
    """Stop the server."""

    name = "stop"


REQUESTS: dict[str, type[Request]] = {
    each.name: each
    for each in (
        Help, State, Time, Wait, Advance, InjectFault, EndFault, Schedule, Events, Operate, PlugIn, EndWithConnection,
        Stop,
    )
}  # fmt: skip


def parse_request(line: bytes) -> Request:
    """Return the request in a line.

    Raises ConfigurationError if it is none: names what is wrong and what is allowed.
    """
    try:
        content: Any = parse_json(line)
    except ValueError as error:
        raise ConfigurationError(f'not a line of JSON: {error}; expected such as {{"do": "help"}}') from None
    if not isinstance(content, dict) or not isinstance(content.get("do"), str):
        raise ConfigurationError(f'expected an object with a request, such as {{"do": "help"}}; {_known()}')
    name = content.pop("do")
    if name not in REQUESTS:
        raise ConfigurationError(f"there is no request {name!r}; {_known()}")
    try:
        return REQUESTS[name].model_validate(content)
    except ValidationError as error:
        raise ConfigurationError(
            "; ".join(f"{name}: {problem}" for problem in problems(error, REQUESTS[name]))
        ) from None
    except RecursionError:
        raise ConfigurationError(f"{name}: nested too deeply") from None


def _known() -> str:
    return f"there are: {', '.join(REQUESTS)}"
