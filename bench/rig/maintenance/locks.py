"""One bench a line and an instrument: locks of the operating system, which end with the process that holds them.

A lock is a file in a folder that all users of the computer share, held by `flock` (on Windows by a locked byte). The
kernel frees it when its holder dies in any way, so a lock is never stale. Its text names the holder, for whoever is
refused. What other users put there is locked, but neither followed, nor written, nor believed. Different names of a
line are one lock: a link and the device node behind it, a host name and its address.

A computer does not see the locks of another one.
"""

from __future__ import annotations

import errno
import getpass
import hashlib
import ipaddress
import json
import os
import platform
import re
import socket
import stat
import sys
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

from bench.base import ConfigurationError, WallClock, parse_json, wall_time
from bench.devices import DriverSettings, Identity

EMULATED = "emulated://"
"""Scheme of the lines to instruments of an emulated laboratory; in this process they need no lock."""

JOIN = "+"
"""Between the names of instruments that are emulated on one line: `emulated://a+b`."""

ECHO = "echo"
"""Among these names, that of an adapter which hands back what is sent: `emulated://echo+a`."""

FOLDER_VARIABLE = "ACTUATOR_BENCH_LOCKS"
"""Variable of the environment that names another folder of the locks, for a container that has none of them."""

IN_FOLDER = "in-use.lock"
"""Name of the lock in a folder in which one process at a time works; it goes with its holder."""

_SHARED = Path("/run/lock"), Path("/tmp")  # noqa: S108 - that of all users is what is wanted
"""Folders for the locks: the first that everybody may use is taken. Filesystem Hierarchy Standard 3.0, 5.9."""
_EVERYBODY = 0o1777
_SAFELY = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_REMEDY = f"; name a folder of a local disk for the locks by the variable {FOLDER_VARIABLE}"
_ATTEMPTS = 20
"""How often a lock is opened that others remove or replace meanwhile."""
_TCP_PORT = 502
_WRITING = 0.1
"""Wall-clock time (s) that a holder is given to write its name after it has taken the lock."""
_LOCKED_BYTE = 1 << 30  # on Windows a locked byte cannot be read, so it lies beyond the text
_VISA_SOCKET = re.compile(r"TCPIP\d*::(?P<host>[^:]+|\[.+\])::(?P<port>\d+)::SOCKET", re.IGNORECASE)
_VISA_SERIAL = re.compile(r"ASRL(?P<node>.+?)(::INSTR)?", re.IGNORECASE)


class NoLockError(Exception):
    """A lock cannot be had, whoever else wants it."""


@dataclass(frozen=True)
class Holder:
    """Who holds a lock.

    Attributes
    ----------
    rig : str
        Name of the rig.
    doing : str
        Folder of the run, or the command.
    user, host : str
        Who started the process, and where.
    process : int
        Its number.
    since : str
        Date and time, with the offset to UTC.
    """

    rig: str
    doing: str
    user: str
    host: str
    process: int
    since: str

    @classmethod
    def of_this_process(cls, rig: str, doing: str, process: int | None = None) -> Holder:
        """Return what is known of this process; `process` is another one for which it holds the rig."""
        try:
            user = getpass.getuser()
        except (OSError, KeyError):
            user = "unknown"
        since = wall_time().astimezone().isoformat(sep=" ", timespec="seconds")
        return cls(rig, doing, user, platform.node(), process or os.getpid(), since)

    def __str__(self) -> str:
        """Return who it is, on one line."""
        return (
            f"{self.user} on {self.host}, process {self.process}, {self.doing} (rig {self.rig}), since {self.since}"
        )


