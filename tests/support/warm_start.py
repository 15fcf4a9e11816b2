"""Starts Python programs as forks of this process, which has imported the libraries: 30 ms, not two seconds.

A request is a connection to the Unix socket that the first argument names: a line of JSON as `warm_client.start_warm`
describes it, with the descriptors of the standard streams. The processes that a program starts are forks as well.
The answers are the process id, and at its end the exit code. The server goes on in the background when it is ready,
and ends with its standard input.
"""

import atexit
import fcntl
import gc
import importlib
import json
import os
import runpy
import select
import socket
import subprocess
import sys
import traceback
from contextlib import suppress
from pathlib import Path

from bench.base import kernels_of, registry
from bench.protocol import packaged_protocols

# Nothing that reads the width of the terminal or the entry points when it is imported.
LIBRARIES = (
    "filterpy.kalman",
    "matplotlib.figure",
    "numba",
    # Rerun loads it.
    "pandas",
    "pydantic",
    "pymodbus.client",
    "pytest",
    "rich.markdown",
    "rich.progress",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.sparse",
    "scipy.special",
    "sqlite3",
    "typer.main",
    "bench.control.catalogue",
    "bench.dashboard",
    "bench.analysis.report.run_report",
    "bench.execution.run",
)


def receive(connection):
    """Return a request, and the descriptors that came with it."""
    content, descriptors, _, _ = socket.recv_fds(connection, 1 << 16, 16)
    while not content.endswith(b"\n"):
        content += connection.recv(1 << 16)
    return json.loads(content), descriptors


def begin(request, streams):
    """Make this process what `python` is at its start."""
    # First out of the way of those numbers.
    moved = [fcntl.fcntl(each, fcntl.F_DUPFD, 1000) for each in streams]
    for each in streams:
        os.close(each)
    for number, opened in zip([0, 1, 2, *request.get("passed", ())], moved, strict=True):
        os.dup2(opened, number)
        os.close(opened)
    if "parent" in request:
        take_parent(request["parent"])
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.path[:0] = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    program = request["arguments"]
    if program[0] == "-P":
        del program[0]
    elif program[0] in ("-m", "-c"):
        sys.path.insert(0, str(Path.cwd()))
    else:
        sys.path.insert(0, str(Path(program[0]).parent))
    importlib.invalidate_caches()
    registry.forget()


def take_parent(number):
    """Let a process be the parent of this one for `os.getppid`, as long as it lives."""
    descriptor, getppid = os.pidfd_open(number), os.getppid
    os.register_at_fork(after_in_child=lambda: setattr(os, "getppid", getppid))
    os.getppid = lambda: 1 if select.select([descriptor], [], [], 0)[0] else number


def carry_out(option, *rest):
    """Run `python -m`, `python -c` or a script; return the exit code."""
    try:
        if option not in ("-m", "-c"):
            sys.argv = [option, *rest]
            runpy.run_path(option, run_name="__main__")
            return 0
        program, *rest = rest
        sys.argv = [option, *rest]
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


def start(request, streams, sockets, descriptors):
    """Fork for a request; return the process id. The new process leaves the sockets and descriptors of this one."""
    waiting, grouped = os.pipe()
    process = os.fork()
    if process == 0:
        code = 1
        try:
            if request.get("new_session"):
                os.setsid()
            if request.get("group", -1) >= 0:
                os.setpgid(0, request["group"])
            os.close(waiting)
            os.close(grouped)
            for each in sockets:
                each.close()
            for each in descriptors:
                os.close(each)
            begin(request, streams)
            code = carry_out(*request["arguments"])
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            # To take all libraries down would take as long as to import them.
            os._exit(code)
    for each in streams:
        os.close(each)
    # Whoever asks for its group, to end it with all that it started, would be given that of this process before.
    os.close(grouped)
    os.read(waiting, 1)
    os.close(waiting)
    return process


def main():
    """Fork for each request."""
    for name in LIBRARIES:
        importlib.import_module(name)
    # Otherwise each process would load those that it takes.
    packages = runpy.run_path(str(Path(__file__).with_name("kernels.py")))["OWN"]
    for kernel in kernels_of(packages):
        kernel.prepare()
    packaged_protocols()
    sys.path.append(str(Path(__file__).parent))
    from warm_popen import WarmPopen

    sys.path.pop()
    WarmPopen.server = sys.argv[1]
    subprocess.Popen = WarmPopen
    # The pages of what is never collected stay shared.
    gc.freeze()
    server = socket.socket(socket.AF_UNIX)
    server.bind(sys.argv[1])
    server.listen()
    if os.fork():
        # The end of this process says that the other one is ready.
        os._exit(0)
    running = {}
    while sys.stdin not in (ready := select.select([sys.stdin, server, *running], [], [])[0]):
        for each in ready:
            if each is server:
                connection, _ = server.accept()
                request, streams = receive(connection)
                beside = [each for _, each in running.values()]
                process = start(request, streams, [server, connection, *beside], running)
                connection.sendall(b"%d" % process)
                running[os.pidfd_open(process)] = process, connection
            else:
                process, connection = running.pop(each)
                os.close(each)
                _, status = os.waitpid(process, 0)
                # Nobody may have waited for it.
                with suppress(OSError), connection:
                    connection.sendall(b"%d" % os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    main()
