"""Random and mutated frames for the wire servers of every emulated laboratory, in process.

    python tools/fuzz_instruments.py --frames 100000 --instrument all --seed 0

Checks: no exception escapes and no instrument says that it failed; every answer is a whole frame of the protocol;
what a server keeps of unfinished frames stays short; after garbage a request is answered properly; an input costs
bounded CPU time; the state stays finite and within the instrument's ranges.
"""

import argparse
import hashlib
import logging
import math
import random
import signal
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dialects import Dynamixel, MalformedError, MeCom, ModbusRtu, ModbusTcp, Scpi, SlcanCanopen, reads, writes

from bench.base import VirtualClock
from bench.rig import load_rig
from rigs.hybrid.laboratory import HybridLaboratory
from rigs.muscles.laboratory import LOAD, STAGE, SMALaboratory
from rigs.vo2.laboratory import VO2Laboratory
from sim_devices.instruments.dynamixel_table import ITEMS
from sim_devices.instruments.meerstetter_table import PARAMETERS
from sim_devices.wire import WireServer
from sim_devices.wire.modbus_tcp import FramingError

MOST_KEPT = 4096
"""Bytes of unfinished frames that a server may keep."""
LONGEST_CALL = 10.0
"""CPU time of one input, s: the longest burst of a T7 takes 16384 conversions of each of 14 inputs."""
PROBED_EVERY = 20
"""Inputs between two probes, each followed by a look at the state."""
PAUSES = (0.0, 0.0, 1e-4, 1e-3, 1e-2, 0.1, 0.35)
LONG_PAUSE = 6.0  # longer than the watchdogs of the rigs

T7_ADDRESSES = (
    *range(28), *range(1000, 1004), *range(2000, 2023), 2800, 2850, 2900, 4008, 4010, *range(7000, 7028),
    7300, 7600, *range(9000, 9028), *range(9300, 9328), *range(10200, 10228), *range(30000, 30046),
    *range(40000, 40028), *range(41000, 41014), *range(41500, 41514), *range(42000, 42028), 55000, 55100, 55124,
    60000, 60004, 60028, *range(61600, 61654),
)  # fmt: skip
DAD_ADDRESSES = (
    *range(0x2000, 0x2004), *range(0x2020, 0x2036), 0x2060, 0x2061, 0x2061, 0x2066, *range(0x2080, 0x2088), 0x2106,
    0x2110, 0x2112, 0x2114, 0x2118, 0x220C, 0x220E, 0x2214, 0x2216, *range(0x3300, 0x3305), *range(0x3500, 0x3505),
)  # fmt: skip
T7_ACTING = (
    *writes(9000, "I", 3), *writes(9300, "I", 1, 200, 16384), *writes(10200, "f", 6000.0, 1e5, 1e-3, 1e30),
    reads(7000, 2), reads(7000, 28), reads(0, 28), *writes(1000, "f", 2.5, 1e9), *writes(2000, "H", 0, 1),
    *writes(30000, "f", 5.0, -1e9), *writes(30002, "f", 5.0), *writes(2004, "H", 0, 1),
    *writes(61600, "I", 0, 0, 1, 1), *writes(61604, "I", 1, 5), *writes(61610, "I", 0, 1), *writes(61640, "I", 1),
    *writes(61642, "f", 3.0), *writes(61630, "I", 1), *writes(61614, "I", 0),
)  # fmt: skip
DAD_ACTING = (
    reads(0x3500, 5), *writes(0x2061, "H", 1, 2, 4, 8, 0x10, 0x20, 0x3F), *writes(0x2066, "H", 4, 0x17),
    *writes(0x2106, "I", *range(8)), *writes(0x2114, "I", 1, 65535),
)  # fmt: skip


class FailedError(Exception):
    """An instrument did not bear what it was sent."""


@dataclass
class Target:
    """One instrument of a laboratory, and how to talk to it."""

    laboratory: Callable[[Any, VirtualClock, int], Any]
    dialect: Any
    check_state: Callable[[Any], None]
    prepare: Callable[[Any, random.Random], None] = lambda *_: None


@dataclass
class Outcome:
    """What a run of the fuzzer did."""

    frames: int = 0
    answers: int = 0
    closed: int = 0
    longest_call: float = 0.0
    digest: Any = field(default_factory=hashlib.sha256)


def within(name, value, low, high):
    if not low <= value <= high:
        raise FailedError(f"{name}: {value} is not within {low} and {high}")


def check_tec(tec):
    for number, row in PARAMETERS.items():
        value = tec._read(number)
        within(f"parameter {number}", value, row.low, row.high)
        if not math.isfinite(value):
            raise FailedError(f"parameter {number}: {value}")
    within("current", tec._load.current, -4.0 - 1e-9, 4.0 + 1e-9)
    within("plate temperature", tec._load.plate_temperature, -273.15, 1000.0)


def check_t7(t7):
    for number in (0, 1):
        within("DAC", t7.dac_volts(number), 0.0, 5.0)
    for number in range(23):
        within("TDAC", t7.tdac_volts(number), -10.0, 10.0)
    for number in range(14):
        within("AIN", t7.convert(number), -10.6, 10.6)