class Locks:
    """The locks of one bench; a context manager that frees them.

    Parameters
    ----------
    holder : Holder
        Who takes them.
    """

    def __init__(self, holder: Holder) -> None:
        self._holder = holder
        self._taken: set[Path] = set()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free every lock."""
        self._taken.clear()
        self._stack.close()

    def take_lines(self, ports: Iterable[str]) -> None:
        """Take the lines to ports, all or none; call it before any of them is opened.

        Ports of instruments that are emulated in this process need none.

        Raises ConfigurationError if another process, or another bench of this one, holds one of them.
        """
        lines = {_path(name): f"line {port}" for port in ports for name in line_names(port)}
        self._take(lines, f"rig {self._holder.rig}")

    def take_instrument(self, identity: Identity) -> None:
        """Take an instrument, which another line may lead to as well; call it once it has been identified.

        One whose serial number tells it from no other is not locked. Nor may an emulated one be: each laboratory
        has the same serial numbers.

        Raises ConfigurationError if another process, or another bench of this one, holds it.
        """
        if identity.tells_serial_number:
            what = f"{identity.maker} {identity.model}, serial number {identity.serial_number.strip()}"
            self._take({_path(f"instrument {what}".lower()): what}, f"rig {self._holder.rig}")

    def take_folder(self, folder: Path) -> None:
        """Take a folder in which one process at a time works.

        By a lock of this computer and one in the folder itself, which a bench that has its locks elsewhere sees as
        well: one in a container, or on another computer, where the file system of the folder has locks.

        Raises ConfigurationError if another process holds it.
        """
        here = folder / IN_FOLDER
        self._take({_path(f"folder {folder.resolve()}"): "it", here: "it"}, f"folder {folder}", here)

    def _take(self, wanted: dict[Path, str], what: str, optional: Path | None = None) -> None:
        """Take locks, all or none; an optional one is left out if its file system cannot give it."""
        with ExitStack() as taken:
            # Two benches that ask in the same order cannot refuse each other.
            for path in sorted(wanted.keys() - self._taken):
                try:
                    file = _take_file(path)
                    if file is None:
                        # One that has just come has to write its name, and one that is about to go is not in the way.
                        WallClock().sleep(_WRITING)
                        file = _take_file(path)
                except NoLockError as error:
                    if path == optional:
                        continue
                    raise ConfigurationError(str(error)) from None
                if file is None:
                    raise ConfigurationError(
                        f"{what} is in use: {wanted[path]} is held by {_holder(path)}; wait for it, or end it"
                    )
                taken.callback(_free, path, file)
                _write(file, self._holder)
            self._taken |= wanted.keys()
            self._stack.push(taken.pop_all().__exit__)


def is_in_use(folder: Path) -> bool:
    """Return whether a process works in a folder, as `Locks.take_folder` says."""
    return any(_is_held(path) for path in (_path(f"folder {folder.resolve()}"), folder / IN_FOLDER))


def _is_held(path: Path) -> bool:
    if not os.path.lexists(path):
        return False
    try:
        file = _take_file(path)
    except NoLockError:
        return False
    if file is None:
        return True
    _free(path, file)
    return False


def port_of(settings: DriverSettings) -> str:
    """Return the port of a device in its settings; empty if they have none."""
    port = getattr(settings, "port", "")
    return port if isinstance(port, str) else ""


def line_names(port: str) -> tuple[str, ...]:
    """Return the names of a line, of which two ports share one if they are the same line; none in this process.

    Parameters
    ----------
    port : str
        Serial port, `socket://HOST:PORT`, `tcp://HOST:PORT`, `visa://RESOURCE` or a VISA resource alone.
    """
    if not port or port.startswith(EMULATED):
        return ()
    scheme, separator, rest = port.partition("://")
    address = rest if separator else port
    if serial := _VISA_SERIAL.fullmatch(address):
        address = serial["node"] if not serial["node"].isdigit() else f"COM{serial['node']}"
        return (_node_name(address),)
    if visa := _VISA_SOCKET.fullmatch(address):
        return _host_names(visa["host"], int(visa["port"]))
    if "::" in address and not address.startswith("["):
        return (f"line {address}".lower(),)
    if separator and scheme in ("tcp", "socket", "rfc2217"):
        host, _, number = address.partition("?")[0].rstrip("/").rpartition(":")
        if not number.isdigit():
            host, number = address, str(_TCP_PORT)
        return _host_names(host, int(number))
    return (_node_name(address.partition("?")[0]),)


def _node_name(node: str) -> str:
    # A port of Windows has no path, and may be named in capitals or not.
    return f"line {os.path.normcase(os.path.realpath(node))}" if os.path.lexists(node) else f"line {node}".lower()


def _host_names(host: str, port: int) -> tuple[str, ...]:
    """Return a name for each address of a host."""
    host = host.strip("[]")
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
    except OSError:
        # The line cannot be opened either.
        found = {host.lower()}
    return tuple(sorted({f"line {_canonical(address)} port {port}" for address in found}))


def _canonical(address: str) -> str:
    """Return one name for all addresses of this computer, and the shortest form of any other."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv6Address) and parsed.ipv4_mapped is not None:
        parsed = parsed.ipv4_mapped
    # Only an address of one's own can be bound.
    family = socket.AF_INET if parsed.version == 4 else socket.AF_INET6
    with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.bind((str(parsed), 0))
        return "localhost"
    return str(parsed)


def _folder() -> Path:
    """Return the folder of the locks, the same one for all users and sessions of this computer.

    That of the temporary files would be another one for each user of some systems. A folder of its own would belong
    to whoever came first, who could remove the locks of all others.
    """
    if chosen := os.environ.get(FOLDER_VARIABLE):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("PROGRAMDATA", r"C:\ProgramData"))
    return next((folder for folder in _SHARED if _is_shared(folder)), _SHARED[-1])


