"""Writes steps without end, and prints the number of each once the journal has taken it."""

import sys
from pathlib import Path

from bench.devices import Settled, Signal
from bench.record import Journal, StepRecord

journal = Journal(Path(sys.argv[1]), (Signal("a", "m", "a"), Signal("b", "m", "b")), {})
step = 0
while True:
    value = step * 0.1
    journal.telemetry(value, step, (value, -value))
    journal.step(StepRecord(step, value, value, "", "", Settled.DWELL, {"tec": value}, (value, -value)))
    print(step, flush=True)
    step += 1
