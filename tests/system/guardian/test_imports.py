"""What a guardian loads."""

import subprocess
import sys

from cases import cases

HEAVY = ("numba", "scipy", "rerun", "matplotlib", "pandas", "pyarrow")


@cases("rig", ["vo2-hardware", "sma-hardware", "hybrid-hardware"])
def test_a_guardian_of_hardware_loads_nothing_heavy(rig):
    """It has to start fast, stay small, and do no computing beside its lines."""
    code = (
        "import sys\n"
        "import bench.execution.guardian.__main__\n"
        "from bench.rig.file import load_rig\n"
        f"load_rig({rig!r})\n"
        f"print(*sorted(set({HEAVY!r}) & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
