"""The pytest plugin with the fixture `emulated_rig`; it is loaded by pytest wherever the bench is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from sim_devices.serving.process import EmulatedRig


@pytest.fixture
def emulated_rig() -> Iterator[Callable[..., EmulatedRig]]:
    """Serve emulated rigs until the end of the test: `rig = emulated_rig("vo2")`.

    Options are those of `sim_devices.serving.process.serve`: `clock`, `seed`, `tcp`, `baud_time`, `overrides`,
    `faults`.
    """
    # Every run of pytest imports this module; only tests that use the fixture pay for the rest.
    from sim_devices.serving.process import serve

    with ExitStack() as stack:
        yield lambda rig, **options: stack.enter_context(serve(rig, **options))
