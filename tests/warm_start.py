"""Starts Python programs as forks of this process, which has imported the libraries: 30 ms, not two seconds.

Each request is a line of JSON on standard input: arguments of `python`, folder, environment, and files for standard
output and standard error. The answer is a line with the exit code.
"""

import atexit
import gc
import importlib
import json
import os
import runpy
import sys
import traceback
from pathlib import Path

from bench import registry

# Nothing that reads the width of the terminal or the entry points when it is imported.
LIBRARIES = (
    "matplotlib.figure",
    "numba",
    "pydantic",
    "pymodbus.client",
    "pytest",
    "rich.markdown",
    "rich.progress",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.sparse",
    "sqlite3",
    "bench.results.report",
    "bench.runs",
)


def begin(request):
    """Make this process what `python` is at its start."""
    files = [
        (os.devnull, os.O_RDONLY),
        *((path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC) for path in request["outputs"]),
    ]
    for number, (path, flags) in enumerate(files):
        opened = os.open(path, flags)
        os.dup2(opened, number)
        os.close(opened)
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.path[:0] = [str(Path.cwd()), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    importlib.invalidate_caches()
    registry.forget()


def carry_out(option, program, *rest):
    """Run `python -m` or `python -c`; return the exit code."""
    sys.argv = [option, *rest]
    try:
        if option == "-m":
            runpy.run_module(program, run_name="__main__", alter_sys=True)
        else:
            exec(compile(program, "<string>", "exec"), {"__name__": "__main__"})
    except SystemExit as stopped:
        if isinstance(stopped.code, str):
            print(stopped.code, file=sys.stderr)
            return 1
        return stopped.code or 0
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def main():
    """Fork for each request."""
    for name in LIBRARIES:
        importlib.import_module(name)
    # The first use of a kernel sets numba up.
    runpy.run_path(str(Path(__file__).with_name("compile_kernels.py")))["operators"]()
    # The pages of what is never collected stay shared.
    gc.freeze()
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if child == 0:
            begin(request)
            code = carry_out(*request["arguments"])
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
            # To take all libraries down would take as long as to import them.
            os._exit(code)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
