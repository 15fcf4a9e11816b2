"""Protocols for the heater."""

from bench.protocol import Dwell, Messages, Note, Phase, ProtocolParameters, Step, UntilSteady, parameter, protocol


class Stairs(ProtocolParameters):
    count: int = parameter(4, unit="1", low=1, high=100000, help="how many steps")
    dwell: float = parameter(2.0, unit="s", low=0, high=3600, help="hold", changeable=True)
    start: float = parameter(30.0, unit="°C", low=-50, high=500, help="first set-point")
    increment: float = parameter(5.0, unit="K", low=-50, high=50, help="from one step to the next")


@protocol(needs=("tec", "probe_temperature"))
def stairs(parameters: Stairs) -> Messages:
    """Climb."""
    yield Phase("climb")
    yield Note("climbing")
    for i in range(parameters.count):
        reading = yield Step(
            {"tec": parameters.start + i * parameters.increment}, Dwell(parameters.dwell), label="up"
        )
        yield Note(f"step {reading.step} at {reading['probe_temperature']:.3f} °C")


class Settle(ProtocolParameters):
    target: float = parameter(50.0, unit="°C", low=-50, high=500, help="where to")
    drift: float = parameter(0.02, unit="K/s", low=1e-9, help="allowed")
    timeout: float = parameter(120.0, unit="s", low=0, help="at most")
    minimum: float = parameter(0.0, unit="s", low=0, help="at least")
    signal: str = parameter("probe_temperature", unit="", help="which")


@protocol(needs=("tec",))
def settle(parameters: Settle) -> Messages:
    """Go there and settle."""
    yield Note("settling")
    yield Step(
        {"tec": parameters.target},
        UntilSteady(
            parameters.signal,
            drift=parameters.drift,
            noise=0.002,
            timeout=parameters.timeout,
            minimum=parameters.minimum,
        ),
    )


class Watcher:
    """An observer that remembers."""

    def __init__(self):
        self.ticks, self.steps, self.events = [], [], []

    def telemetry(self, t, step, values):
        self.ticks.append((t, step, tuple(values)))

    def step(self, record):
        self.steps.append(record)

    def event(self, event):
        self.events.append(event)
