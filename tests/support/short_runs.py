"""Runs of a rig in virtual time, the messages of a protocol without a rig, and rigs that are refused."""

import io

import pytest
from rich.console import Console

from bench.base import ConfigurationError
from bench.execution import Run, carry_out
from bench.protocol import Note, Phase, Reading, find_protocol
from bench.rig import load_rig


def record_run(folder, protocol, rig, settings, overrides=None):
    """Carry a run out and return what has become of it."""
    run = Run(
        protocol=find_protocol(protocol), settings=settings, rig=rig, folder=folder,
        overrides=overrides or {}, seed=1, clock="virtual", recording=False,
    )  # fmt: skip
    return carry_out(run, Console(file=io.StringIO(), width=200))


def all_messages(messages, values):
    """All messages of a protocol whose readings are all the same."""
    found, reading = [], None
    while True:
        try:
            message = messages.send(reading)
        except StopIteration:
            return found
        found.append(message)
        reading = None if isinstance(message, Phase | Note) else Reading(len(found), 0.0, True, values)


def assert_refused(rig, key, value, words):
    """A wrong value of the emulation is one message."""
    with pytest.raises(ConfigurationError) as caught:
        load_rig(rig, {f"emulation.{key}": value})
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"{rig}.toml: emulation.{key}")
    assert words in line
