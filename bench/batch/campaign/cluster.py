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
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from rich.console import Console

from bench.base import ConfigurationError, DataError, TasksDisplay, needed_for, registry
from bench.batch.campaign.sources import code_digest, content_of
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


@dataclass(frozen=True)
class Parcel:
    """A task with all that it reads."""

    task: CampaignTask
    code: str  # hash of the programs with which it is meant to be carried out
    folders: dict[str, bytes]  # the folders of the tasks that it needs, packed, by name
    # By the path of a file that it reads, content by name, of those beside it as well.
    files: dict[str, dict[str, bytes]]


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
        files = {str(path): content_of(path, beside) for path, beside in task.files.items()}
        folders = {name: packed(self._campaign / name) for name in task.needs}
        parcel = Parcel(task, code_digest(), folders, files)
        future = self._client.submit(carry_out_parcel, parcel, key=f"{task.name}-{task.identity}", pure=False)
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
        if content:
            unpacked(content, self._campaign / UNFINISHED / task.scratch, self._campaign / task.name)
        future.release()
        return task, done


def carry_out_parcel(parcel: Parcel) -> tuple[Done, bytes]:
    """Carry a task out in a folder of its own; return what it left, and its folder, packed."""
    if code_digest() != parcel.code:
        raise DataError("the worker has another version of the bench, or of a library, than the campaign")
    with _ONE_AT_A_TIME, tempfile.TemporaryDirectory(prefix="bench-campaign-") as scratch:
        campaign = Path(scratch) / "campaign"
        for name, content in parcel.folders.items():
            unpacked(content, campaign / UNFINISHED / "needs", campaign / name)
        places: dict[str, str] = {}
        for number, (path, files) in enumerate(parcel.files.items()):
            folder = Path(scratch) / "files" / str(number)
            folder.mkdir(parents=True)
            for name, content in files.items():
                (folder / name).write_bytes(content)
            places[path] = str(folder / Path(path).name)
        try:
            done = parcel.task.moved(places).carry_out(campaign)
        finally:
            _forget(Path(scratch))
        folder = campaign / parcel.task.name
        return done, packed(folder) if folder.is_dir() else b""


def packed(folder: Path) -> bytes:
    """Return the files of a folder as one."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.add(folder, arcname=".")
    return buffer.getvalue()


def unpacked(content: bytes, scratch: Path, target: Path) -> None:
    """Make a folder of what `packed` has returned, by way of another one, so that it is there whole or not at all."""
    scratch.mkdir(parents=True, exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        # Nothing can be written outside of the folder.
        archive.extractall(scratch, filter="data")
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch.replace(target)


def _forget(folder: Path) -> None:
    """Forget the modules that were imported from a folder, as the next task may bring others of the same name."""
    registry.forget_beside(folder)
    for name, module in list(sys.modules.items()):
        if (getattr(module, "__file__", None) or "").startswith(str(folder)):
            del sys.modules[name]
