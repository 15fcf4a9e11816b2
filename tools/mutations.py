"""Mutations of the files and lines that the bench reads: of bytes, of lines, and of the values of a document."""

import copy
import math
import random
import re
from collections.abc import Iterator
from typing import Any

EXTREMES = (
    "1e999", "-1e999", "1e308", "5e-324", "nan", "inf", "-inf", "NaN", "Infinity", "-1", "0", "-0.0", "9" * 400,
    "1" + "0" * 5000, "1_000", "1,5", "1.234,5", "1'000", "0x1F", "1e", "--1", "+", "１２", "٣", "1 2", "−1", "1d3",
    "true", "TRUE", "None", "", " ", "1\u00a0000", "½", "1e+400", "00012", ".5", "5.", "1.5.2",
)  # fmt: skip
"""Texts in the place of a number; some of them are numbers."""

STRANGE = (
    "\u202e", "\u2066", "\x1b[2J", "\x07", "\x00", "\x85", "\u2028", "\ufeff", "\x0b", "\x0c", "\x1c", "\u200b", "é",
    "\U0001f600", "\r", "\t", '"', "'", "\\", "#", ";", "%", "//", "\x7f", "\ud7ff",
)  # fmt: skip
"""Characters that command a terminal, change directions, end lines, or quote."""

ENCODINGS = ("utf-16", "utf-16-le", "utf-8-sig", "utf-32", "cp1252", "utf-7", "cp037", "shift_jis")

WRONG = (True, False, None, "1.0", "", "x", [], [1.0], {}, {"a": 1}, math.nan, math.inf, -math.inf, 10**400)
"""Values of another type, or not finite, in the place of a number."""


def mutated_bytes(content: bytes, rng: random.Random) -> bytes:
    """Return bytes with a mutation that knows nothing of their format."""
    data = bytearray(content)
    place = rng.randrange(len(data) + 1)
    kind = rng.randrange(7)
    if kind == 0 and data:
        for _ in range(rng.choice((1, 1, 2, 8))):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == 1:
        del data[place:]
    elif kind == 2:
        del data[place : place + rng.choice((1, 4, 100))]
    elif kind == 3:
        data[place:place] = rng.randbytes(rng.choice((1, 4, 100)))
    elif kind == 4:
        size = rng.choice((1, 16, 512))
        data[place : place + size] = bytes(len(data[place : place + size]))
    elif kind == 5:
        data += data[place:]
    else:
        return rng.choice((b"", b"\0", b"\r", b"\n", b'"', rng.randbytes(50)))
    return bytes(data)


def mutated_lines(text: str, rng: random.Random) -> bytes:
    """Return a text with a mutation of its lines or characters, encoded."""
    lines = text.splitlines(keepends=True)
    line, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    place = rng.randrange(len(lines[line]))
    kind = rng.randrange(13)
    if kind == 0:
        del lines[line]
    elif kind == 1:
        lines.insert(other, lines[line])
    elif kind == 2:
        lines.insert(other, lines[0])
    elif kind == 3:
        lines[line] = lines[line][:place] + rng.choice(STRANGE) + lines[line][place:]
    elif kind == 4:
        lines[line] = _with_number(lines[line], rng.choice(EXTREMES), rng)
    elif kind == 5:
        lines[line] = lines[line][:place] + '"' + lines[line][place:]
    elif kind == 6:
        lines[line] = lines[line].replace("\n", rng.choice(("\r", "\r\n", "\r\r\n", "\n\n", "\x85", "\u2028", "")))
    elif kind == 7:
        return text.replace("\n", rng.choice(("\r", "\r\n"))).encode()
    elif kind == 8:
        encoding = rng.choice(ENCODINGS)
        return text.encode(encoding, "replace")
    elif kind == 9:
        lines[line] = lines[line][:place] + rng.choice("a9 ,.") * rng.choice((300, 5000)) + lines[line][place:]
    elif kind == 10:
        lines[line] = lines[line].replace(".", ",")
    elif kind == 11:
        lines[line], lines[other] = lines[other], lines[line]
    else:
        lines[line] = lines[line][:place]
    return "".join(lines).encode("utf-8", "surrogatepass")


