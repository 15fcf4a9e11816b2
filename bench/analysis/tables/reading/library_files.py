"""Contents of files that libraries read: in a process of its own, which a damaged file may end.

Run as a module with the name of a file it writes the contents, pickled, to its standard output.
"""

from __future__ import annotations

import math
import os
import pickle
import re
import subprocess
import sys
import warnings
from collections.abc import Mapping
from contextlib import suppress
from datetime import date, datetime
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.reading.text import WHAT_IS_READ, reading_errors
from bench.base import (
    ConfigurationError,
    DataError,
    Extra,
    MissingExtraError,
    check_extra,
    how_to_install,
    needed_for,
    parse_json,
)

HDF5 = b"\x89HDF"

SECONDS, SECONDS_PER_BYTE = 120.0, 1e-6
"""Time limit. Derivation: a hundred times what it takes on an idle machine."""

_KINDS: dict[str, tuple[str, str, Extra]] = {
    "MATLAB": ("a MATLAB file", "scipy", "files"),
    "HDF5": ("an HDF5 file", "h5py", "files"),
    "TDMS": ("a TDMS file", "nptdms", "files"),
    "Parquet": ("a parquet file", "pyarrow", "report"),
    "NumPy": ("a NumPy file", "numpy", "files"),
    "JSON": ("JSON", "json", "files"),
    "spreadsheet": ("a spreadsheet", "python_calamine", "files"),
}
"""By kind its words, the library that reads it, and the extra of that."""

_LEFT_OUT = "tables and strings of MATLAB left out"


