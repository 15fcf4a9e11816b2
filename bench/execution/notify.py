"""Messages to people who are not at the bench: when a run pauses, asks, warns, trips or ends.

A target is a command, the address of a mailbox, or that of a webhook::

    --notify "notify-send bench"          # a program, with the facts in its environment and as JSON on its input
    --notify mailto:operator@lab.example  # by the SMTP server that BENCH_SMTP_HOST names
    --notify https://hooks.lab.example/7  # JSON, posted
"""

from __future__ import annotations

import os
import platform
import queue
import shlex
import shutil
import smtplib
import ssl
import subprocess
import threading
import urllib.parse
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from email.message import EmailMessage
from functools import partial
from pathlib import Path
from typing import Any, Self

from bench.base import OPTION, ConfigurationError, Stopwatch, json_text, redacted, wall_time
from bench.record import Event, StepRecord

_OCCASIONS = {"pause": "pause", "prompt": "prompt", "warning": "warning", "interlock": "trip", "end": "end"}
"""Kinds of events that are told, and what the occasion is called."""

WITHIN = 30.0
"""Wall-clock time that one message may take, s."""

_AT_THE_END = 10.0
"""Longest wait at the end of a run until all messages are sent, s."""

_MOST = 20
"""Messages that wait at most."""

_SMTP = {
    "BENCH_SMTP_HOST": "server",
    "BENCH_SMTP_PORT": "its port; 587 if not given, 465 speaks TLS from the start",
    "BENCH_SMTP_USER": "user, if it asks for one",
    "BENCH_SMTP_PASSWORD": "password",
    "BENCH_SMTP_FROM": "sender; bench@HOST if not given",
    "BENCH_SMTP_TLS": "`no` for a server of the laboratory without encryption",
}
"""Variables of the environment that say how mail is sent."""

Facts = Mapping[str, Any]
Send = Callable[[Facts], None]


def sender(target: str) -> Send:
    """Return what sends facts to a target; it raises OSError, or another error of the library, if that fails.

    Raises ConfigurationError if the target is none: no such program, no mail server.
    """
    if target.lower().startswith(("http://", "https://")) and urllib.parse.urlsplit(target).hostname:
        return partial(_post, target)
    if target.lower().startswith("mailto:"):
        address = target[len("mailto:") :]
        if "@" not in address:
            raise ConfigurationError(f"{OPTION} {target}: expected mailto:NAME@DOMAIN")
        if not os.environ.get("BENCH_SMTP_HOST"):
            known = "; ".join(f"{name}: {text}" for name, text in _SMTP.items())
            raise ConfigurationError(f"{OPTION} {target}: BENCH_SMTP_HOST is not set ({known})")
        if not (port := os.environ.get("BENCH_SMTP_PORT") or "587").isdecimal():
            raise ConfigurationError(f"{OPTION} {target}: BENCH_SMTP_PORT is {port!r}; expected a number")
        return partial(_mail, address)
    words: list[str] = []
    # A quotation that does not end is no command.
    with suppress(ValueError):
        # On Windows a backslash is part of a path.
        words = [word.strip('"') if os.name == "nt" else word for word in shlex.split(target, posix=os.name != "nt")]
    program = shutil.which(words[0]) if words else None
    if program is None:
        raise ConfigurationError(
            f"{OPTION} {redacted(target)!r}: there is no such program; expected a command, mailto:ADDRESS or https://ADDRESS"
        )
    return partial(_call, [program, *words[1:]])


