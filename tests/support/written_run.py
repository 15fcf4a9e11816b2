"""A run that was written and not carried out: names as hostile as can be, phases, an interlock, late samples."""

import numpy as np

from bench.devices import Settled, Signal
from bench.record import FILE_NAME, Event, Journal, Lateness, StepRecord

HOSTILE = "<script>document.title='taken'</script><img src=x onerror=alert(1)>"
STEPS = 1000
SIGNALS = (
    Signal("plate_setpoint", "°C", "set-point", 3),
    Signal("plate", "°C", "temperature", 3),
    Signal("tip", "m", "position", 9),
    Signal("lateness", "s", "lateness", 6),
)
META = {
    "run": f"run-{HOSTILE}",
    "rig": "plate",
    "rig_title": f"A plate {HOSTILE}",
    "rig_file": "",
    "rig_content": {
        "interlocks": [
            {"signal": "plate", "high": 100.0, "seconds": 2.0},
            {"signal": "tip", "stale": 60.0, "level": "warn"},
        ]
    },
    "protocol": "loops",
    "protocol_summary": "Drive the plate through loops",
    "parameters": {"high": 80.0, "remark": HOSTILE},
    "changed": {"high": 80.0},
    "overrides": {"emulation.noise": "0.1"},
    "slots": {"drive": {"device": "plate", "signal": "plate"}},
    "seed": 3,
    "clock": "virtual",
    "epoch": "2000-01-01T00:00:00+00:00",
    "devices": {"plate": "Maker TEC-1, serial number 7, firmware 1"},
    "calibration": {"plate": {"calibrated": "2025-03-01", "calibration_due": "2026-03-01", "gain": 2.5, "port": "x"}},
    "limits": {"plate": [15.0, 95.0]},
    "operator": HOSTILE,
    "command": ["/usr/bin/bench", "run", "loops", "--set", f"remark={HOSTILE}"],
    "plan": {"steps": STEPS, "seconds": 8.0 * STEPS},
    "git": "0123456789ab",
    "packages": {"numpy": "2.0"},
    "host": {"name": "lab", "system": "Linux", "python": "3.11", "started": "2026-04-01T10:00:00+00:00"},
    "dashboard": {"input": "plate", "output": "tip"},
}


def measured(steps):
    """Return inputs of decaying loops, and outputs with hysteresis and noise, m."""
    t = np.linspace(0.0, 40.0 * np.pi, steps)
    inputs = 50.0 + 30.0 * np.sin(t) * np.exp(-t / 100.0)
    branch = np.sign(np.cos(t)) * 6.0 * np.exp(-t / 100.0)
    noise = np.random.default_rng(0).normal(0.0, 2e-8, steps)
    return inputs, 1e-6 * (np.tanh((inputs - 52.0 - branch) / 12.0) + 1.0) * 40.0 + noise


def write_run(folder, steps=STEPS, finished=True, meta=META, signals=SIGNALS):
    folder.mkdir()
    journal = Journal(folder / FILE_NAME, signals, meta)
    journal.event(Event(0.0, "INFO", "phase", f"rise {HOSTILE}"))
    inputs, outputs = measured(max(steps, 2))
    for i in range(steps):
        if i == steps // 2:
            journal.event(Event(8.0 * i, "INFO", "phase", "decay"))
            journal.event(Event(8.0 * i, "WARN", "interlock", "tip = 1e-05 m stands still"))
        values = (inputs[i], inputs[i] + 0.01, outputs[i], 1e-4 * (i % 7))
        journal.telemetry(8.0 * i + 4.0, i, values)
        journal.step(StepRecord(i, 8.0 * i, 8.0 * i + 8.0, "loops", "", Settled.DWELL, {"plate": inputs[i]}, values))
    if finished:
        late = Lateness(100.0, left_out=2)
        late.add(3e-4, 17)
        journal.finish(
            status="completed",
            reason="",
            finished=8.0 * steps,
            safe_state={"plate": "safe"},
            lateness={"hold": late.to_json()},
        )
    journal.close()
    return folder
