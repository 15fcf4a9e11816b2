"""Mutated lines: of an operator, between a panel and a run, to the control socket, and of instruments."""

import functools
import json
import math
import random
import re
from contextlib import closing
from pathlib import Path

from fuzz_instruments import TARGETS, fuzz
from mutations import EXTREMES, STRANGE, mutated_bytes, mutated_document, mutated_lines, objections

from bench.base import BenchError, Interrupts, VirtualClock
from bench.operator import PanelMailbox, Question, RunMailbox, SetPoint, parse_command
from bench.rig import Rig, RigFile, load_rig
from sim_devices.serving.requests import parse_request

COMMANDS = ("set tec 45.5", "ramp tec 60 0.5", "hold", "tare cell", "zero y", "safe", "note a lamp", "quit")
REQUESTS = (
    {"do": "help"}, {"do": "wait", "until": 3.5}, {"do": "advance", "seconds": 2.0, "rig": "vo2"},
    {"do": "fault", "fault": "tec.delay", "values": {"seconds": 0.5}, "duration": 2.0},
    {"do": "schedule", "faults": [{"fault": "tec.delay", "at": 1.0}]}, {"do": "events", "since": 3},
    {"do": "operate", "task": "load", "value": 2.0}, {"do": "fault", "fault": "tec.unplug"},
)  # fmt: skip
QUESTION = Question("text", title="title")


def try_command(_: Path, rng: random.Random) -> str:
    """Take a mutated line of an operator."""
    line = rng.choice(COMMANDS)
    if rng.random() < 0.5:
        words = line.split(" ")
        words[rng.randrange(len(words))] = rng.choice((*EXTREMES, *STRANGE))
        line = " ".join(words)
    else:
        line = mutated_lines(line + "\n", rng).decode("utf-8", "replace").rstrip("\n")
    try:
        command = parse_command(line)
    except BenchError:
        return ""
    if isinstance(command, SetPoint):
        numbers = [command.value] + [command.rate] * (command.rate != math.inf)
        words = line.split()
        said = [
            word
            for word in words[2:]
            if re.fullmatch(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?", word, re.ASCII | re.IGNORECASE)
        ]
        if (
            len(said) != len(words) - 2
            or [float(word.replace(",", ".")) for word in said] != numbers
            or not all(map(math.isfinite, numbers))
        ):
            return f"{line!r} is taken as {command}"
    return ""


def try_request(_: Path, rng: random.Random) -> str:
    """Take a mutated line of the control socket."""
    template = rng.choice(REQUESTS)
    line = json.dumps(mutated_document(template, rng) if rng.random() < 0.6 else template).encode(
        "utf-8", "surrogatepass"
    )
    if rng.random() < 0.5:
        line = mutated_bytes(line, rng)
    try:
        parse_request(line)
    except BenchError:
        return ""
    changed = json.loads(line)
    return (
        "; ".join(
            f"taken with {each}"
            for each in objections(template, changed, ("values", "rig", "do", "duration", "seed"))
        )
        if changed["do"] == template["do"]
        else ""
    )


def try_letter(folder: Path, rng: random.Random) -> str:
    """Read mutated letters between a run and a panel."""
    interrupts = Interrupts(lambda *_: None)
    run, panel = RunMailbox(folder, interrupts), PanelMailbox(folder)
    place = folder / "operator"
    place.mkdir()
    run.publish(QUESTION)
    number, asked = panel.question() or (0, None)
    if asked != QUESTION:
        return f"the question {QUESTION} arrives as {asked}"
    panel.reply(number, "yes")
    panel.request("pause")
    for file in list(place.iterdir()):
        content = file.read_bytes()
        if rng.random() < 0.6:
            document = json.loads(content)
            content = json.dumps(mutated_document(document, rng)).encode("utf-8", "surrogatepass")
        else:
            content = mutated_bytes(content, rng)
        file.write_bytes(content)
    answer, question = run.answer(), panel.question()
    if answer not in (None, "yes"):
        said = json.loads((place / "answer-1.json").read_bytes()).get("answer")
        if said != answer:
            return f"the answer {said!r} is taken as {answer!r}"
    if question is not None and not (isinstance(question[1].title, str) and isinstance(question[1].text, str)):
        return f"the question is taken as {question}"
    return ""


def try_port(_: Path, rng: random.Random) -> str:
    """Send an emulated instrument random and mutated requests."""
    fuzz(rng.choice(list(TARGETS)), 40, rng.randrange(1 << 30))
    return ""


CHECKED = {
    "vo2": {"tec": ("tec", "tec_temperature", 2.0)},
    "sma": {"load_cell": ("load_cell", "load_cell_force", 0.5), "stage": ("stage", "stage_position", 1e-3)},
}
"""Ports whose answers have a checksum, by rig: the device there, a signal, and how far it may wander at rest."""


@functools.cache
def rig_file(name: str) -> RigFile:
    """Return the file of an installed rig."""
    return load_rig(name, {})


def try_answer(_: Path, rng: random.Random) -> str:
    """Have a driver read an instrument whose answers are damaged: it is told, or the reading is right."""
    name = rng.choice(list(CHECKED))
    port, (device, signal, wander) = rng.choice(list(CHECKED[name].items()))
    with closing(Rig(rig_file(name), VirtualClock(), rng.randrange(1000))) as rig:
        right = rig.devices[device].measure()[signal]
        assert rig.laboratory is not None
        server = rig.laboratory.servers[port]
        answer_rightly = server.receive

        def receive(data: bytes) -> bytes:
            answer = answer_rightly(data)
            return mutated_bytes(answer, rng) if rng.random() < 0.3 else answer

        server.receive = receive
        for _ in range(6):
            try:
                read = rig.devices[device].measure()[signal]
            except BenchError:
                continue
            if not abs(read - right) <= wander:
                return f"{signal} is read as {read}; it is {right}"
        server.receive = answer_rightly
    return ""


KINDS = {
    "command": try_command, "request": try_request, "letter": try_letter, "port": try_port, "answer": try_answer,
}  # fmt: skip