def load_contents(path: Path, kind: str) -> tuple[Any, tuple[str, ...]]:
    """Return the contents of a file, and what was assumed.

    The contents of all but a `spreadsheet` are arrays by name, in mappings where they are grouped,
    with the unit at the end of a name. Those of a `spreadsheet` are lines of cells with tabs between them, by sheet.

    Raises DataError if the file cannot be read, ends the process that reads it, or takes too long; MissingExtraError
    if a library is not installed.
    """
    words, library, extra = _KINDS[kind]
    check_extra(f"reading {words}", library, extra)
    with reading_errors(path), path.open("rb") as file:
        limit = SECONDS + SECONDS_PER_BYTE * os.fstat(file.fileno()).st_size
    try:
        done = subprocess.run(  # noqa: S603 - our own module
            [sys.executable, "-m", __name__, kind, str(path)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=limit,
            check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        ended = f"the process that read it ended with code {done.returncode}" if done.returncode else ""
    except subprocess.TimeoutExpired:
        ended = f"it takes longer than {limit:.0f} s"
    if ended:
        raise DataError(f"{path} cannot be read as {words}: {ended}; it may be damaged: save it again, or as CSV")
    found, notes = pickle.loads(done.stdout)  # noqa: S301 - of our own process
    if isinstance(found, (DataError, ConfigurationError)):
        raise found
    return found, notes


def _load(kind: str, path: Path) -> tuple[Any, tuple[str, ...]]:
    try:
        with reading_errors(path):
            found = _LOADERS[kind](path)
    except (DataError, ConfigurationError) as error:
        return error, ()
    # A library that is written in Rust raises what is no Exception.
    except BaseException as error:
        return DataError(f"{path} cannot be read as {_KINDS[kind][0]}: {error}; {WHAT_IS_READ}"), ()
    if kind == "spreadsheet":
        return found, ()
    notes = (
        (f"{_LEFT_OUT}, which {how_to_install('files')} reads",)
        if isinstance(found, dict) and found.pop(_LEFT_OUT, None)
        else ()
    )
    return arrays_of(found), notes


def arrays_of(value: Any) -> Any:  # noqa: ANN401
    """Return arrays of numbers or moments, in mappings; None for what has none."""
    if hasattr(value, "columns") and hasattr(value, "to_numpy"):
        value = {str(name): value[name].to_numpy() for name in value.columns}
    if isinstance(value, Mapping):
        parts = {str(name): arrays_of(part) for name, part in value.items()}
        return {name: part for name, part in parts.items() if part is not None} or None
    array = np.squeeze(np.asarray(value))
    if array.dtype.names and (labelled := _by_label(array)):
        return labelled
    if array.dtype.names and array.size == 1:
        return arrays_of({name: array[name].item() for name in array.dtype.names})
    if array.dtype.names:
        return arrays_of({name: array[name] for name in array.dtype.names})
    if array.dtype == object and array.size > 1:
        return _of_cells(array)
    if array.dtype.kind == "U" and array.size > 1 and ":" in array.flat[0]:
        with suppress(ValueError):
            array = array.astype("datetime64[us]")
    if array.dtype.kind == "M":
        return np.atleast_1d(array)
    return np.atleast_1d(array).astype(np.float64) if array.dtype.kind in "fiub" and array.ndim <= 2 else None


def _by_label(structures: npt.NDArray[Any]) -> dict[str, Any]:
    """Return the vectors of structures that have one beside its name and unit, as of Simulink and dSPACE."""
    found = {}
    for structure in structures.flat:
        parts = {name.lower(): np.squeeze(structure[name]) for name in structures.dtype.names or ()}
        texts = {name: str(part) for name, part in parts.items() if part.dtype.kind == "U" and part.size == 1}
        vectors = [part for part in parts.values() if part.dtype.kind in "fiu" and part.size > 1]
        label = texts.get("name") or texts.get("label")
        if not label or len(vectors) != 1:
            return {}
        found[_with_unit(label, texts.get("unit"))] = arrays_of(vectors[0])
    return found


def _of_cells(array: npt.NDArray[Any]) -> Any:  # noqa: ANN401
    """Return the numbers of cells as an array; if there are others, the arrays in them by their number."""
    parts = [arrays_of(cell) for cell in array.flat]
    if all(isinstance(part, np.ndarray) and part.size == 1 for part in parts):
        return np.reshape(np.concatenate(parts), array.shape)
    return {str(number): part for number, part in enumerate(parts, start=1) if part is not None} or None


def _matlab(path: Path) -> Any:  # noqa: ANN401
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque

    start = path.read_bytes()[:512]
    # MATLAB 7.3 writes HDF5 behind a head of its own.
    if HDF5 in start or start[124:126] in (b"\x00\x02", b"\x02\x00"):
        with needed_for("reading a MATLAB file of version 7.3", "files"):
            import matio
        return _of_user(matio.load_from_mat(str(path)))
    found = loadmat(str(path))
    if any(isinstance(value, MatlabOpaque) for value in found.values()):
        try:
            with needed_for("reading a table of MATLAB", "files"):
                import matio
            return _of_user(matio.load_from_mat(str(path)))
        except MissingExtraError:
            found = {name: value for name, value in found.items() if not isinstance(value, MatlabOpaque)}
            return {**_of_user(found), _LEFT_OUT: True}
    return _of_user(found)


def _of_user(found: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _hdf5(path: Path) -> Any:  # noqa: ANN401
    import h5py

    def contents(group: Any) -> dict[str, Any]:  # noqa: ANN401
        return {
            _with_unit(name, part.attrs.get("unit", part.attrs.get("units"))): (
                contents(part) if hasattr(part, "keys") else part[()]
            )
            for name, part in group.items()
        }

    with h5py.File(path, "r") as file:
        return contents(file)


def _tdms(path: Path) -> Any:  # noqa: ANN401
    from nptdms import TdmsFile

    found: dict[str, Any] = {}
    for group in TdmsFile.read(path).groups():
        channels = found.setdefault(group.name, {})
        for channel in group.channels():
            channels[_with_unit(channel.name, channel.properties.get("unit_string"))] = channel[:]
            if channel.properties.get("wf_increment") and len(channel):
                channels.setdefault("time [s]", channel.time_track())
    return found


def _parquet(path: Path) -> Any:  # noqa: ANN401
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.ParquetFile(path, page_checksum_verification=True).read()
    types, found = pa.types, dict[str, Any]()
    for name, column in zip(table.column_names, table.columns, strict=True):
        if types.is_timestamp(column.type):
            found[name] = column.cast(pa.timestamp("us")).to_numpy()
        elif any(is_kind(column.type) for is_kind in (types.is_integer, types.is_floating, types.is_decimal)):
            found[name] = column.cast(pa.float64()).to_numpy()
    return found


def _numpy(path: Path) -> dict[str, Any]:
    found = np.load(path, allow_pickle=False)
    return {path.stem: found} if isinstance(found, np.ndarray) else dict(found)


def _json(path: Path) -> dict[str, Any]:
    text = path.read_text("utf-8-sig")
    try:
        found = parse_json(text)
    except ValueError:
        found = [parse_json(line) for line in text.splitlines() if line.strip()]
    if isinstance(found, list) and all(isinstance(row, dict) for row in found):
        found = {name: [row.get(name) for row in found] for name in dict.fromkeys(chain.from_iterable(found))}
    columns = found if isinstance(found, dict) else {path.stem: found}
    return {name: _without_null(column) for name, column in columns.items()}


def _without_null(column: Any) -> Any:  # noqa: ANN401
    """Return what JSON holds with NaN in place of null in a list."""
    return [math.nan if cell is None else cell for cell in column] if isinstance(column, list) else column


def _sheets(path: Path) -> dict[str, tuple[str, ...]]:
    from python_calamine import CalamineWorkbook

    with CalamineWorkbook.from_path(path) as book:
        return {
            title: tuple(
                "\t".join(map(_cell, row)) + "\n"
                for row in book.get_sheet_by_name(title).to_python(skip_empty_area=False)
            )
            for title in book.sheet_names
        }


def _cell(cell: object) -> str:
    if isinstance(cell, date) and not isinstance(cell, datetime):
        # A moment at midnight.
        return f"{cell} 00:00:00"
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < 2**53:
        return str(int(cell))
    return re.sub(r'[\s"]+', " ", str(cell))


def _with_unit(name: str, unit: object) -> str:
    text = unit.decode(errors="replace") if isinstance(unit, bytes) else unit
    return f"{name} [{text}]" if isinstance(text, str) and text.strip() else name


_LOADERS = {
    "MATLAB": _matlab, "HDF5": _hdf5, "TDMS": _tdms, "Parquet": _parquet, "NumPy": _numpy, "JSON": _json,
    "spreadsheet": _sheets,
}  # fmt: skip


if __name__ == "__main__":
    # What a library prints must not stand among the contents.
    warnings.simplefilter("ignore")
    output, sys.stdout = sys.stdout.buffer, sys.stderr
    pickle.dump(_load(sys.argv[1], Path(sys.argv[2])), output, protocol=pickle.HIGHEST_PROTOCOL)
