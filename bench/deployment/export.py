"""A model file as C99: header, source, example and README in a folder."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.base import ConfigurationError, DataError, json_text
from bench.deployment.c_source import Real, Source, parts_of, rendered
from bench.deployment.compositions import COUPLED, hammerstein_source
from bench.deployment.controller import Controller, with_controller
from bench.deployment.operators import Starts, operator_source, why_not
from bench.deployment.specimen import specimen_source
from bench.identification import ModelFile
from bench.models import Coupled, Hammerstein, Operator
from bench.specimen import TwinTable

_RESOLVED = 2e-6
"""Greatest step of `float` as a part of a range. Derivation: five such roundings are the 1e-5 that float promises."""
_MATH = re.compile(r"\b(sqrt|tanh|atanh|exp|expm1|log1p|pow|ceil|log|cos|fabs)f?\(")


@dataclass(frozen=True)
class Deployment:
    """A model as C99.

    Attributes
    ----------
    name : str
        Prefix of the functions, and name of the files.
    files : mapping of str to str
        Texts by name of file.
    constants, code, state : int
        Bytes of the constants, of the machine code (about, on a Cortex-M4), and of one state.
    digest : str
        SHA-256 of the model, hexadecimal.
    """

    name: str
    files: Mapping[str, str]
    constants: int
    code: int
    state: int
    digest: str

    def write(self, folder: Path) -> None:
        """Write the files into a folder, which is made.

        Raises DataError if they cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for name, text in self.files.items():
                (folder / name).write_text(text, encoding="utf-8")
        except OSError as error:
            raise DataError(f"--c {folder} cannot be written: {error.strerror}") from None


