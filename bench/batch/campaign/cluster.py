"""A campaign over a cluster of dask.distributed: tasks go out with their files, and their folders come back.

What arrives from a scheduler is unpickled, so that a connection is either encrypted and authenticated (`tls://`, with
the certificates of dask's own configuration, `distributed.comm.tls`) or stays on this machine.
"""

from __future__ import annotations

import io
import ipaddress
import sys
import tarfile
import tempfile
import threading
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any, Self

from rich.console import Console

from bench.base import ConfigurationError, DataError, TasksDisplay, needed_for, registry
from bench.batch.campaign.sources import code_digest, files_of
from bench.batch.campaign.tasks import UNFINISHED, CampaignTask, Done

_CONNECTING = 30
"""Wall-clock time within which a scheduler has to answer, s."""
_ONE_AT_A_TIME = threading.Lock()
"""A worker of dask may have several threads, and a run has the process to itself."""


def check_address(address: str) -> None:
    """Check that a scheduler may be trusted with what is unpickled.

    Raises ConfigurationError unless it is reached by TLS, or by TCP on the loopback interface.
    """
    scheme, separator, rest = address.rpartition("://")
    host = rest.rpartition(":")[0].strip("[]")
    if scheme == "tls" and host:
        return
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if scheme not in ("tcp", "") or (separator and not scheme) or not loopback:
        raise ConfigurationError(
            f"--scheduler {address}: what comes from a scheduler is unpickled, which runs any code in it; expected "
            "tls://HOST:PORT, with the certificates in dask's configuration (distributed.comm.tls), or "
            "tcp://127.0.0.1:PORT"
        )


class ClusterExecutor:
    """Carries tasks out on the workers of a cluster; a context manager.

    Parameters
    ----------
    address : str
        Of the scheduler: `tls://HOST:PORT`, or `tcp://127.0.0.1:PORT`.
    campaign : Path
        Folder of the campaign.
    console : Console
        Where to draw the progress.

    Raises
    ------
    ConfigurationError
        If the address is neither, nobody answers, or dask.distributed is not installed.
    """

    def __init__(self, address: str, campaign: Path, console: Console) -> None:
        check_address(address)
        with needed_for("--scheduler", "cluster"):
            import distributed

            library: Any = distributed
        try:
            # Security() takes the certificates of dask's configuration.
            security = library.Security() if address.startswith("tls://") else None
            self._client = library.Client(address, security=security, timeout=_CONNECTING, set_as_default=False)
        except (OSError, TimeoutError, TypeError, ValueError) as error:
            raise ConfigurationError(f"--scheduler {address}: {type(error).__name__}: {error}") from None
        self._completed = library.as_completed([], loop=self._client.loop, raise_errors=False)
        self._campaign = campaign
        self._tasks: dict[str, CampaignTask] = {}
        self._display = TasksDisplay(console, f"tasks at {address}")

    def __enter__(self) -> Self:
        self._display.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._display.stop()
        self._client.cancel([*self._completed.futures])
        self._client.close()

    def submit(self, task: CampaignTask) -> None:
        """Have a task carried out on any worker; the tasks of a worker that dies are done again."""
        files = list(enumerate(task.files.items()))
        places = {str(path): f"files/{number}/{path.name}" for number, (path, _) in files}
        entries = (
            (file, f"files/{number}/{file.name}")
            for number, (path, beside) in files
            for file in files_of(path, beside)
        )
        needs = ((self._campaign / name, f"campaign/{name}") for name in task.needs)
        content = packed(chain(needs, entries))
        future = self._client.submit(
            carry_out_there, task, code_digest(), places, content, key=f"{task.name}-{task.identity}", pure=False
        )
        self._tasks[future.key] = task
        self._completed.add(future)
        self._display.add()

    def next_done(self) -> tuple[CampaignTask, Done]:
        """Wait for a task, and put its folder where it belongs."""
        future = next(self._completed)
        task = self._tasks.pop(future.key)
        self._display.end()
        if future.status != "finished":
            return task, task.failed(future.exception())
        done, content = future.result()
        target, scratch = self._campaign / task.name, self._campaign / UNFINISHED / task.scratch
        unpack(content, scratch)
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch.replace(target)
        future.release()
        return task, done


def carry_out_there(task: CampaignTask, code: str, places: dict[str, str], content: bytes) -> tuple[Done, bytes]:
    """Carry a task out in a folder of its own; return what it left, and its folder, packed.

    `code` is the hash of the programs with which it is meant to be carried out; `content` holds all that it reads,
    its files in these places by their path.
    """
    if code_digest() != code:
        raise DataError("the worker has another version of the bench, or of a library, than the campaign")
    with _ONE_AT_A_TIME, tempfile.TemporaryDirectory(prefix="bench-campaign-") as name:
        scratch = Path(name)
        unpack(content, scratch)
        try:
            moved = task.moved({path: str(scratch / place) for path, place in places.items()})
            done = moved.carry_out(scratch / "campaign")
        finally:
            _forget(scratch)
        return done, packed([(scratch / "campaign" / task.name, ".")])


def packed(entries: Iterable[tuple[Path, str]]) -> bytes:
    """Return files and folders as one archive, each under a name; raises DataError if one cannot be read."""
    buffer = io.BytesIO()
    try:
        with tarfile.open(fileobj=buffer, mode="w") as archive:
            for path, name in entries:
                archive.add(path, arcname=name)
    except OSError as error:
        raise DataError(f"{error.filename} cannot be read: {error.strerror}") from None
    return buffer.getvalue()


def unpack(content: bytes, folder: Path) -> None:
    """Write what `packed` has returned into a folder; nothing can be written outside of it."""
    folder.mkdir(parents=True, exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        archive.extractall(folder, filter="data")


def _forget(folder: Path) -> None:
    """Forget the modules that were imported from a folder, as the next task may bring others of the same name."""
    registry.forget_beside(folder)
    for name, module in list(sys.modules.items()):
        if (getattr(module, "__file__", None) or "").startswith(str(folder)):
            del sys.modules[name]
