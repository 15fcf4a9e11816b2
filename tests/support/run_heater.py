"""A command like `bench run`, for the heater: run_heater.py FOLDER RIG CLOCK PROTOCOL [NAME=VALUE…]."""

import sys
from pathlib import Path

from bench.base import PlainConsole
from bench.execution import Run, carry_out
from bench.protocol import find_protocol


def main() -> int:
    folder, rig, clock, protocol, *settings = sys.argv[1:]
    definition = find_protocol(protocol)
    run = Run(
        protocol=definition,
        settings=dict(setting.split("=") for setting in settings),
        rig=rig,
        folder=Path(folder),
        clock=clock,
        recording=False,
        # What is sent to the process is meant for the run.
        rehearse=False,
    )
    outcome = carry_out(run, PlainConsole(width=200)).outcome
    print("OUTCOME", outcome.status, outcome.steps, outcome.is_safe, outcome.reason, flush=True)
    return 0 if outcome.error is None else getattr(outcome.error, "exit_code", 1)


if __name__ == "__main__":
    sys.exit(main())
