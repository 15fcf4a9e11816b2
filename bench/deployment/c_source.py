"""C99 from templates: numbers of a model as constants, and names with its prefix."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from bench.base import ConfigurationError, DataError

Real: TypeAlias = Literal["float", "double"]
Value: TypeAlias = "float | int | np.ndarray"

_FUNCTIONS = ("SQRT", "TANH", "ATANH", "EXP", "EXPM1", "LOG1P", "POW", "CEIL", "LOG")
_LITERAL = re.compile(r"(?<![\w.])(\d+\.\d*(?:e[+-]?\d+)?|\d+e[+-]?\d+)(?![\w.])")
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
# Values in a line of an array. Derivation: eight floats with their commas stay within 118 characters.
_ROW = 8


@dataclass(frozen=True)
class Source:
    """The C of an operator, or of a whole model.

    Attributes
    ----------
    states : str
        Types of the header.
    functions : str
        Prototypes of the header.
    code : str
        The rest.
    constants, state, machine : int
        Bytes of the constants, of a state, and of the machine code on a Cortex-M4.
    step, inverse : str
        The most that a step and an inverse do, in words.
    """

    states: str
    functions: str
    code: str
    constants: int
    state: int
    machine: int
    step: str
    inverse: str


def parts_of(template: str) -> dict[str, str]:
    """Return the parts of a template of the runtime, by the names after their dashes; the first is `head`."""
    text = files("bench.deployment").joinpath("runtime", template).read_text(encoding="utf-8")
    pieces = re.split(r"^/\*--- (\w+) ---\*/\n", text, flags=re.MULTILINE)
    return {"head": pieces[0], **dict(zip(pieces[1::2], pieces[2::2], strict=True))}


def rendered(text: str, real: Real, prefix: str, base: str, words: Mapping[str, object] | None = None) -> str:
    """Return a template with its words, names, types and numbers filled in."""
    for name, value in (words or {}).items():
        text = re.sub(rf"@{name}\b", lambda _, value=value: str(value), text)  # type: ignore[misc]
    if real == "float":
        text = _outside_comments(text, lambda code: _LITERAL.sub(r"\1f", code))
    for function in _FUNCTIONS:
        text = re.sub(rf"\b{function}\(", function.lower() + ("f(" if real == "float" else "("), text)
    text = _outside_comments(text, lambda code: re.sub(r"\breal\b", "BASE_real", code))
    return text.replace("OP_", f"{prefix}_").replace("BASE_", f"{base}_")


def _outside_comments(text: str, change: object) -> str:
    pieces, end = [], 0
    for comment in _COMMENT.finditer(text):
        pieces += [change(text[end : comment.start()]), comment.group()]  # type: ignore[operator]
        end = comment.end()
    return "".join([*pieces, change(text[end:])])  # type: ignore[operator]


def constants(values: Mapping[str, Value], real: Real) -> tuple[str, int]:
    """Return declarations `static const real OP_NAME` (`int` for whole numbers), and their size in bytes."""
    lines, size = [], 0
    for name, value in values.items():
        numbers = np.asarray(value)
        kind = "int" if numbers.dtype.kind in "iu" else "real"
        size += numbers.size * (4 if kind == "int" or real == "float" else 8)
        places = "".join(f"[{count}]" for count in numbers.shape)
        lines.append(f"static const {kind} OP_{name}{places} = {_text(numbers, real)};")
    return "\n".join(lines) + "\n", size


def compile_library(what: str, sources: Sequence[Path], library: Path, *options: str) -> None:
    """Compile C99 to a shared library.

    Parameters
    ----------
    what : str
        Who needs it, for the message.
    sources : sequence of Path
        The files.
    library : Path
        The file to write.
    options : str
        Further options of the compiler.

    Raises
    ------
    ConfigurationError
        If there is no compiler of C.
    DataError
        If it fails.
    """
    compiler = shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise ConfigurationError(f"{what}: no compiler of C was found; install the Debian package gcc")
    command = [
        compiler,
        "-std=c99",
        "-O2",
        "-fPIC",
        "-shared",
        *options,
        "-o",
        str(library),
        *map(str, sources),
        "-lm",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        raise DataError(f"{what}: {compiler} failed: {done.stderr.strip()}")


def _text(numbers: np.ndarray, real: Real) -> str:
    if numbers.ndim == 0:
        return _number(numbers, real)
    if numbers.ndim == 1:
        texts = [_number(value, real) for value in numbers]
        rows = [", ".join(texts[at : at + _ROW]) for at in range(0, len(texts), _ROW)]
        return "{" + ",\n    ".join(rows) + "}"
    return "{" + ",\n    ".join(_text(row, real) for row in numbers) + "}"


def _number(value: np.ndarray, real: Real) -> str:
    if value.dtype.kind in "iu":
        return str(int(value))
    text = str(np.float32(value)) if real == "float" else repr(float(value))
    return text if re.search(r"[.e]", text) else text + ".0"
