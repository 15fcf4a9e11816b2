"""The command `bench rig emulate`."""

from __future__ import annotations

import ipaddress
import secrets
import socket
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from bench.base import ConfigurationError, json_text, parse_json, write_whole
from bench.cli import STANDARD_OUTPUT, JsonOption, console, parse_assignments, parse_numbers, warn

if TYPE_CHECKING:
    # Imported by the functions, as `bench --help` imports this module for its help text.
    from bench.rig import RigFile
    from sim_devices.serving.endpoints import Listener
    from sim_devices.serving.served import ServedLaboratory

_LOOPBACK = "127.0.0.1"


def emulate(
    rigs: Annotated[list[str], typer.Argument(metavar="RIG", help="Emulated rigs: names, or path/to/rig.toml.")],
    clock: Annotated[
        str, typer.Option(help="wall, or xN for N times as fast; a busy machine makes it slower, never unfair.")
    ] = "wall",
    json_file: JsonOption = None,
    control: Annotated[
        str,
        typer.Option(metavar="ADDRESS", help="Control socket: tcp://HOST:PORT (0: a free port), or unix:PATH."),
    ] = f"tcp://{_LOOPBACK}:0",
    state: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Append the true values to this file, as lines of JSON.")
    ] = None,
    state_period: Annotated[
        float, typer.Option(min=1e-3, metavar="SECONDS", help="Laboratory time between two of these lines.")
    ] = 1.0,
    host: Annotated[str, typer.Option(help="Address of this machine on which TCP ports listen.")] = _LOOPBACK,
    ports: Annotated[
        list[str] | None,
        typer.Option(
            "--port",
            metavar="NAME=N",
            help="Put an instrument (NAME, or RIG.NAME) on this TCP port, a serial one as raw bytes; repeatable.",
        ),
    ] = None,
    tcp: Annotated[
        bool, typer.Option("--tcp", help="Put serial instruments on TCP ports too, for socket://HOST:PORT.")
    ] = False,
    baud_time: Annotated[
        bool, typer.Option("--baud-time", help="Let bytes take the time of the line's speed, both ways.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--override", metavar="KEY=VALUE", help="Replace a value of the rig files; repeatable."),
    ] = None,
) -> None:
    """Serve the emulated instruments of rigs to other processes, on pseudo-terminals and TCP ports.

    Each instrument speaks the bytes of the real one, so that any client of its protocol can talk to it. The addresses
    are printed, and written to the file of `--json` once everything is ready; with `--json -` they are one line of
    the standard output. The control socket reads the true state
    of the laboratory, injects faults such as {"do": "fault", "fault": "tec.delay", "duration": 5}, and lists them by
    {"do": "help"}; the file of `--state` says when each began and ended. Ctrl-C and SIGTERM end it.
    """
    from bench.base import Interrupts
    from bench.rig import load_rig
    from sim_devices.serving.clock import make_served_clock
    from sim_devices.serving.control import ControlSocket
    from sim_devices.serving.served import ServedLaboratory, Serving, servers_by_line
    from sim_devices.serving.server import Server
    from sim_devices.serving.state_log import StateLog

    replaced = parse_assignments("--override", overrides or [])
    files = [load_rig(rig, replaced) for rig in rigs]
    given_ports = parse_numbers("--port", ports or [])
    _check_rigs(files)
    try:
        clocks = [make_served_clock(clock) for _ in files]
    except ValueError as error:
        raise ConfigurationError(f"--clock: {error}") from None
    with ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        laboratories = {
            file.name: file.laboratory(file.laboratory_settings, each, seed)  # type: ignore[misc]  # checked above
            for file, each in zip(files, clocks, strict=True)
        }
        lines = {file.name: servers_by_line(file, laboratories[file.name]) for file in files}
        serving = Serving(host, tcp, _check_ports(given_ports, lines), baud_time)
        served = []
        for file, each in zip(files, clocks, strict=True):
            served.append(ServedLaboratory(file, laboratories[file.name], each, serving))
            stack.callback(served[-1].close)
            served[-1].warm_up()
        log = None
        if state is not None:
            log = StateLog(state, state_period)
            stack.callback(log.close)
        identity = secrets.token_hex(8)
        control_socket = ControlSocket(_control_listener(control), served, identity)
        stack.callback(control_socket.close)
        if not _is_loopback(host):
            warn(f"everybody who reaches {host} can command these instruments, and nothing asks for a password")
        content = _endpoints(served, clock, control_socket.address, identity)
        if json_file == STANDARD_OUTPUT:
            _print_line(content)
        elif json_file is not None:
            _write_at_once(json_file, content)
            stack.callback(_remove, json_file, identity)
        _print(served, control_socket.address)
        Server(served, control_socket, log).run(lambda: interrupts.abort_requested() or interrupts.pause_requested)
        for each_served in served:
            reached = each_served.clock.factor_reached
            console.print(
                f"{each_served.name}: {each_served.clock.now():.1f} s of laboratory time, "
                f"{reached:.3g} times as fast as the wall clock (of {each_served.clock.factor:g})",
            )


