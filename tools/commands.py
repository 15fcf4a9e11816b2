"""Commands of the bench in this process, or in one of their own, and how they ended."""

import contextlib
import io
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

in_a_process = False
"""Whether the next commands are carried out in a process of their own as well, and have to end alike."""


READING = ("list", "predict", "runs", "run", "study")
"""Commands that may be carried out twice, but for these of the group `runs`."""
WRITING = ("import", "repair")


CODES = (*range(11), 130)
"""Exit codes that the documents name."""

_OF_A_LIBRARY = re.compile(r"\.py:\d+: \w*Warning|^Exception ignored", re.MULTILINE)
"""What Python prints of a warning, or of an exception that nobody takes."""


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit code, standard output and standard error."""

    code: int
    out: str
    err: str


def call(*words: object) -> Ended:
    """Carry a command out in this process; what is no end of a command escapes."""
    from bench.cli import main

    # A second command may find what the first has written.
    words_of_process = [*words] if in_a_process and words[0] in READING and words[1] not in WRITING else None
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(word) for word in words])
        except SystemExit as ended:
            code = ended.code or 0
    ended = checked(Ended(int(code), out.getvalue(), err.getvalue()))
    if words_of_process is not None and (other := call_process(*words_of_process)).code != ended.code:
        raise UnclearError(f"exit code {ended.code} in this process, {other.code} in one of its own: {other.err}")
    return ended


def call_process(*words: object) -> Ended:
    """Carry a command out in a process of its own."""
    command = [sys.executable, "-P", "-m", "bench", *map(str, words)]
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path.strip(os.pathsep)}
    ended = subprocess.run(command, capture_output=True, check=False, env=environment, stdin=subprocess.DEVNULL)
    return checked(
        Ended(ended.returncode, ended.stdout.decode("utf-8", "replace"), ended.stderr.decode("utf-8", "replace"))
    )


class UnclearError(Exception):
    """A command ended without a clear answer."""


def checked(ended: Ended) -> Ended:
    """Return how a command ended; raise UnclearError if that is a traceback, or an error that says nothing."""
    if "Traceback" in ended.err or "Traceback" in ended.out:
        raise UnclearError(ended.err[-2000:])
    if _OF_A_LIBRARY.search(ended.err + ended.out):
        raise UnclearError(f"a warning of a library is printed: {ended.err[-2000:]}")
    if ended.code not in CODES or (ended.code and not (ended.err + ended.out).strip()):
        raise UnclearError(f"exit code {ended.code}, or without a message: {ended.err[-500:]}")
    if controls := {
        sign for sign in ended.out + ended.err if (sign < " " and sign not in "\n\t") or sign in "\x7f\u202e\u2066"
    }:
        raise UnclearError(f"characters that command a terminal are printed: {controls}")
    return ended
