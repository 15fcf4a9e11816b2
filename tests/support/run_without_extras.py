"""Run commands of the bench as if the libraries of its extras were not installed; print what became of them, as JSON.

Arguments: the commands, as JSON; the folder of their runs. `RUN` in a command stands for the first run in it.
"""

import importlib
import importlib.abc
import json
import pkgutil
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

EXTRAS = {
    "rerun",
    "rerun_cli",
    "rerun_bindings",
    "pyarrow",
    "matplotlib",
    "mpl_toolkits",
    "h5py",
    "matio",
    "nptdms",
    "pandas",
    "python_calamine",
}
PACKAGES = ("bench", "drivers", "sim_devices", "protocols", "rigs")


class NotInstalled(importlib.abc.MetaPathFinder):
    """Finds no library of the extras, and nobody behind it is asked."""

    def find_spec(self, name, *_):
        if name.partition(".")[0] in EXTRAS:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def import_everything():
    """Import each module but those of the dashboard; return the names."""
    names = []
    for package in PACKAGES:
        found = pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}.")
        names += [entry.name for entry in found if not entry.name.startswith(("bench.dashboard", "bench.__main__"))]
    for name in names:
        importlib.import_module(name)
    return names


def run(command):
    """Run one command; return exit code, standard output and standard error."""
    from bench.cli import main

    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        try:
            main(command)
        except SystemExit as stopped:
            code = stopped.code or 0
    return code, out.getvalue(), err.getvalue()


sys.meta_path.insert(0, NotInstalled())
results = []
for command in json.loads(sys.argv[1]):
    # The folder of a run has a name that only the run knows.
    (folder,) = [str(path) for path in Path(sys.argv[2]).glob("*")] or [""]
    results.append(run([argument.replace("RUN", folder) for argument in command]))
json.dump({"results": results, "imported": import_everything()}, sys.stdout)