def check_cell(cell):
    within("gross weight", cell.read_value("gross weight"), -200.0, 200.0)
    within("filter", cell.read_value("filter"), 0, 7)
    within("range", cell.read_value("motion_range"), 1, 65535)


def check_servo(servo):
    within("angle", servo.position, -1e7, 1e7)
    for address, item in ITEMS.items():
        if item.writable and address != 98:
            within(f"item {address}", servo._values[address], item.low, item.high)
    within("watchdog", servo._values[98], -1, 127)
    within("temperature", servo._temperature, 0.0, 200.0)


def check_supply(supply):
    within("power", supply.power, -1000, 1000)
    within("voltage", supply.voltage, -60.0, 60.0)
    within("current", supply._load.current, -100.0, 100.0)


def change_load(laboratory, rng):
    """Have the operator of a muscle hang a load, or fasten the muscle to the stage."""
    if rng.random() < 0.5:
        laboratory.operate(LOAD, rng.choice((0.0, 2.0, 8.0)))
    else:
        laboratory.operate(STAGE, 0.0)


def make(laboratory):
    return lambda clock, seed: laboratory(laboratory.Settings(), clock, seed)


T7 = ModbusTcp(T7_ADDRESSES, T7_ACTING, reads(55100, 2), bytes.fromhex("00112233"))  # the register TEST
WITNESS = ModbusTcp(range(8), [reads(0, 4)], reads(0, 4))
SMA = make(SMALaboratory)
QUESTIONS = ("MEAS:VOLT?", "MEAS:CURR?", "VOLT?", "VOLT? MAX", "OUTP?", "SYST:ERR?", "*IDN?")
SUPPLY = Scpi(QUESTIONS, ("VOLT {}", "OUTP ON", "OUTP OFF", "CURR 1.5"))
METER = Scpi(("READ?", "SYST:ERR?", "*IDN?"), ("CONF:TEMP TC,K",))
BENCH_SUPPLY = Path(__file__).parents[1] / "examples" / "bench-supply.toml"


def make_bench_supply(clock, seed):
    """Return the laboratory of text instruments of the example."""
    file = load_rig(str(BENCH_SUPPLY))
    return file.laboratory(file.laboratory_settings, clock, seed)


def check_text_instrument(instrument):
    for name, value in instrument.measure().items():
        within(name, value, -1e3, 1e3)
    within("output", instrument.output, 0.0, 12.0)


# By the rig and the port of the instrument in its laboratory.
TARGETS = {
    "vo2/tec": Target(make(VO2Laboratory), MeCom(), check_tec),
    "vo2/psd": Target(make(VO2Laboratory), T7, check_t7),
    "hybrid/tec": Target(make(HybridLaboratory), MeCom(), check_tec),
    "hybrid/t7": Target(make(HybridLaboratory), T7, check_t7),
    "hybrid/witness": Target(make(HybridLaboratory), WITNESS, lambda _: None),
    "bench-supply/supply": Target(make_bench_supply, SUPPLY, check_text_instrument),
    "bench-supply/meter": Target(make_bench_supply, METER, check_text_instrument),
    "sma/t7": Target(SMA, T7, check_t7, change_load),
    "sma/supply": Target(SMA, SlcanCanopen(), check_supply, change_load),
    "sma/load_cell": Target(SMA, ModbusRtu(DAD_ADDRESSES, DAD_ACTING), check_cell, change_load),
    "sma/stage": Target(SMA, Dynamixel(), check_servo, change_load),
}


