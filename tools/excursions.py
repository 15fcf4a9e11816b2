"""A short excursion of every actuator of a rig, with readings all along."""

from bench.protocol import Dwell, ProtocolParameters, Step, protocol

COUNT, DWELL = 16, 2.0


def excursion(*ways):
    """Yield steps; each way is a device and the set-points that it goes through, over and over."""
    for i in range(COUNT):
        yield Step({device: points[i % len(points)] for device, points in ways}, Dwell(DWELL))


@protocol(needs=("tec",))
def excursion_vo2(parameters: ProtocolParameters):
    """Heat and cool the plate."""
    yield from excursion(("tec", (30.0, 40.0, 52.0, 60.0, 45.0, 35.0)))


@protocol(needs=("supply", "stage", "fan"))
def excursion_sma(parameters: ProtocolParameters):
    """Heat the wire, move the stage, and blow."""
    yield from excursion(
        ("supply", (0.5, 1.5, 2.5, 2.0, 1.0)), ("stage", (0.0, 2e-3, 4e-3, -2e-3)), ("fan", (0.0, 1.0, 1.0))
    )


@protocol(needs=("tec", "piezo"))
def excursion_hybrid(parameters: ProtocolParameters):
    """Heat the base, and drive the piezo."""
    yield from excursion(("tec", (0.02, 0.05, 0.08, -0.03)), ("piezo", (5.0, 20.0, -15.0, 30.0, -30.0)))
