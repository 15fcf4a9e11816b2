"""Starts Python programs as forks of this process, which has imported the libraries: 30 ms, not two seconds.

A request is a connection to the Unix socket that the first argument names: arguments of `python`, folder and
environment as a line of JSON, with the descriptors of standard output and standard error. The answer is the exit
code. It ends with its standard input.
"""

import atexit
import gc
import importlib
import json
import os
import runpy
import select
import socket
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


def receive(connection):
    """Return a request, and the descriptors that came with it."""
    content, descriptors, _, _ = socket.recv_fds(connection, 1 << 16, 2)
    while not content.endswith(b"\n"):
        content += connection.recv(1 << 16)
    return json.loads(content), descriptors


def begin(request, outputs):
    """Make this process what `python` is at its start."""
    for number, opened in enumerate([os.open(os.devnull, os.O_RDONLY), *outputs]):
        os.dup2(opened, number)
        os.close(opened)
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.path[:0] = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    if request["arguments"][0] == "-P":
        del request["arguments"][0]
    else:
        sys.path.insert(0, str(Path.cwd()))
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
    server = socket.socket(socket.AF_UNIX)
    server.bind(sys.argv[1])
    server.listen()
    print("ready", flush=True)
    while sys.stdin not in select.select([sys.stdin, server], [], [])[0]:
        connection, _ = server.accept()
        request, outputs = receive(connection)
        child = os.fork()
        if child == 0:
            server.close()
            connection.close()
            begin(request, outputs)
            code = carry_out(*request["arguments"])
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
            # To take all libraries down would take as long as to import them.
            os._exit(code)
        for each in outputs:
            os.close(each)
        _, status = os.waitpid(child, 0)
        connection.sendall(b"%d" % os.waitstatus_to_exitcode(status))
        connection.close()


if __name__ == "__main__":
    main()