def _check_rigs(files: Sequence[RigFile]) -> None:
    """Check that the rigs can be served, each under a name of its own."""
    from sim_devices.laboratory import EmulatedLaboratory

    for index, file in enumerate(files):
        if file.laboratory is None:
            raise ConfigurationError(f"rig {file.name} has no emulated laboratory (table [emulation]) to be served")
        if not issubclass(file.laboratory, EmulatedLaboratory):
            raise ConfigurationError(
                f"rig {file.name}: laboratory {file.laboratory.__name__} has no lines, so it cannot be served"
            )
        if file.name in (other.name for other in files[:index]):
            raise ConfigurationError(f"rig {file.name} is named twice; serve it again by a process of its own")


def _check_ports(ports: Mapping[str, int | float], lines: Mapping[str, Iterable[str]]) -> dict[str, int]:
    """Return TCP ports by `RIG.NAME`."""
    full = [f"{rig}.{name}" for rig, names in lines.items() for name in names]
    found: dict[str, int] = {}
    for name, number in ports.items():
        meant = [each for each in full if name in (each, each.partition(".")[2])]
        if not isinstance(number, int) or not 1 <= number <= 65535:
            raise ConfigurationError(f"--port {name}={number}: allowed are 1 to 65535")
        if len(meant) != 1:
            problem = "is in several rigs" if meant else "is not served"
            raise ConfigurationError(f"--port {name}={number}: {name} {problem}; there are: {', '.join(full)}")
        found[meant[0]] = number
    return found


def _control_listener(address: str) -> Listener:
    from sim_devices.serving.endpoints import Listener

    scheme, _, rest = address.partition(":")
    host, _, port = rest.removeprefix("//").rpartition(":")
    try:
        if scheme == "unix" and rest:
            if not hasattr(socket, "AF_UNIX"):
                raise ConfigurationError(f"--control {address}: this system has no Unix sockets; use tcp://HOST:PORT")
            return Listener(Path(rest))
        if scheme != "tcp" or not host or not port.isdigit() or int(port) > 65535:
            raise ConfigurationError(f"--control {address}: expected tcp://HOST:PORT or unix:PATH")
        host = host.strip("[]")
        if not _is_loopback(host):
            warn(f"everybody who reaches {host} can control the laboratory, and nothing asks for a password")
        return Listener((host, int(port)))
    except OSError as error:
        raise ConfigurationError(f"--control {address} cannot be opened: {error.strerror}") from None


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _endpoints(served: Sequence[ServedLaboratory], clock: str, control: str, identity: str) -> dict[str, Any]:
    """Return what `--json` writes; one rig stands at the top, several under `rigs`."""
    rigs = [{"rig": each.name, "instruments": each.endpoints()} for each in served]
    common = {"clock": clock, "factor": served[0].clock.factor, "control": control, "server": identity}
    return {**common, **rigs[0]} if len(rigs) == 1 else {**common, "rigs": rigs}


def _print_line(content: dict[str, Any]) -> None:
    """Write to the standard output, on one line: who reads it need not wait for the end of the server."""
    try:
        sys.stdout.write(json_text(content) + "\n")
        sys.stdout.flush()
    except OSError as error:
        raise ConfigurationError(f"--json - cannot be written: {error.strerror}") from None


def _write_at_once(path: Path, content: dict[str, Any]) -> None:
    try:
        write_whole(path, json_text(content, indent=1) + "\n")
    except OSError as error:
        raise ConfigurationError(f"--json {path} cannot be written: {error.strerror}") from None


def _remove(path: Path, identity: str) -> None:
    """Remove the file, unless another server has written its own there."""
    with suppress(OSError, ValueError):
        if parse_json(path.read_text(encoding="utf-8")).get("server") == identity:
            path.unlink()


def _print(served: Sequence[ServedLaboratory], control: str) -> None:
    table = Table("rig", "instrument", "devices", "protocol", box=None, padding=(0, 2))
    # An address must not be cut off, however narrow the screen is.
    table.add_column(
        "address", no_wrap=True, min_width=max(len(line.address) for each in served for line in each.lines.values())
    )
    for each in served:
        for name, endpoint in each.endpoints().items():
            table.add_row(each.name, name, ", ".join(endpoint["devices"]), endpoint["protocol"], endpoint["port"])
    console.print(table)
    console.print(f"control: {control}; Ctrl-C ends")
