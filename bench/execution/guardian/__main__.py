"""The process: `python -m bench.execution.guardian`, started by the bench with one end of the channel."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.base import Clock, ConfigurationError, Stopwatch, WallClock
from bench.execution.guardian.channel import Channel, ChannelError, Message, to_message
from bench.execution.guardian.process import Guardian
from bench.execution.guardian.rescuer import Rescuer
from bench.execution.guardian.start import inherited
from bench.rig import SAFE, Holder, Locks, Rig, attach, load_rig, make_safe, port_of

_PATIENCE = 60.0
"""Time for the first message, s."""


def _open(hello: Message, stack: ExitStack) -> tuple[Rig, Rescuer]:
    """Lock and connect the rig that the bench names; return it and what makes it safe if this process cannot.

    Nothing is sent to an instrument that another bench uses. Raises ConfigurationError if the rig file is wrong, or
    another bench uses one of the lines or instruments, and DeviceError if a device cannot be connected.
    """
    file = load_rig(hello["rig"], hello["overrides"])
    if repr(file.content) != hello["content"]:
        raise ConfigurationError(f"{file.path} was changed while the run was prepared; start the run again")
    clock: Clock
    locks = stack.enter_context(Locks(Holder.of_this_process(file.name, hello["doing"], hello["process"])))
    if hello["attach"] is not None:
        attachment = attach(Path(hello["attach"]), file.name)
        ports = attachment.open()
        locks.take_lines(port_of(entry.wired(ports, file.path)) for entry in file.devices)
        file, clock = file.served_by(attachment), attachment.clock
    else:
        locks.take_lines(port_of(entry.settings) for entry in file.devices)
        clock = WallClock()
    rescuer = Rescuer({key: hello[key] for key in ("rig", "overrides", "attach", "report", "process")})
    try:
        rig = Rig(file, clock, hello["seed"])
        stack.callback(rig.close)
        # Served instruments of several laboratories may have the same serial numbers.
        if hello["attach"] is None:
            for device in rig.devices.values():
                locks.take_instrument(device.identity)
    except BaseException:
        rescuer.release()
        raise
    return rig, rescuer


def _describe(rig: Rig) -> dict[str, Any]:
    devices = {}
    for name, device in rig.description.devices.items():
        content = asdict(device)
        del content["kind"]
        devices[name] = content
    return {"devices": devices, "signals": [asdict(signal) for signal in rig.signals]}


def _leave(failed: threading.ExceptHookArgs) -> None:
    """End this process, as the safe state may need the thread that has failed; the rescuer takes over."""
    threading.__excepthook__(failed)
    os._exit(1)


def main() -> int:
    """Hold the rig that the bench names until its run has ended and every device is safe; tell if it hung or died."""
    threading.excepthook = _leave
    channel = Channel(inherited(sys.argv[1:]))
    with ExitStack() as stack:
        try:
            hello = _first_message(channel)
            if hello is None:
                return 1
            try:
                rig, rescuer = _open(hello, stack)
            except Exception as error:
                channel.send({"n": hello["n"], "error": to_message(error)})
                return 1
        except ChannelError:
            return 1
        try:
            guardian = Guardian(channel, rig, hello["process"], rescuer)
            guardian.begin(hello, _describe(rig))
            guardian.serve()
        except BaseException:
            # A defect; its lines may not be closed before the devices are safe.
            states = make_safe(rig.devices.values())
            if all(state == SAFE for state in states.values()):
                rescuer.release()
            raise
        rescuer.release()
    # Whoever takes the rig next does not wait for a mail server.
    guardian.finish()
    return 0


def _first_message(channel: Channel) -> Message | None:
    """Return the first message, which may come in pieces; None if it does not come."""
    waited = Stopwatch()
    while waited.seconds() < _PATIENCE:
        if channel.wait(_PATIENCE) and (received := channel.receive()):
            return received[0]
    return None


if __name__ == "__main__":
    sys.exit(main())
