"""The serial ports of this computer, and the LabJack T7s in its network."""

from __future__ import annotations

import getpass
import os
import socket
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

from bench.base import Stopwatch
from drivers.labjack_t7.registers import PRODUCT_ID
from drivers.modbus import read_request
from drivers.serial_line import holder_of

T7_PORT = 502
_DISCOVERY = ("255.255.255.255", 52362)
"""Where a T7 takes Modbus over UDP. Source: LabJack, T-Series Data Sheet, 2.0 (ports 502, 702 and 52362)."""
_REPLIES = 0.5
"""Wall-clock time for the replies of a local network, s."""
_HEADER = bytes((0, 1, 0, 0, 0, 6, 1))
"""Of a request of five bytes. Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, 3.1.3."""
_BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True)
class Port:
    """Where an instrument may be.

    Attributes
    ----------
    address : str
        As a rig file takes it: a device node, `socket://HOST:PORT` or `tcp://HOST:PORT`.
    link : str
        Its name that stays when it is plugged in elsewhere, `/dev/serial/by-id/…`; empty if it has none.
    description : str
        What the system says of it.
    serial_number : str
        Of the USB adapter; empty if it has none.
    problem : str
        Who holds it, what permission is missing and how to get it, or that nothing is there; empty if it is free.
    """

    address: str
    link: str = ""
    description: str = ""
    serial_number: str = ""
    problem: str = ""

    @property
    def name(self) -> str:
        """What to write into a rig file."""
        return self.link or self.address

    @property
    def in_network(self) -> bool:
        """Whether it is an address in the network."""
        return self.address.startswith("tcp://")


def ports(further: Iterable[str] = (), hosts: Iterable[str] = (), *, search: bool = False) -> list[Port]:
    """Return the serial ports, further addresses, and T7s.

    Parameters
    ----------
    further : iterable of str
        Addresses that the system does not list.
    hosts : iterable of str
        Where a T7 is: HOST, or HOST:PORT.
    search : bool
        Whether to ask all T7s of the local network who they are.
    """
    links = {str(link.resolve()): str(link) for link in sorted(_BY_ID.iterdir())} if _BY_ID.is_dir() else {}
    found = {
        each.device: Port(
            each.device, links.get(each.device, ""), each.description, each.serial_number or "", problem(each.device)
        )
        for each in list_ports.comports()
    }
    discovered = [f"tcp://{host}:{T7_PORT}" for host in (_t7s() if search else ())]
    found |= {address: Port(address, description="LabJack T7") for address in discovered}
    given = [f"tcp://{host if ':' in host else f'{host}:{T7_PORT}'}" for host in hosts]
    for address in dict.fromkeys((*given, *further)):
        if address not in found and os.path.realpath(address) not in found:
            found[address] = Port(address, problem=problem(address))
    return list(found.values())


def problem(address: str) -> str:
    """Return why a port or an address cannot be opened, and what to do; empty if nothing is known against it."""
    if address.startswith("tcp://"):
        host, _, number = address.removeprefix("tcp://").rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(number)), _REPLIES).close()
        except (OSError, ValueError, OverflowError) as error:
            return f"cannot be reached ({error}): check address, cable and power"
        return ""
    node = Path(address)
    if not node.exists():
        return "" if "://" in address or os.name == "nt" else "there is no such port: check its name, cable and power"
    if not os.access(node, os.R_OK | os.W_OK):
        group = "dialout"
        with suppress(KeyError, OSError, NotImplementedError):
            group = node.group()
        return f"no permission: sudo usermod -aG {group} {getpass.getuser()}, then log in again"
    if (holder := holder_of(address)) is not None:
        return f"in use by process {holder[0]} ({holder[1]})"
    return ""


def _t7s() -> list[str]:
    """Return the hosts of the T7s that answer a question to all of the local network."""
    hosts: list[str] = []
    waited = Stopwatch()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line, suppress(OSError):
        line.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        line.sendto(_HEADER + read_request(PRODUCT_ID.address, 2), _DISCOVERY)
        while (left := _REPLIES - waited.seconds()) > 0:
            line.settimeout(left)
            _, (host, _) = line.recvfrom(64)
            hosts.append(host)
    return hosts
