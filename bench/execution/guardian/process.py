"""The guardian's main loop: requests of the bench, looks at the interlocks, and the safe state.

One thread decides; the devices are asked in the threads of their lines. The bench promises with each request by when
the next one comes. The run ends in the safe state when a promise is broken, the bench is gone, an interlock trips, or
a device cannot be read.

A bench that hung or is gone cannot say so: once the devices are safe, the guardian writes it into its own record and
sends the messages of the run. It ends a bench that does not come back.
"""

from __future__ import annotations

import math
import os
import queue
import selectors
import signal
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.base import ENDING, STACKS, BenchError, Clock, ConfigurationError, DeviceError, GuardianError, WallClock
from bench.devices import Status
from bench.execution.guardian.black_box import BlackBox
from bench.execution.guardian.channel import LONGEST_ANSWER, STILL_AT_IT, Channel, ChannelError, Message, to_message
from bench.execution.guardian.lines import BENCH, LOOK, SAFE, LineThreads, NotAskedError, Result
from bench.execution.guardian.parent import SIGKILL, ParentProcess
from bench.execution.guardian.rescuer import TRY_FOR, Rescuer, in_words
from bench.execution.notify import WITHIN, Notifier
from bench.execution.station.core import StationCore
from bench.execution.station.interface import News, counted, news_of
from bench.execution.station.reconnection import TRIES
from bench.record import END, FAILED, Event
from bench.rig import BLIND, SAFE as IS_SAFE, AttachedClock, InterlockWatch, Look, Rig, lines_of, longest_away

_SAFE_WITHIN = 3.0
"""Time for the safe state of all devices, s; those that have not answered then are reported as unsafe."""

_TRY_AGAIN = 1.0
"""Time after which a device that is not safe is tried again, s."""

_COMES_BACK = 3.0
"""Time that a bench which was late has to come back and end its run itself, s: as long as the safe state may take."""

_ENDS = 6.0
"""Time that it has to end by SIGTERM, s: it leaves a protocol that goes on after 2 s, and writes its record and its
last words within 1 s each."""

_DIES = 1.0
"""Time from the end of the channel, s, within which a process that ends has ended."""

_NOTHING = Result("", None, None, was_away=False)
"""The result of a request that concerns no device."""

_SAY_SO = 1.0
"""Time after which the bench is told that its request is still being carried out, s."""

_LONGEST_WAIT = 0.5
"""Longest time between two turns of the loop, s."""


@dataclass
class _Job:
    """Calls of several devices whose results belong together."""

    waiting: set[str]
    done: Callable[[dict[str, Any]], None]
    failed: Callable[[BaseException], None]
    values: dict[str, Any] = field(default_factory=dict)
    error: BaseException | None = None
    was_late: bool = False
    """Whether a line was away meanwhile, so that the values are of different times."""


