"""Has `warm_start` start Python programs: as a command in the place of `bench` or `python`, or as `WarmPopen`.

    python warm_client.py SOCKET bench|python ARGUMENT...

Only what takes no time to load is imported here.
"""

import json
import os
import socket
import sys


def start_warm(path, request, descriptors):
    """Start `python` with arguments; return its process id, and the connection from which `exit_code` reads.

    Parameters
    ----------
    path : path-like
        The socket of `warm_start`.
    request : dict
        `arguments`, `folder`, `environment`, and perhaps `new_session` and `group`, as for `subprocess.Popen`;
        perhaps `parent`, the number that `os.getppid` gives, and `passed`, descriptors that keep their numbers.
    descriptors : list of int
        Descriptors of standard input, output and error, and those of `passed`.
    """
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(str(path))
    content = json.dumps(request).encode() + b"\n"
    sent = socket.send_fds(connection, [content], descriptors)
    connection.sendall(content[sent:])
    return int(connection.recv(16)), connection


def exit_code(connection):
    """Wait for the end of a process; return its exit code, or the negative number of the signal that ended it."""
    return int(connection.recv(16))


def main():
    """Do as the command whose name is given."""
    path, name, *arguments = sys.argv[1:]
    if name == "bench":
        # A command that is installed does not look for modules in the working folder.
        arguments = ["-P", "-m", "bench", *arguments]
    elif arguments[:1] != ["-m"]:
        os.execv(sys.executable, [sys.executable, *arguments])
    request = {"arguments": arguments, "folder": os.getcwd(), "environment": dict(os.environ)}  # noqa: PTH109
    sys.exit(exit_code(start_warm(path, request, [0, 1, 2])[1]) & 0xFF)


if __name__ == "__main__":
    main()