def _with_number(line: str, number: str, rng: random.Random) -> str:
    """Return a line with another text in the place of one of its numbers."""
    starts = [i for i, sign in enumerate(line) if sign.isdigit() and (i == 0 or line[i - 1] not in "0123456789.e-")]
    if not starts:
        return line
    start = rng.choice(starts)
    end = start
    while end < len(line) and line[end] in "0123456789.e":
        end += 1
    return line[:start] + number + line[end:]


def leaves(document: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield every value of a document that is neither a table nor a list, with its path."""
    if isinstance(document, dict | list):
        items = document.items() if isinstance(document, dict) else enumerate(document)
        for key, value in items:
            yield from leaves(value, (*path, key))
    else:
        yield path, document


def mutated_document(document: Any, rng: random.Random) -> Any:
    """Return a document with another value in one place, or with a table or list changed."""
    changed = copy.deepcopy(document)
    path, value = rng.choice(list(leaves(document)))
    depth = rng.randrange(len(path))
    table = changed
    for key in path[: depth + 1][:-1]:
        table = table[key]
    key = path[depth]
    kind = rng.randrange(8)
    if kind < 4:
        for step in path[depth:-1]:
            table, key = table[key], path[path.index(step, depth) + 1]
        table = changed
        for step in path[:-1]:
            table = table[step]
        number = isinstance(value, int | float) and not isinstance(value, bool)
        table[path[-1]] = rng.choice(WRONG) if number or rng.random() < 0.5 else rng.choice(STRANGE) * 3
    elif kind == 4:
        del table[key]
    elif kind == 5:
        deep: Any = 1.0
        for _ in range(rng.choice((3, 300))):
            deep = [deep]
        table[key] = deep
    elif kind == 6 and isinstance(table, dict):
        table[rng.choice(("x", "", "a" * 3000, "\u202e", "__class__"))] = 1.0
    elif isinstance(table, list):
        table.append(table[key])
    else:
        table[key] = rng.choice(WRONG)
    return changed


def objections(template: Any, changed: Any, free: tuple[str, ...] = (), path: str = "") -> Iterator[str]:
    """Yield what a strict reader must refuse: other types, numbers that are not finite, new keys.

    Tables below a key of `free` may hold anything.
    """
    if path.rpartition(".")[2] in free:
        return
    if isinstance(template, dict):
        if not isinstance(changed, dict):
            yield f"{path}: not a table"
            return
        for key, value in changed.items():
            if key not in template:
                if key not in free:
                    yield f"{path}.{key[:30]}: a new key"
            else:
                yield from objections(template[key], value, free, f"{path}.{key}")
    elif isinstance(template, list):
        if not isinstance(changed, list):
            yield f"{path}: not a list"
            return
        for index, value in enumerate(changed):
            # Entries may come twice or change places, so that one counts which is like any of the template's.
            place = f"{path}[{index}]"
            yield from min(([*objections(entry, value, free, place)] for entry in template), key=len, default=[])
    elif isinstance(template, bool) or isinstance(changed, bool) or template is None:
        if type(template) is not type(changed) and template is not None:
            yield f"{path}: {changed!r} in the place of {template!r}"
    elif isinstance(template, int | float):
        if isinstance(changed, str) and re.fullmatch(r"-?\d+(\.\d+)?", changed, re.ASCII):
            # It is read as the number that it says.
            return
        if not isinstance(changed, int | float) or not _is_finite(changed):
            yield f"{path}: {str(changed)[:40]} in the place of a number"
    elif type(template) is not type(changed):
        yield f"{path}: {str(changed)[:40]} in the place of {template!r}"


def _is_finite(number: float) -> bool:
    try:
        return math.isfinite(number)
    except OverflowError:
        return False
