"""What a guardian loads."""

import subprocess
import sys

HEAVY = ("numba", "scipy", "rerun", "matplotlib", "pandas", "pyarrow")


def test_a_guardian_of_hardware_loads_nothing_heavy():
    """It has to start fast, stay small, and do no computing beside its lines."""
    code = (
        "import sys\n"
        "import bench.execution.guardian.__main__\n"
        "from bench.rig.file import load_rig\n"
        "for name in ('vo2', 'sma', 'hybrid'):\n"
        "    load_rig(f'{name}-hardware')\n"
        f"print(*sorted(set({HEAVY!r}) & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