class Guardian:
    """Holds a rig for a bench in another process.

    Parameters
    ----------
    channel : Channel
        To the bench.
    rig : Rig
        Connected devices.
    bench : int
        Number of the bench's process.
    rescuer : Rescuer
        What makes the devices safe if this process cannot.
    """

    def __init__(self, channel: Channel, rig: Rig, bench: int, rescuer: Rescuer) -> None:
        self._channel = channel
        self._rig = rig
        self._process = ParentProcess(bench)
        self._rescuer = rescuer
        self._wall: Clock = WallClock()
        safety = rig.file.safety
        self._factor = factor = float(getattr(rig.clock, "factor", 1.0))
        watch = InterlockWatch(rig.file.interlocks, {each.name: each.display for each in rig.signals})
        self._core = StationCore(watch, 1.0 / (safety.rate * min(factor, 10.0)))
        self._watched = watch.signals
        self._looked_at = rig.watching(watch.signals)
        self._statuses: list[Status] = []
        self._news: list[News] = []
        self._box = BlackBox()
        self._results: queue.SimpleQueue[tuple[Callable[[Result], None], Result]] = queue.SimpleQueue()
        self._wake, self._woken = socket.socketpair()
        for each in (self._wake, self._woken):
            each.setblocking(False)
        self._looking: set[str] = set()
        self._latest: dict[str, dict[str, float]] = {}
        self._concerned = {name: self._signals_of(name) for name in self._looked_at}
        self._request: Message | None = None
        self._said_at = 0.0
        self._requested = 0.0
        self._seen_at = {name: self._wall.now() for name, known in self._concerned.items() if known & self._watched}
        # Once: a host is looked up by its name, which takes long when its line is lost.
        self._longest_away = longest_away(rig.file, rig.devices, self._seen_at)
        self._lines = LineThreads(
            rig.devices, lines_of(rig.file), rig.clock, self._longest_away.__getitem__, self._line_was_away
        )
        self._bench_is_there = True
        self._loss: GuardianError | None = None
        self._lost_at = 0.0
        self._writes_stacks = False
        self._keeps_record = False
        self._zero = rig.clock.now()
        self._notifier = Notifier(())
        self._values: dict[str, float] = {}
        self._told: float | None = None
        self._is_asked_to_end = False
        self._ending: float | None = None
        # Every device counts as unsafe until it has said otherwise, whatever fails here.
        self._unsafe = dict.fromkeys(rig.devices, f"has not answered within {_SAFE_WITHIN:g} s")
        self._safe: dict[str, str] | None = None
        self._next_try = 0.0
        self._stages: list[list[str]] = []
        self._pending: set[str] = set()
        self._reported = False
        self._terminated = False

    def begin(self, hello: Message, description: dict[str, Any]) -> None:
        """Tell the bench what was connected, as the reply to its first request."""
        self._request = hello
        self._reply(hello, description)

    def serve(self) -> None:
        """Serve until the run has ended and every device is safe, or 10 min were not enough for that."""
        # They are meant for the bench.
        for number in (*ENDING, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, self._terminate)
        self._core.begin(self._wall.now())
        with selectors.DefaultSelector() as selector:
            selector.register(self._channel, selectors.EVENT_READ, self._receive)
            selector.register(self._woken, selectors.EVENT_READ, self._wake_up)
            lose = partial(self._lose_bench, "the bench has died")
            parent = self._process.descriptor
            if parent is not None:
                selector.register(parent, selectors.EVENT_READ, lose)
            elif self._process.has_died():
                lose()
            while not self._is_over():
                if self._bench_is_there:
                    events = selectors.EVENT_READ | selectors.EVENT_WRITE * self._channel.is_sending
                    selector.modify(self._channel, events, self._receive)
                wait = min(_LONGEST_WAIT, max(0.0, self._due() - self._wall.now()))
                for key, _ in selector.select(wait):
                    # Whatever fails here must not keep the devices from being made safe.
                    try:
                        key.data()
                    except Exception as error:
                        self._core.trip(_as_bench_error(error))
                try:
                    self._turn()
                except Exception as error:
                    self._core.trip(_as_bench_error(error))
                if not self._bench_is_there:
                    for lost in (self._channel, parent):
                        with suppress(KeyError, ValueError, TypeError):
                            selector.unregister(lost)  # type: ignore[arg-type]
        self._box.note(END, safe=self._states())

    def finish(self) -> None:
        """Wait until all have been told that the bench hung or is gone, and close the record."""
        if self._told is not None:
            self._notifier.finish(WITHIN)
        for text in self._notifier.take_notices():
            self._box.note("notify", text=text)
        self._box.close()

    # What has to be done now

    def _due(self) -> float:
        if self._ending is None:
            return self._core.due()
        return self._next_try if self._unsafe else math.inf

    def _turn(self) -> None:
        now = self._wall.now()
        self._rescuer.live(now)
        if self._terminated:
            self._core.trip(GuardianError("the guardian was asked to end by SIGTERM"))
        self._core.advance(now)
        if self._request is not None:
            self._seen_at = dict.fromkeys(self._seen_at, now)
            self._say_so(now)
            if (taken := now - self._requested) > LONGEST_ANSWER + self._rig.file.safety.reconnect:
                self._core.trip(GuardianError(f"a request was not carried out within {taken:.0f} s"))
        for name, seen in self._seen_at.items():
            if now - seen > BLIND + self._longest_away[name].seconds:
                self._core.trip(DeviceError(name, f"could not be looked at for {now - seen:.1f} s; see its line"))
        if self._core.over:
            self._keep_safe(now)
        elif self._core.look_due(now):
            for name in self._looked_at.keys() - self._looking:
                self._looking.add(name)
                self._submit(LOOK, name, self._looked_at[name], self._take_look)

    def _is_over(self) -> bool:
        if self._ending is None or self._safe is None:
            return False
        if not (self._unsafe or self._pending):
            return self._reported or (not self._bench_is_there and not self._owes_word)
        # A driver that hangs for good does not keep this process for good.
        return not self._bench_is_there and self._is_in_vain()

    def _is_in_vain(self) -> bool:
        """Return whether it is of no use to try again: after 10 min, or as the emulated laboratory is gone."""
        assert self._ending is not None
        clock = self._rig.clock
        gone = isinstance(clock, AttachedClock) and clock.is_alone
        return gone or self._wall.now() - self._ending > TRY_FOR

    # The bench

    def _receive(self) -> None:
        try:
            self._channel.flush()
            messages = self._channel.receive()
        except ChannelError as error:
            self._lose_bench(str(error))
            return
        for message in messages:
            self._take(message)

    def _lose_bench(self, why: str) -> None:
        if self._bench_is_there:
            self._bench_is_there = False
            self._request = None
            self._lost_at = self._wall.now()
            self._loss = GuardianError(f"the bench is gone ({why})")
            self._core.trip(self._loss)

    def _take(self, message: Message) -> None:
        do = message.get("do")
        if self._request is not None and do != "end":
            self._lose_bench("it asks before it was answered")
            return
        self._request = message
        self._requested = self._said_at = self._wall.now()
        if do == "end":
            self._core.end()
            return
        try:
            self._core.request(self._wall.now())
            _REQUESTS[str(do)](self, message)
        except Exception as error:
            self._refuse(message, error)

    def _say_so(self, now: float) -> None:
        """Tell the bench each second that its request is still being carried out."""
        if now - self._said_at >= _SAY_SO:
            self._said_at = now
            try:
                self._channel.send(STILL_AT_IT)
            except ChannelError as error:
                self._lose_bench(str(error))

    def _reply(self, request: Message, result: Any = None) -> None:  # noqa: ANN401 - anything that JSON can hold
        self._answer(request, result=result)

    def _refuse(self, request: Message, error: BaseException) -> None:
        if not isinstance(error, BenchError):
            self._box.note("defect", error=f"{type(error).__name__}: {error}")
        self._answer(request, error=to_message(error))

    def _answer(self, request: Message, **content: Any) -> None:  # noqa: ANN401 - anything that JSON can hold
        # What the bench no longer waits for must not be taken for the answer to its `end`.
        if request is not self._request:
            return
        self._request = None
        try:
            self._core.reply(self._wall.now())
            # Threads of lines append to it.
            news = self._news[:]
            del self._news[: len(news)]
            cause = self._core.cause
            pause, self._core.pause = self._core.pause, ""
            self._channel.send(
                {
                    "n": request.get("n"),
                    "news": [asdict(each) for each in news],
                    "holding": self._core.holding,
                    "pause": pause,
                    "told": self._told is not None,
                    "tripped": None if cause is None else to_message(cause),
                    **content,
                }
            )
        # One that gets no answer promises nothing either.
        except Exception as error:
            self._lose_bench(f"it could not be answered: {error}")

    # Requests

    def _promise(self, message: Message) -> None:
        self._core.promise(float(message["seconds"]), str(message["why"]))
        self._reply(message)

    def _keep_record(self, message: Message) -> None:
        self._box.keep_in(Path(message["folder"]), rig=self._rig.file.name, process=os.getpid())
        self._writes_stacks = bool(message["stacks"])
        passed = (self._rig.clock.date() - datetime.fromisoformat(message["epoch"])).total_seconds()
        self._zero = self._rig.clock.now() - passed
        self._notifier = Notifier(message["targets"])
        self._notifier.facts = message["facts"]
        self._rescuer.will_tell({"targets": message["targets"], "facts": message["facts"], "t": passed})
        self._keeps_record = True
        self._reply(message)

    def _look(self, message: Message, tries: int = TRIES) -> None:
        readers = self._rig.readers(Look(message["look"]), message["wanted"])

        def done(readings: dict[str, Any]) -> None:
            # What other devices gave before a line was back is too old to stand beside it.
            if job.was_late and tries > 1:
                self._look(message, tries - 1)
                return
            values = self._rig.assembled({name: readings[name] for name in readers})
            self._judge(self._rig.clock.now(), values)
            self._reply(message, values)

        job = self._start(BENCH, readers, done, partial(self._refuse, message))

    def _apply(self, message: Message) -> None:
        setpoints = message["setpoints"]
        self._rig.check({name: (value,) for name, value in setpoints.items()})
        self._core.arm()
        calls = {name: partial(self._rig.actuator(name).set, value) for name, value in setpoints.items()}

        def done(statuses: dict[str, Status]) -> None:
            self._statuses = [statuses[name] for name in setpoints]
            self._reply(message, {name: self._rig.setpoints[name] for name in setpoints})

        self._start(BENCH, calls, done, partial(self._refuse, message))

    def _rest(self, message: Message, left: Sequence[Sequence[str]] | None = None) -> None:
        """Switch all outputs off for a while, in their order."""
        now, *later = stages(self._rig) if left is None else left
        calls = {name: self._rig.devices[name].safe for name in now}

        def done(_: dict[str, Any]) -> None:
            if later:
                self._rest(message, later)
            else:
                self._reply(message)

        self._start(BENCH, calls, done, partial(self._refuse, message))

    def _tare(self, message: Message) -> None:
        name = message["device"]
        calls = {name: self._rig.load_cell(name).tare}
        self._start(BENCH, calls, lambda _: self._reply(message), partial(self._refuse, message))

    def _check(self, message: Message) -> None:
        self._rig.check(message["setpoints"])
        self._reply(message)

    def _arrivals(self, message: Message) -> None:
        statuses = {status.device: status for status in self._statuses}

        def done(arrived: dict[str, bool]) -> None:
            errors = [each for status in self._statuses if (each := status.exception()) is not None]
            self._reply(
                message,
                {
                    "waiting": [name for name in statuses if not arrived[name]],
                    "error": to_message(errors[0]) if errors else None,
                },
            )

        calls = {name: status.ask for name, status in statuses.items()}
        self._start(BENCH, calls, done, partial(self._refuse, message))

    def _can_play(self, message: Message) -> None:
        player = self._rig.block_player(message["inputs"], message["actuators"], message["period"])
        self._reply(message, player is not None)

    def _play(self, message: Message) -> None:
        name = message["actuators"][0]
        player = self._rig.block_player(message["inputs"], message["actuators"], message["period"])
        if player is None:
            raise ConfigurationError(f"{name} cannot carry out blocks by itself")
        self._core.arm()
        setpoints = np.array(message["setpoints"], dtype=np.float64)

        def done(readings: dict[str, Any]) -> None:
            rows: list[list[float]] = readings[name].tolist()
            self._judge_block(message["inputs"], rows, message["period"])
            self._reply(message, rows)

        self._start(BENCH, {name: lambda: player(setpoints)}, done, partial(self._refuse, message))

    def _operate(self, message: Message) -> None:
        if self._rig.laboratory is None:
            raise ConfigurationError("there is no emulated laboratory that could do it")
        self._rig.laboratory.operate(message["task"], message["value"])
        self._reply(message)

    # Interlocks

    def _signals_of(self, name: str) -> frozenset[str]:
        """Return the signals of a device, and the derived ones that come from them."""
        own = {signal_.name for signal_ in self._rig.devices[name].signals}
        return frozenset(own | {each for each in self._rig.derived if not own.isdisjoint(self._rig.sources({each}))})

    def _take_look(self, result: Result) -> None:
        """Judge what a device has shown at a look; a line that is away keeps no other from being looked at."""
        self._looking.discard(result.device)
        if result.error is not None:
            self._core.trip(_as_bench_error(result.error))
            return
        self._latest[result.device] = result.value
        known = self._rig.assembled({name: self._latest[name] for name in self._looked_at if name in self._latest})
        values = {name: known[name] for name in self._concerned[result.device] if name in known}
        self._box.saw(values)
        self._values.update(values)
        self._judge(self._rig.clock.now(), values)

    def _judge_block(self, names: Sequence[str], rows: Sequence[Sequence[float]], period: float) -> None:
        """Judge the samples of a block, which no look has seen."""
        if self._watched.isdisjoint(names):
            return
        start = self._rig.clock.now() - period * len(rows)
        for k, row in enumerate(rows):
            self._judge(start + k * period, dict(zip(names, row, strict=True)))

    def _judge(self, t: float, values: dict[str, float]) -> None:
        now = self._wall.now()
        for name in self._seen_at:
            if self._concerned[name] & self._watched <= values.keys():
                self._seen_at[name] = now
        findings = self._core.judge(t, values, self._rig.setpoints, now=now, factor=self._factor)
        self._news += news_of(findings)

    def _line_was_away(self, name: str, seconds: float, why: str) -> None:
        text = f"{name}: line lost for {seconds:.1f} s: {why}"
        self._news.append(News("WARN", "line", text))
        self._box.note("line", text=text)

    # The safe state

    def _keep_safe(self, now: float) -> None:
        """Bring the devices into the safe state, and try again those that are not."""
        if self._ending is None:
            # What makes safe comes before every record of it.
            self._lines.end()
            self._stages = stages(self._rig)
            self._ending = now
            self._next_stage(now, _SAFE_WITHIN)
            cause = self._core.cause
            self._box.note("safe", cause=None if cause is None else str(cause))
            if self._core.late and self._writes_stacks:
                # It writes the stacks of its threads (`faulthandler`) into the folder of the run.
                self._process.send(STACKS)
        if self._stages and (not self._pending or now >= self._next_try):
            self._next_stage(now, self._ending + _SAFE_WITHIN - now)
        complete = not self._pending and not self._stages
        if self._safe is None and (complete or now - self._ending >= _SAFE_WITHIN):
            self._safe = self._states()
            self._news += counted(self._rig.devices.values(), self._lines.late)
            self._next_try = now + _TRY_AGAIN
        if self._safe is not None:
            if self._unsafe and now >= self._next_try:
                self._next_try = now + _TRY_AGAIN
                self._make_safe([name for name in self._unsafe if name not in self._pending])
            self._report()
            self._speak_for_bench(now)
            self._end_bench(now)

    def _next_stage(self, now: float, left: float) -> None:
        # One that is silent leaves time to those after it.
        self._next_try = now + left / len(self._stages)
        self._make_safe(self._stages.pop(0))

    def _make_safe(self, names: list[str]) -> None:
        for name in names:
            self._submit(SAFE, name, self._rig.devices[name].safe, self._is_safe)
            self._pending.add(name)

    def _is_safe(self, result: Result) -> None:
        self._pending.discard(result.device)
        if result.error is None:
            self._unsafe.pop(result.device, None)
        else:
            self._unsafe[result.device] = f"{type(result.error).__name__}: {result.error}"
        self._box.note("device", device=result.device, state=self._unsafe.get(result.device, IS_SAFE))

    def _states(self) -> dict[str, str]:
        return {name: self._unsafe.get(name, IS_SAFE) for name in self._rig.devices}

    def _report(self) -> None:
        """Answer a request that is open: with the end that it asked for, or with what has tripped the station."""
        if self._request is None:
            return
        assert self._safe is not None
        if self._request.get("do") == "end":
            self._reply(self._request, self._safe)
            self._reported = True
        else:
            self._refuse(self._request, self._core.cause or GuardianError("the run has ended already"))

    # A bench that cannot speak for itself

    @property
    def _owes_word(self) -> bool:
        """Whether it is the guardian who has to say how the run has ended, if the bench does not come back."""
        return self._keeps_record and not self._reported and self._told is None

    def _speak_for_bench(self, now: float) -> None:
        """Say that the bench hung or is gone, once."""
        if not self._owes_word or self._request is not None:
            return
        if self._loss is not None:
            if self._process.has_died():
                fate = "the bench is gone: its process was killed, crashed or left"
            elif now - self._lost_at < _DIES:
                return
            else:
                fate = str(self._loss)
        elif self._core.is_late(now):
            fate = self._core.lateness
        else:
            return
        assert self._safe is not None
        cause = self._core.cause
        reason = fate if cause in (None, self._loss) or str(cause) == fate else f"{cause}; then {fate}"
        t = self._rig.clock.now() - self._zero
        self._told = now
        self._box.note(FAILED, reason=reason, safe=self._safe)
        notifier = self._notifier
        notifier.signals = tuple(self._values)
        notifier.telemetry(t, 0, tuple(self._values.values()))
        notifier.event(Event(t, "ERROR", "error", f"{reason}; {in_words(self._safe)}"))
        notifier.event(Event(t, "WARN", "end", "failed"))
        notifier.start()

    def _end_bench(self, now: float) -> None:
        """End the process of a bench that hung and has not come back: ask it first, then kill it."""
        if self._told is None or not self._bench_is_there or not self._core.is_late(now):
            return
        if not self._is_asked_to_end and now - self._told >= _COMES_BACK:
            self._is_asked_to_end = True
            self._news.append(News("ERROR", "guardian", f"{self._core.lateness}; it was asked to end by SIGTERM"))
            self._box.note("ends the bench", by="SIGTERM")
            self._process.send(signal.SIGTERM)
        elif now - self._told >= _COMES_BACK + _ENDS:
            self._box.note("ends the bench", by="SIGKILL")
            self._process.send(SIGKILL)
            self._lose_bench("it hung, and was killed")

    # Devices

    def _start(
        self,
        priority: int,
        calls: Mapping[str, Callable[[], Any]],
        done: Callable[[dict[str, Any]], None],
        failed: Callable[[BaseException], None],
    ) -> _Job:
        """Have something done by several devices; return what the results are collected in."""
        job = _Job(set(calls), done, failed)
        for name, call in calls.items():
            self._submit(priority, name, call, partial(self._take_part, job))
        if not calls:
            self._results.put((partial(self._take_part, job), _NOTHING))
            self._wake_main()
        return job

    def _submit(self, priority: int, device: str, call: Callable[[], Any], take: Callable[[Result], None]) -> None:
        """Have something done on the line of a device; `take` is called by the main loop with what came of it."""
        self._lines.submit(priority, device, call, partial(self._hand_over, take))

    def _hand_over(self, take: Callable[[Result], None], result: Result) -> None:
        # In the thread of a line.
        self._results.put((take, result))
        self._wake_main()

    def _wake_main(self) -> None:
        with suppress(OSError):
            self._wake.send(b"\0")

    def _wake_up(self) -> None:
        with suppress(OSError):
            self._woken.recv(4096)
        while not self._results.empty():
            take, result = self._results.get()
            # One that cannot be used must not keep back those after it.
            try:
                take(result)
            except Exception as error:
                self._core.trip(_as_bench_error(error))

    def _take_part(self, job: _Job, result: Result) -> None:
        if job.error is not None:
            return
        if result.error is not None:
            # At once: what the others say does not matter any more, and one of them may take long.
            cause = self._core.cause
            job.error = cause if cause is not None and isinstance(result.error, NotAskedError) else result.error
            job.failed(job.error)
            return
        job.waiting.discard(result.device)
        job.values[result.device] = result.value
        job.was_late = job.was_late or result.was_away
        if job.waiting:
            return
        try:
            job.done(job.values)
        # A derived signal, say, that cannot be computed.
        except Exception as error:
            job.failed(error)

    def _terminate(self, _number: int, _frame: object) -> None:
        self._terminated = True


_REQUESTS: Mapping[str, Callable[[Guardian, Message], None]] = {
    "promise": Guardian._promise,
    "record": Guardian._keep_record,
    "look": Guardian._look,
    "apply": Guardian._apply,
    "check": Guardian._check,
    "rest": Guardian._rest,
    "tare": Guardian._tare,
    "arrivals": Guardian._arrivals,
    "can-play": Guardian._can_play,
    "play": Guardian._play,
    "operate": Guardian._operate,
}


def stages(rig: Rig) -> list[list[str]]:
    """Return which devices are made safe at the same time: the ordered ones one after another, all others at once."""
    order = rig.file.safety.order
    others = [name for name in rig.devices if name not in order]
    return [[*order[:1], *others], *([name] for name in order[1:])]


def _as_bench_error(error: BaseException) -> BenchError:
    if isinstance(error, BenchError):
        return error
    return GuardianError(f"the guardian failed: {type(error).__name__}: {error}")
