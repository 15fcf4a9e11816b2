"""Nine hours of laboratory time at the wire level, beside the time that a laboratory would take."""

import json
import subprocess
import sys

import pytest

CAMPAIGN = """
import json, resource, sys
from pathlib import Path
import bench.cli, bench.execution, bench.dashboard, bench.identification, drivers.labjack_t7, drivers.meerstetter
import numba, rigs.vo2.laboratory
from bench.protocol import find_protocol
from bench.execution import Run, carry_out
from rich.console import Console

def megabytes():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

imported = megabytes()
protocol = find_protocol("damped-oscillation")
parameters = protocol.parse({"increment": "0.3"})
run = Run(protocol, parameters, "vo2", Path(sys.argv[1]), clock="virtual", live=True)
result = carry_out(run, Console(stderr=True))
print(json.dumps({
    "steps": result.outcome.steps,
    "laboratory_hours": result.outcome.laboratory_seconds / 3600,
    "wall_seconds": result.wall_seconds,
    "ratio": result.time_ratio,
    "megabytes_beyond_imports": megabytes() - imported,
}))
"""


@pytest.mark.benchmark
def test_characterization_beside_laboratory_time(tmp_path, capsys):
    """About 4000 steps of 8 s, with telemetry, journal, recording and live view on."""
    done = subprocess.run(
        [sys.executable, "-c", CAMPAIGN, str(tmp_path)], check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["steps"] > 3900
    with capsys.disabled():
        print(
            f"\n{result['steps']} steps, {result['laboratory_hours']:.1f} h of laboratory time in "
            f"{result['wall_seconds']:.1f} s: {result['ratio']:.0f} times as fast; "
            f"{result['megabytes_beyond_imports']:.0f} MB beyond the imports"
        )
