"""What one estimated offset of a session is worth, on emulated sessions of the VO2 rig. Prints a table."""

import numpy as np
import pytest

import bench
from bench.identification import identify, measure_errors, recalibrate

pytestmark = pytest.mark.benchmark

ROWS = 120
SESSION_OFFSET = 0.2  # K


def test_validation_of_another_session(tmp_path):
    found = {"as it is": [], "offset": [], "input-offset": []}
    for seed in range(6):
        sign = 1.0 if seed % 2 == 0 else -1.0
        first = bench.run("damped-oscillation", "vo2", out=tmp_path, seed=seed).readings
        second = bench.run(
            "random-validation", "vo2", out=tmp_path, seed=seed,
            overrides={"emulation.session_offset": str(sign * SESSION_OFFSET)},
        ).readings  # fmt: skip
        model = identify(
            "preisach-nonmonotonic", first["tec_temperature"], first["curvature"], plane=(30.0, 70.0), reference=20.0
        ).model
        inputs, outputs = second["tec_temperature"], second["curvature"]
        for kind, rows in found.items():
            predicted = model.evaluate(inputs)
            if kind != "as it is":
                predicted = recalibrate(model, inputs, outputs, [kind], rows=ROWS).predict(model, inputs)
            errors = measure_errors(outputs[ROWS:], predicted[ROWS:])
            rows.append((errors.maximum, errors.rms))
    medians = {kind: np.median(rows, axis=0) for kind, rows in found.items()}
    print(f"\nrows after the first {ROWS}, {SESSION_OFFSET} K, six seeds, medians in 1/m\n{'':14}  max   RMS")
    for kind, (greatest, rms) in medians.items():
        print(f"{kind:14} {greatest:5.1f} {rms:5.1f}")
    assert medians["input-offset"][1] < 0.5 * medians["as it is"][1]
    assert medians["input-offset"][0] < 0.6 * medians["as it is"][0]
