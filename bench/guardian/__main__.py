"""The process: `python -m bench.guardian`, started by the bench with one end of the channel."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.attachment import attach
from bench.clock import Stopwatch, WallClock
from bench.guardian.channel import Channel, ChannelError, Message, to_message
from bench.guardian.process import Guardian
from bench.guardian.start import inherited
from bench.rig import Rig
from bench.rig_file import load_rig
from bench.safety import make_safe

_PATIENCE = 60.0
"""Time for the first message, s."""


def _open(hello: Message) -> Rig:
    """Connect the rig that the bench names.

    Raises
    ------
    ConfigurationError
        If the rig file is wrong.
    DeviceError
        If a device cannot be connected.
    """
    file = load_rig(hello["rig"], hello["overrides"])
    if hello["attach"] is None:
        return Rig(file, WallClock(), hello["seed"])
    attachment = attach(Path(hello["attach"]), file.name)
    return Rig(file.served_by(attachment), attachment.clock, hello["seed"])


def _describe(rig: Rig) -> dict[str, Any]:
    devices = {}
    for name, device in rig.description.devices.items():
        content = asdict(device)
        del content["kind"]
        devices[name] = content
    return {"devices": devices, "signals": [asdict(signal) for signal in rig.signals]}


def main() -> int:
    """Hold the rig that the bench names until its run has ended and every device is safe."""
    channel = Channel(inherited(sys.argv[1:]))
    waited = Stopwatch()
    try:
        received: list[Message] = []
        # It may come in pieces.
        while not received:
            if waited.seconds() > _PATIENCE:
                return 1
            if channel.wait(_PATIENCE):
                received = channel.receive()
        hello = received[0]
        try:
            rig = _open(hello)
        except Exception as error:
            channel.send({"n": hello["n"], "error": to_message(error)})
            return 1
    except ChannelError:
        return 1
    try:
        guardian = Guardian(channel, rig, hello["process"])
        guardian.begin(hello, _describe(rig))
        guardian.serve()
    except BaseException:
        # A defect; its lines may not be closed before the devices are safe.
        make_safe(rig.devices.values())
        raise
    finally:
        rig.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