def deploy(
    file: ModelFile,
    *,
    name: str = "model",
    real: Real = "float",
    period: float | None = None,
    max_bytes: int | None = None,
    controller: Controller | None = None,
    specimen: TwinTable | None = None,
) -> Deployment:
    """Return a model, its inverse and its memory as C99.

    Parameters
    ----------
    file : ModelFile
        The model.
    name : str
        Prefix of the functions, and name of the files; an identifier of C.
    real : {"float", "double"}
        Type of the numbers.
    period : float, optional
        Time of a step, s, for which the linear part of a model with time is discretized.
    max_bytes : int, optional
        Most bytes of code and constants.
    controller : Controller, optional
        What makes the output follow a reference, beside the model.
    specimen : TwinTable, optional
        The specimen of a twin, whose model it is, in the place of the model; in `double`.

    Raises
    ------
    ConfigurationError
        If the name is no identifier, the period does not suit the model, or more bytes are needed.
    DataError
        If the model cannot be exported, or its numbers need `double`; the message says why.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ConfigurationError(f"--name {name!r}: expected letters, digits and _, a letter first")
    source = _source(file, real, period, name) if specimen is None else specimen_source(specimen, name)
    if controller is not None:
        source = with_controller(source, file, controller, real, name)
    _check_size(file, source, real, max_bytes)
    digest = hashlib.sha256(json_text(file.model.to_json()).encode()).hexdigest()
    words = _words(file, source, digest, name, real)
    parts = {
        template: rendered(parts_of(template)["head"], real, name, name, words)
        for template in ("model.h.in", "model.c.in", "saved.c.in", "main.c.in")
    }
    files = {
        f"{name}.h": parts["model.h.in"],
        f"{name}.c": parts["model.c.in"] + source.code + parts["saved.c.in"],
        "main.c": parts["main.c.in"],
        "README.md": _readme(file, source, words),
    }
    if controller is not None:
        words |= {"controller": controller.name, "period": repr(controller.period)}
        files["board.c"] = rendered(parts_of("board.c.in")["head"], "double", name, name, words)
    return Deployment(
        name,
        files,
        source.constants,
        source.machine,
        source.state,
        digest,
    )


def _source(file: ModelFile, real: Real, period: float | None, name: str) -> Source:
    model = file.model
    if period is not None:
        if not isinstance(model, Hammerstein):
            raise ConfigurationError(f"--period {period:g}: model {file.name} has no linear part to discretize")
        if not 0.0 < period < np.inf:
            raise ConfigurationError(f"--period {period:g}: expected a positive time, s")
    for what, (low, high), unit in ranges_of(model):
        resolved = float(np.spacing(np.float32(max(abs(low), abs(high))))) / (high - low) if high > low else 0.0
        if real == "float" and resolved > _RESOLVED:
            raise DataError(
                f"model {file.name}: the {what}, {low:.6g} to {high:.6g} {unit}".rstrip()
                + f", is resolved in float to {resolved:.1e} of its range only; export it with --real double"
            )
    if (coupled := COUPLED.get(type(model))) is not None:
        return coupled.source(model, real, name)
    if isinstance(model, Hammerstein):
        return hammerstein_source(model, starts_of(file, model.static), real, period, name)
    if not isinstance(model, Operator):
        raise DataError(why_not(model))
    return operator_source(model, starts_of(file, model), real, name, name)


def starts_of(file: ModelFile, operator: Operator[Any]) -> Starts:
    """Return the states from which the operator of a model may start."""
    initial, memory = (
        state.memory if isinstance(file.model, Hammerstein) and state is not None else state
        for state in (file.initial, file.memory)
    )
    first = operator.initial_state() if initial is None else initial
    last = first if memory is None else memory
    return last, first, operator.saturated_state(-1), operator.saturated_state(1)


def ranges_of(model: Any) -> list[tuple[str, tuple[float, float], str]]:  # noqa: ANN401 - any registered model
    """Return the inputs and outputs of a model: what, range, unit."""
    if (coupled := COUPLED.get(type(model))) is not None:
        return list(zip(("voltage", "force", "length"), coupled.ranges(model), model.units, strict=True))
    operator = model.static if isinstance(model, Hammerstein) else model
    if not isinstance(operator, Operator):
        raise DataError(why_not(model))
    return [
        ("input", operator.input_range, operator.input_unit),
        ("output", operator.output_range(), operator.output_unit),
    ]


def _check_size(file: ModelFile, source: Source, real: Real, max_bytes: int | None) -> None:
    """Raise ConfigurationError if code and constants need more bytes than there are."""
    needed = source.constants + source.machine
    if max_bytes is None or needed <= max_bytes:
        return
    remedy = "identify it with fewer levels" if file.model.densities() else "identify a smaller model"
    if real == "double":
        remedy += ", or export it with --real float"
    raise ConfigurationError(
        f"--max-bytes {max_bytes}: model {file.name} needs {needed} bytes in {real}, {source.constants} of constants "
        f"and about {source.machine} of code; {remedy}"
    )


def _words(file: ModelFile, source: Source, digest: str, name: str, real: Real) -> dict[str, object]:
    model, ranges = file.model, ranges_of(file.model)
    *inputs, (_, (least, greatest), output) = ranges
    coupled = isinstance(model, Coupled)
    force = getattr(model, "pretension", 0.0)
    return {
        "title": f"Model {file.name}, {model.kind}: from {' and '.join(_named(*each) for each in inputs)} to "
        f"{_named(*ranges[-1])}",
        "identity": f"SHA-256 of the model: {digest}",
        "guard": f"{name.upper()}_H",
        "type": real,
        "name": name,
        "hash": f"0x{digest[:8]}u",
        "states": source.states.rstrip() + "\n",
        "functions": source.functions,
        "math": "\n#include <math.h>\n\n" if _MATH.search(source.code) else "\n",
        "target": repr(0.5 * (least + greatest)),
        "input": inputs[0][2],
        "output": output,
        "load": f", {float(force)!r}" if coupled else "",
        "digest": digest,
    }


def _named(what: str, span: tuple[float, float], unit: str) -> str:  # noqa: ARG001
    return f"{what} in {unit}" if unit else what


def _readme(file: ModelFile, source: Source, words: Mapping[str, object]) -> str:
    *inputs, (_, (least, greatest), output) = ranges_of(file.model)
    rows = [
        ("model", f"{file.name}, {file.model.kind}"),
        ("SHA-256 of the model", f"`{words['digest']}`"),
        *((what, f"operating range {low:.6g} to {high:.6g} {unit}".rstrip()) for what, (low, high), unit in inputs),
        ("output", f"reachable {least:.6g} to {greatest:.6g} {output}".rstrip()),
        *_validity(file),
        ("numbers", f"`{words['type']}`"),
        ("constants", f"{source.constants} bytes"),
        ("code", f"about {source.machine} bytes (Cortex-M4, -O2, without the library of mathematics)"),
        ("state", f"{source.state} bytes; saved, 8 bytes more"),
        ("a step", source.step),
        *([("an inverse", source.inverse)] if source.inverse else []),
        *(
            (f"fit: {key}", str(value))
            for key, value in file.provenance.items()
            if isinstance(value, str | int | float)
        ),
    ]
    table = "\n".join(f"| {name} | {text} |" for name, text in rows)
    real: Real = "float" if words["type"] == "float" else "double"
    name = str(words["name"])
    return rendered(parts_of("README.md.in")["head"], "double", name, name, {**words, "table": table, "type": real})


def _validity(file: ModelFile) -> list[tuple[str, str]]:
    if isinstance(file.model, Coupled):
        return []
    known, unit = file.valid, file.response.input_unit
    rows = [("fitted inputs", known.range_text(unit))]
    if known.moves is not None:
        rows.append(("fitted moves", known.moves_text(unit)))
    if known.rates is not None:
        rows.append(("fitted rates", known.rates_text(unit)))
    return rows