def _call(command: Sequence[str], facts: Facts) -> None:
    said = {f"BENCH_{name.upper()}": str(value) for name, value in facts.items() if not isinstance(value, dict)}
    done = subprocess.run(  # noqa: S603 - the operator's own command
        command,
        input=json_text(facts).encode(),
        env={**os.environ, **said},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        timeout=WITHIN,
        check=False,
        # Ctrl-C at the terminal is meant for the run.
        start_new_session=os.name != "nt",
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        raise OSError(f"exit code {done.returncode}{f': {lines[-1]}' if lines else ''}")


def _post(url: str, facts: Facts) -> None:
    body = json_text(facts).encode()
    request = urllib.request.Request(  # noqa: S310 - http and https only, see `sender`
        url, body, {"Content-Type": "application/json", "User-Agent": "actuator-bench"}
    )
    with urllib.request.urlopen(request, timeout=WITHIN):  # noqa: S310
        pass


def _mail(address: str, facts: Facts) -> None:
    settings = {name: os.environ.get(name, "") for name in _SMTP}
    host, port = settings["BENCH_SMTP_HOST"], int(settings["BENCH_SMTP_PORT"] or 587)
    message = EmailMessage()
    message["From"] = settings["BENCH_SMTP_FROM"] or f"bench@{platform.node() or 'localhost'}"
    message["To"] = address
    message["Subject"] = " ".join(f"[bench] {facts['event']}: {facts['protocol']} on {facts['rig']}".split())
    lines = [str(facts["text"]), "", *(f"{name}: {value}" for name, value in facts.items() if name != "text")]
    message.set_content("\n".join(lines))
    encrypted = settings["BENCH_SMTP_TLS"].lower() != "no"
    context = ssl.create_default_context()
    connection = (
        smtplib.SMTP_SSL(host, port, timeout=WITHIN, context=context)
        if encrypted and port == 465
        else smtplib.SMTP(host, port, timeout=WITHIN)
    )
    with connection as server:
        if encrypted and port != 465:
            server.starttls(context=context)
        if settings["BENCH_SMTP_USER"]:
            server.login(settings["BENCH_SMTP_USER"], settings["BENCH_SMTP_PASSWORD"])
        server.send_message(message)


class Notifier:
    """Sends messages about a run; an `Observer` of the engine, whose thread waits for none of them.

    Each target has a thread of its own: a server that does not answer keeps no other target from being told.

    Use it as a context manager. What fails is returned by `take_notices`, for the record.

    Parameters
    ----------
    targets : sequence of str
        Commands, `mailto:` and `https://` addresses.

    Raises
    ------
    ConfigurationError
        If a target is none.
    """

    def __init__(self, targets: Sequence[str]) -> None:
        self._notices: list[str] = []
        self._lines = [_Line(target, self._notices) for target in targets]
        self.signals: tuple[str, ...] = ()
        """Names of the signals, in the order of the engine's values."""
        self.facts: dict[str, Any] = {}
        """What is said of the run in each message: run, rig, protocol, …"""
        self.is_told: Callable[[], bool] = lambda: False
        """Whether another process has told already that the run has failed; nobody is told twice."""
        self._values: Sequence[float] = ()
        self._reasons: dict[str, None] = {}
        self._is_finished = False

    def start(self) -> None:
        """Begin to send; what has happened before is sent as well."""
        for line in self._lines:
            line.thread.start()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.finish()

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:  # noqa: ARG002 - as of all
        """Note the newest readings."""
        self._values = values

    def step(self, record: StepRecord) -> None:
        """Note the newest readings."""
        self._values = record.values

    def event(self, event: Event) -> None:
        """Send a message, if it is an occasion for one."""
        if event.level == "ERROR":
            self._reasons[event.text] = None
        occasion = _OCCASIONS.get(event.kind)
        if occasion is None or (event.level == "INFO" and occasion not in ("prompt", "end")):
            return
        if occasion == "trip" and event.level != "ERROR":
            occasion = "warning"  # of an interlock that does not end the run
        if occasion == "end" and event.level != "INFO" and self.is_told():
            return
        reasons = "; ".join(self._reasons) if occasion == "end" else ""
        values = dict(zip(self.signals, self._values, strict=False))
        facts = {
            "event": occasion,
            "text": f"{event.text}: {reasons}" if reasons else event.text,
            "level": event.level,
            "t": event.t,
            "time": wall_time().isoformat(timespec="seconds"),
            "host": platform.node(),
            **self.facts,
            "values": {name: value for name, value in values.items() if value == value},
        }
        for line in self._lines:
            line.put(facts)

    def take_notices(self) -> list[str]:
        """Return what has failed since the last call."""
        # Threads append to it.
        taken = self._notices[:]
        del self._notices[: len(taken)]
        return taken

    def finish(self, longest: float = _AT_THE_END) -> None:
        """Wait until all messages are sent, for so many seconds at most."""
        if self._is_finished:
            return
        self._is_finished = True
        waited = Stopwatch()
        for line in self._lines:
            with suppress(queue.Full):
                line.waiting.put(None, timeout=max(0.0, longest - waited.seconds()))
        for line in self._lines:
            line.thread.join(max(0.0, longest - waited.seconds()))
            if line.thread.is_alive():
                self._notices.append(f"{line.shown}: messages were not sent within {longest:g} s after the end")


class _Line:
    """Sends messages to one target in a thread of its own; what fails joins the notices."""

    def __init__(self, target: str, notices: list[str]) -> None:
        self._target, self._send, self._notices = target, sender(target), notices
        self.shown = redacted(target)
        self.waiting: queue.Queue[Facts | None] = queue.Queue(_MOST)
        self.thread = threading.Thread(target=self._work, name="notifier", daemon=True)

    def put(self, facts: Facts) -> None:
        """Have a message sent."""
        try:
            self.waiting.put_nowait(facts)
        except queue.Full:
            self._fail(facts, f"{_MOST} messages wait already")

    def _work(self) -> None:
        while (facts := self.waiting.get()) is not None:
            try:
                self._send(facts)
            except subprocess.TimeoutExpired:
                # What this error says names all arguments.
                self._fail(facts, f"it took longer than {WITHIN:g} s")
            # Whatever a library raises: the run goes on.
            except Exception as error:
                self._fail(facts, str(error).replace(self._target, self.shown))

    def _fail(self, facts: Facts, why: str) -> None:
        self._notices.append(f"{self.shown} was not told of the {facts['event']}: {why}")


def facts_of(meta: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return what each message says of a run."""
    return {"run": str(folder.resolve()), "rig": meta["rig"], "protocol": meta["protocol"]}