def _is_shared(folder: Path) -> bool:
    """Return whether everybody adds files to a folder, and nobody but root removes another's."""
    try:
        found = folder.stat()
    except OSError:
        return False
    return found.st_uid == 0 and stat.S_IMODE(found.st_mode) & _EVERYBODY == _EVERYBODY


def _path(name: str) -> Path:
    readable = re.sub(r"[^a-z0-9.]+", "-", name.lower())[-60:].strip("-.")
    return _folder() / f"actuator-bench-{readable}-{hashlib.sha256(name.encode()).hexdigest()[:12]}.lock"


def _take_file(path: Path) -> int | None:
    """Return the open file of a lock that was taken, or None if it is held."""
    for _ in range(_ATTEMPTS):
        file = _open(path)
        taken = False
        try:
            try:
                taken = _try_lock(file)
            except OSError as error:
                raise NoLockError(f"the lock {path} cannot be taken: {error.strerror}{_REMEDY}") from None
            if not taken:
                return None
            # Its last holder removed it, perhaps after it was opened here.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file), path.lstat()):
                    return file
            taken = False
        finally:
            if not taken:
                os.close(file)
    raise NoLockError(f"the lock {path} cannot be taken: it is replaced again and again")


def _open(path: Path) -> int:
    """Open the file of a lock; it is closed in programs that this process starts.

    The folder is everybody's: a link or a pipe of another user is not followed, and a file of another user is locked
    but not written, see `_write`.
    """
    for _ in range(_ATTEMPTS):
        try:
            # Without O_CREAT where it is there: Linux may refuse that for a file of another user in such a folder.
            with suppress(FileNotFoundError):
                return _checked(os.open(path, (os.O_RDWR if _is_writable(path.lstat()) else os.O_RDONLY) | _SAFELY))
            with suppress(FileExistsError):
                return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
        except OSError as error:
            why = "it is a link; remove it" if error.errno == errno.ELOOP else error.strerror
            raise NoLockError(f"the lock {path} cannot be opened: {why}{_REMEDY}") from None
    raise NoLockError(f"the lock {path} cannot be opened: it comes and goes")


def _checked(file: int) -> int:
    """Return the open file of a lock; raise OSError if it is none, FileNotFoundError if it was removed meanwhile."""
    found = os.fstat(file)
    if stat.S_ISREG(found.st_mode) and found.st_nlink == 1:
        return file
    os.close(file)
    if found.st_nlink == 0:
        raise FileNotFoundError
    raise OSError(errno.EINVAL, f"it is no file of its own, but a link or a pipe of {_user(found.st_uid)}; remove it")


def is_own(found: os.stat_result) -> bool:
    """Return whether a file can be believed in a folder that everybody may write to: it is this user's or root's."""
    return sys.platform == "win32" or found.st_uid in (os.geteuid(), 0)


def _is_writable(found: os.stat_result) -> bool:
    """Return whether this user may write a lock: one of root is believed, but only root writes it."""
    return is_own(found) and (sys.platform == "win32" or os.geteuid() in (found.st_uid, 0))


def _user(number: int) -> str:
    """Return the name of a user, who may have none."""
    if sys.platform != "win32":
        import pwd

        with suppress(KeyError):
            return pwd.getpwuid(number).pw_name
    return f"user {number}"


if sys.platform == "win32":
    import msvcrt

    def _try_lock(file: int) -> bool:
        os.lseek(file, _LOCKED_BYTE, os.SEEK_SET)
        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        except PermissionError:
            return False
        return True

else:
    import fcntl

    def _try_lock(file: int) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


def _write(file: int, holder: Holder) -> None:
    if not _is_writable(os.fstat(file)):
        return
    os.lseek(file, 0, os.SEEK_SET)
    os.truncate(file, 0)
    os.write(file, json.dumps(asdict(holder)).encode())


def _holder(path: Path) -> str:
    """Return who holds a lock, as it says itself if it is of this user or of root."""
    try:
        found = path.lstat()
        if not is_own(found):
            return f"a process that cannot say who it is, as {_user(found.st_uid)} made the lock {path}"
        return str(Holder(**parse_json(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, TypeError):
        return "a process that has not said who it is"


def _free(path: Path, file: int) -> None:
    # Removed while it is held, so that nobody else's is. Windows removes no open file, and a file of another user
    # stays; neither matters.
    with suppress(OSError):
        path.unlink()
    os.close(file)
