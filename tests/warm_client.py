"""A command in the place of `bench` or `python`: has `warm_start` start it.

    python warm_client.py SOCKET bench|python ARGUMENT...

Only what takes no time to load is imported here.
"""

import json
import os
import socket
import sys


def start_warm(path, arguments, folder, environment, outputs):
    """Start `python` with arguments, and wait for its end; return the exit code.

    Parameters
    ----------
    path : path-like
        The socket of `warm_start`.
    outputs : list of int
        Descriptors of standard output and standard error.
    """
    request = {"arguments": arguments, "folder": folder, "environment": environment}
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(path))
        content = json.dumps(request).encode() + b"\n"
        sent = socket.send_fds(connection, [content], outputs)
        connection.sendall(content[sent:])
        return int(connection.recv(16))


def main():
    """Do as the command whose name is given."""
    path, name, *arguments = sys.argv[1:]
    if name == "bench":
        # A command that is installed does not look for modules in the working folder.
        arguments = ["-P", "-m", "bench", *arguments]
    elif arguments[:1] != ["-m"]:
        os.execv(sys.executable, [sys.executable, *arguments])
    sys.exit(start_warm(path, arguments, os.getcwd(), dict(os.environ), [1, 2]) & 0xFF)  # noqa: PTH109


if __name__ == "__main__":
    main()
