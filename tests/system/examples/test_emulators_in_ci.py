"""The example project, run as another project's CI would: its own folder, with pytest under xdist and unittest."""

import re
import shutil
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[3] / "examples" / "emulators_in_ci"
HEAVY = ("rerun", "matplotlib", "pyarrow")


@pytest.fixture
def project(tmp_path):
    return shutil.copytree(EXAMPLE, tmp_path / "project")


def commands():
    """What the workflow runs, beside the installation."""
    workflow = (EXAMPLE / ".github/workflows/tests.yml").read_text()
    return [line.split() for line in re.findall(r"- run: python (.*)", workflow) if "pip install" not in line]


@pytest.mark.parametrize(
    "command",
    [pytest.param(each, marks=pytest.mark.seeds if "--numprocesses" in each else []) for each in commands()],
    ids=" ".join,
)
def test_the_workflow_passes(project, finished_process, command):
    # A folder of the project that has the name of one of the bench's packages is not mistaken for it.
    (project / "drivers").mkdir()
    done = finished_process([sys.executable, *command], project, None)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 passed" in done.stdout or "OK" in done.stderr


def test_the_workflow_names_no_registry():
    assert "://" not in (EXAMPLE / ".github/workflows/tests.yml").read_text()
    assert len(commands()) == 2


def test_the_plugin_imports_nothing_heavy(tmp_path, finished_process):
    (tmp_path / "test_it.py").write_text(
        "import sys\n"
        "def test_it(emulated_rig):\n"
        "    emulated_rig('vo2')\n"
        f"    assert not {{*sys.modules}} & {{*{HEAVY!r}}}\n"
    )
    done = finished_process([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"], tmp_path, None)
    assert done.returncode == 0, done.stdout