def mutated(dialect, rng):
    """Return bytes that are more or less requests."""
    kind = rng.randrange(12)
    if kind < 4:
        return dialect.request(rng)
    if kind < 6:
        return dialect.wild(rng)
    if kind == 6:
        return rng.randbytes(rng.choice((1, 7, 60, 300)) if rng.random() < 0.99 else 5000)
    frame = bytearray(dialect.request(rng) if rng.random() < 0.7 else dialect.wild(rng))
    if kind == 7:
        for _ in range(rng.randrange(1, 4)):
            frame[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
    elif kind == 8:
        del frame[rng.randrange(len(frame)) :]
    elif kind == 9:
        position = rng.randrange(len(frame))
        if rng.random() < 0.5:
            del frame[position : position + rng.randrange(1, 4)]
        else:
            frame[position:position] = rng.randbytes(rng.randrange(1, 4))
    elif kind == 10:
        frame *= rng.randrange(2, 5)
    else:
        for _ in range(rng.randrange(1, 5)):
            frame += rng.randbytes(rng.choice((0, 0, 3))) + mutated(dialect, rng)
    return bytes(frame)


def pieces(data, rng):
    """Return data as a line may deliver it: whole, cut somewhere, or by single bytes."""
    kind = rng.randrange(4)
    if kind < 2 or len(data) > 400:
        return [data]
    if kind == 2:
        cuts = sorted(rng.randrange(len(data) + 1) for _ in range(rng.randrange(1, 4)))
        return [data[begin:end] for begin, end in zip([0, *cuts], [*cuts, len(data)], strict=True)]
    return [data[index : index + 1] for index in range(len(data))]


def kept(server):
    """Return how many bytes a server keeps between two calls."""
    # Behind the faults of its line is the instrument's own server.
    kept = [*vars(server).values(), *vars(getattr(server, "_inner", server)).values()]
    return sum(len(value) for value in kept if isinstance(value, bytes | bytearray))


@contextmanager
def bounded():
    """End an input that takes more than its CPU time, where the system can; yields what begins its time again."""
    if not hasattr(signal, "setitimer"):
        yield lambda: None
        return

    def end(*_):
        raise FailedError(f"an input takes more than {LONGEST_CALL:g} s of CPU")

    before = signal.signal(signal.SIGVTALRM, end)
    try:
        yield lambda: signal.setitimer(signal.ITIMER_VIRTUAL, LONGEST_CALL)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


@contextmanager
def no_complaint():
    """Make every record of the emulators' log an error."""

    class Raising(logging.Handler):
        def emit(self, record):
            raise FailedError(record.getMessage()) from (record.exc_info[1] if record.exc_info else None)

    logger, handler = logging.getLogger("sim_devices"), Raising(logging.WARNING)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def fuzz(name, frames, seed, advanced=lambda _: None):
    """Send `frames` inputs to an instrument.

    Raises FailedError, MalformedError or what escapes from the instrument, with the last inputs as a note.
    """
    target = TARGETS[name]
    rng, outcome = random.Random(f"{name} {seed}"), Outcome()
    clock = VirtualClock()
    laboratory = target.laboratory(clock, seed)
    port = name.partition("/")[2]
    instrument = laboratory.instruments.get(port)
    server, of_server = connect(laboratory, port)
    recent = []

    def receive(data):
        nonlocal server
        recent.append(data)
        del recent[:-5]
        before = time.process_time()
        try:
            answer = server.receive(data)
        except FramingError:
            server, _ = connect(laboratory, port)
            outcome.closed += 1
            answer = b""
        outcome.longest_call = max(outcome.longest_call, time.process_time() - before)
        outcome.digest.update(answer)
        return answer

    try:
        with no_complaint(), bounded() as begin_anew:
            while outcome.frames < frames:
                begin_anew()
                if outcome.frames % PROBED_EVERY == 0:
                    target.prepare(laboratory, rng)
                outcome.answers += target.dialect.check(
                    b"".join(receive(piece) for piece in pieces(mutated(target.dialect, rng), rng))
                    + (of_server.unsolicited() if of_server else b"")
                )
                outcome.frames += 1
                clock.sleep(rng.choice(PAUSES) if rng.random() < 0.99 else LONG_PAUSE)
                if kept(server) > MOST_KEPT:
                    raise FailedError(f"{kept(server)} bytes are kept")
                if outcome.frames % PROBED_EVERY == 0:
                    if rng.random() < 0.3:
                        receive(target.dialect.restoring(rng))
                    clock.sleep(0.5)  # a servo that restarts does not answer for 0.3 s
                    if of_server is None:
                        # Where a frame on TCP begins can be known on a new connection only.
                        server.close()
                        server, _ = connect(laboratory, port)
                    probe(target.dialect, rng, receive)
                    target.check_state(instrument)
                    advanced(outcome.frames)
    except Exception as error:
        error.add_note(f"{name}, seed {seed}, frame {outcome.frames}; the last inputs:")
        for data in recent:
            error.add_note(f"  {data[:300]!r}")
        raise
    return outcome


def probe(dialect, rng, receive):
    """Check that a request is answered properly."""
    request, check = dialect.probe(rng)
    for trial in range(1, dialect.trials + 1):
        try:
            check(receive(request))
        except MalformedError:
            if trial == dialect.trials:
                raise
        else:
            return


def connect(laboratory, port):
    """Return what takes the bytes of a client, and the server if the line is a serial one."""
    server = laboratory.servers[port]
    if isinstance(server, WireServer):
        return server, server
    return server.connect(), None


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100_000, help="inputs for each instrument")
    parser.add_argument("--instrument", default="all", choices=["all", *TARGETS], help="which one")
    parser.add_argument("--seed", type=int, default=0, help="seed of inputs and laboratories")
    options = parser.parse_args()
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    names = list(TARGETS) if options.instrument == "all" else [options.instrument]
    columns = TextColumn("{task.description:14}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    failed = 0
    with Progress(*columns) as progress:
        for name in names:
            task = progress.add_task(name, total=options.frames)
            begin = time.process_time()
            try:
                outcome = fuzz(name, options.frames, options.seed, lambda n, t=task: progress.update(t, completed=n))
            except Exception:
                failed += 1
                progress.console.print_exception(max_frames=8)
                continue
            progress.console.print(
                f"{name}: {outcome.frames} inputs, {outcome.answers} answers, {outcome.closed} connections closed, "
                f"longest call {1e3 * outcome.longest_call:.1f} ms, {time.process_time() - begin:.0f} s of CPU, "
                f"sha256 {outcome.digest.hexdigest()[:16]}"
            )
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
