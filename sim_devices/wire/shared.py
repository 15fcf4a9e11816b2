"""A line with several emulated instruments on it, as on RS-485."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bench.rig import ECHO, JOIN
from sim_devices.wire import TcpServer, WireServer


class SharedLine(WireServer):
    """Several instruments on one line: each hears the host, and what the others send.

    What an instrument sends because of what another one has sent, as none should, reaches the host only.

    Parameters
    ----------
    members : sequence of WireServer
        The instruments.
    echoes : bool
        Whether the adapter of the host hands back what it sends.
    """

    def __init__(self, members: Sequence[WireServer], *, echoes: bool = False) -> None:
        self._members = members
        self._echoes = echoes
        self.protocol = members[0].protocol

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the host receives."""
        answers = [member.receive(data) for member in self._members]
        return (data if self._echoes else b"") + self._heard_by_all(answers)

    def unsolicited(self) -> bytes:
        """Return what the instruments have sent by themselves since the last call, up to the present time."""
        return self._heard_by_all([member.unsolicited() for member in self._members])

    def next_unsolicited(self) -> float:
        """Return the laboratory time (s) at which one will next send something by itself; infinity if none will."""
        return min(member.next_unsolicited() for member in self._members)

    def _heard_by_all(self, sent: list[bytes]) -> bytes:
        on_line = b""
        for sender, data in zip(self._members, sent, strict=True):
            if data:
                on_line += data
                for member in self._members:
                    if member is not sender and member.hears_others:
                        on_line += member.receive(data)
        return on_line


def joined(name: str, servers: Mapping[str, WireServer | TcpServer]) -> SharedLine:
    """Return the line of instruments whose names are joined, as `a+b`; `echo+a` is one whose adapter echoes.

    Raises
    ------
    ValueError
        If there is no such instrument, or one has no serial line; names it and says which there are.
    """
    names = [each for each in name.split(JOIN) if each != ECHO]
    members = [servers.get(each) for each in names]
    found = [member for member in members if isinstance(member, WireServer)]
    if len(found) < len(names) or not found:
        known = ", ".join(each for each, server in servers.items() if isinstance(server, WireServer)) or "none"
        raise ValueError(
            f"{name!r}: expected names of instruments with a serial line, joined by {JOIN}; there are: {known}"
        )
    return SharedLine(found, echoes=ECHO in name.split(JOIN))
