"""Mutated files of measurements: an import has each row with its numbers, or says what it lacks."""

import gzip
import io
import json
import random
import re
import shutil
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from commands import call
from mutations import EXTREMES, STRANGE, mutated_bytes, mutated_lines

from bench.record import Record

HEAD = ("t", "u", "y")
NUMBERS = [(0.5 * i, 1.0 + i + 0.125 * (i % 7), 1000.0 - 3.0625 * i - 0.25 * (i % 5)) for i in range(30)]

_LEFT_OUT = re.compile(
    r"(\d+) (?:line|row)s? (?:of comment|above the header|below the table|beside them|equal to the row before)"
)

Cells = Sequence[str]


def text_of(delimiter: str, decimal: str, quoted: bool = False) -> str:
    """Return the measurements as text."""
    rows = [HEAD, *([repr(number).replace(".", decimal) for number in row] for row in NUMBERS)]
    mark = '"' if quoted else ""
    return "".join(delimiter.join(f"{mark}{cell}{mark}" for cell in row) + "\n" for row in rows)


_PREAMBLE = "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\t\n\t\nX0\t0,0\t0,0\nDelta_X\t0,5\t0,5\n"
_SECTIONS = "[Header]\n; made by a bench\nINFO,4.2,MASS\n[Data]\n"

LAYOUTS = {
    # name: (delimiter, decimal sign, text)
    "comma": (",", ".", text_of(",", ".")), "tab": ("\t", ".", text_of("\t", ".")),
    "semicolon": (";", ",", text_of(";", ",")), "blank": (" ", ".", text_of(" ", ".")),
    "quoted": (",", ".", text_of(",", ".", quoted=True)), "bar": ("|", ".", text_of("|", ".")),
    "lvm": ("\t", ",", _PREAMBLE + text_of("\t", ",")), "sections": (",", ".", _SECTIONS + text_of(",", ".")),
    "unit row": (";", ",", text_of(";", ",").replace("\n", "\ns;V;N\n", 1)),
}  # fmt: skip


def try_text(folder: Path, rng: random.Random) -> str:
    """Import a mutated text."""
    delimiter, decimal, text = LAYOUTS[rng.choice(list(LAYOUTS))]
    if rng.random() < 0.2:
        text = "# of a bench\n" + text
    content = mutated_lines(text, rng) if rng.random() < 0.75 else mutated_bytes(text.encode(), rng)
    if rng.random() < 0.2:
        again = rng.random() < 0.3
        content = mutated_lines(content.decode("latin-1") or "\n", rng) if again else content
    file = folder / rng.choice(("m.csv", "m.txt", "m.tsv", "m.dat", "m.lvm", "m"))
    if rng.random() < 0.1:
        packed = gzip.compress(content, mtime=0)
        file = folder / "m.csv.gz"
        file.write_bytes(mutated_bytes(packed, rng) if rng.random() < 0.5 else packed)
        # What is damaged is refused by its checksum.
    else:
        file.write_bytes(content)
    return check(folder, file, cells_of(content, delimiter), decimal)


def cells_of(content: bytes, delimiter: str) -> list[Cells]:
    """Return the cells of the lines that are not blank, read with as few rules as possible."""
    encodings = ["utf-8-sig", "cp1252", "latin-1"]
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        encodings.insert(0, "utf-32" if b"\0\0" in content[:4] else "utf-16")
    elif b"\0" in content[:4000]:
        encodings.insert(0, "utf-16-le" if content[1:2] == b"\0" else "utf-16-be")
    for encoding in encodings:
        try:
            text = content.decode(encoding)
        except UnicodeError:
            continue
        break
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    split = [line.split(None if delimiter == " " else delimiter) for line in lines if line.strip(" \t\ufeff")]
    return [[cell.strip().strip('"\ufeff').strip() for cell in line] for line in split]


def imported(folder: Path, file: Path) -> tuple[dict[str, Any], np.ndarray] | None:
    """Import a file; return what is said of it and the rows that were read, None if it is refused."""
    result, out = folder / "result.json", folder / "runs"
    ended = call(
        "runs", "import", file, "--input", "u", "--output", "y", "--time", "t", "--out", out, "--json", result
    )
    if ended.code:
        return None
    (run,) = out.iterdir()
    with Record(run) as record:
        steps = record.steps()
        read = np.column_stack([steps["u"], steps["y"]])
    shutil.rmtree(out)
    return json.loads(result.read_text(encoding="utf-8")), read


def check(folder: Path, file: Path, rows: Sequence[Cells], decimal: str = ".") -> str:
    """Import a file; return what is wrong with what was taken, empty if nothing is."""
    if (found := imported(folder, file)) is None:
        return ""
    said, read = found
    if said["rows"] != len(read):
        return f"{said['rows']} rows are said, {len(read)} are in the journal"
    text = json.dumps(said)
    left_out = sum(int(number) for number in _LEFT_OUT.findall(text)) + ("units from a row" in text)
    numbers = [numbers for cells in rows if (numbers := _numbers(cells, decimal)) is not None]
    # The header is the only line that is neither a row nor reported.
    if len(rows) - 1 > len(read) + left_out:
        return f"the file has {len(rows) - 1} rows; {len(read)} are read, {left_out} reported: {said}"
    if left_out == 0 and len(numbers) > len(read):
        return f"{len(numbers)} rows have numbers; {len(read)} are read: {said}"
    rest = iter(numbers)
    for row in read.tolist():
        if not any(row == list(other) for other in rest):
            return f"the row {row} is read, which is not in the file at its place: {said}"
    # What is read may still be of a size at which numerical libraries warn.
    names = "--input", "u", "--output", "y", "--model", "polynomial-plays"
    call("identify", file, *names, "--out", folder / "model.json")
    return ""


def _numbers(cells: Cells, decimal: str) -> tuple[float, float] | None:
    """Return what a strict reader takes of a row; None if it is none."""
    try:
        u, y = (float(_point(cell, decimal)) for cell in cells[1:3])
    except ValueError:
        return None
    return u, y


def _point(cell: str, decimal: str) -> str:
    if not re.fullmatch(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][+-]?\d+)?", cell, re.ASCII):
        raise ValueError
    if ("," if decimal == "." else ".") in cell:
        raise ValueError
    return cell.replace(",", ".").upper().replace("D", "E")


CELLS: tuple[Any, ...] = (
    *EXTREMES,
    *STRANGE,
    None,
    True,
    False,
    10**20,
    -1.5,
    datetime(2026, 1, 1),  # noqa: DTZ001
    "=1/0",
    3 + 0j,
    b"x",
)


def try_spreadsheet(folder: Path, rng: random.Random) -> str:
    """Import a mutated spreadsheet."""
    import openpyxl
    from openpyxl.utils.exceptions import IllegalCharacterError

    rows: list[list[Any]] = [list(HEAD), *map(list, NUMBERS)]
    kind = rng.randrange(5)
    if kind == 0:
        rows.insert(rng.randrange(len(rows)), list(rng.choice(rows)))
    elif kind == 1:
        del rows[rng.randrange(len(rows))]
    elif kind == 2:
        rows[rng.randrange(len(rows))] = [None] * 3
    else:
        rows[rng.randrange(len(rows))][rng.randrange(3)] = rng.choice(CELLS)
    book = openpyxl.Workbook()
    assert book.active is not None
    try:
        for row in rows:
            book.active.append(row)
    except (IllegalCharacterError, ValueError):
        return ""
    content = io.BytesIO()
    book.save(content)
    data = content.getvalue()
    file = folder / "m.xlsx"
    file.write_bytes(mutated_bytes(data, rng) if rng.random() < 0.4 else data)
    # Formulas have no value until a spreadsheet program has computed them.
    cells = [["" if cell is None else str(cell).strip() for cell in row] for row in rows]
    return check(folder, file, [row for row in cells if any(row)])


def _numbers_by_name() -> dict[str, Any]:
    return {name: np.array(values) for name, values in zip(HEAD, zip(*NUMBERS, strict=True), strict=True)}


def _is_changed(columns: dict[str, Any], rng: random.Random) -> bool:
    """Change one of the columns at random; return whether it was, and not left to a mutation of bytes."""
    name = rng.choice(HEAD)
    column = columns[name]
    match rng.randrange(9):
        case 0:
            column[rng.randrange(column.size)] = rng.choice((np.nan, np.inf, 1e308, -0.0))
        case 1:
            columns[name] = column[: rng.randrange(column.size)]
        case 2:
            columns[name] = column.astype(rng.choice((np.float32, np.int8, np.uint8, np.int64, np.complex128, bool)))
        case 3:
            columns[name] = rng.choice(("text", [], {}, np.array([["a", "b"]]), np.zeros((2, 3, 4)), np.nan))
        case 4:
            columns[name] = column.reshape(rng.choice(((30, 1), (1, 30), (5, 6), (2, 3, 5))))
        case 5:
            del columns[name]
        case _:
            return False
    return True


def _try_arrays(folder: Path, rng: random.Random, name: str, save: Callable[[Path, dict[str, Any]], None]) -> str:
    """Import a mutated file of named arrays, which `save` writes if it can hold them."""
    columns = _numbers_by_name()
    changed = _is_changed(columns, rng)
    file = folder / name
    try:
        save(file, columns)
    except (TypeError, ValueError, NotImplementedError):
        if changed:
            return ""
        raise
    if not changed:
        file.write_bytes(mutated_bytes(file.read_bytes(), rng))
    # Nothing tells a number that is damaged from another one: only the number of rows.
    taken = (_flat(columns[each]) for each in HEAD if each in columns)
    rows = [HEAD, *([str(float(v) if isinstance(v, bool) else v) for v in row] for row in zip(*taken, strict=False))]
    if not changed or len(columns) < len(HEAD):
        return count_only(folder, file, len(rows) - 1)
    return check(folder, file, rows)


def try_matlab(folder: Path, rng: random.Random) -> str:
    """Import a mutated MATLAB file, of version 4, 5 or 7.3."""
    from scipy.io import savemat

    def save(path: Path, columns: dict[str, Any]) -> None:
        version = rng.choice(("4", "5", "5", "7.3"))
        if version != "7.3":
            savemat(path, columns, do_compression=version == "5" and rng.random() < 0.5, format=version)
            return
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import matio

            matio.save_to_mat(str(path), columns, version="v7.3")

    return _try_arrays(folder, rng, "m.mat", save)


def try_numpy(folder: Path, rng: random.Random) -> str:
    """Import a mutated NumPy file."""
    return _try_arrays(folder, rng, "m.npz", lambda path, columns: np.savez(path, **columns))


def try_hdf5(folder: Path, rng: random.Random) -> str:
    """Import a mutated HDF5 file."""
    import h5py

    def save(path: Path, columns: dict[str, Any]) -> None:
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[name] = values

    return _try_arrays(folder, rng, "m.h5", save)


def try_tdms(folder: Path, rng: random.Random) -> str:
    """Import a mutated TDMS file."""
    from nptdms import ChannelObject, TdmsWriter

    def save(path: Path, columns: dict[str, Any]) -> None:
        with TdmsWriter(str(path)) as file:
            file.write_segment([ChannelObject("run", name, np.asarray(values)) for name, values in columns.items()])

    return _try_arrays(folder, rng, "m.tdms", save)


def _flat(values: Any) -> list[Any]:
    return np.asarray(values).reshape(-1).tolist()


def count_only(folder: Path, file: Path, rows: int) -> str:
    """Import a file whose numbers may be damaged; return what is wrong with the number of rows."""
    found = imported(folder, file)
    return "" if found is None or found[0]["rows"] == rows else f"{found[0]['rows']} rows of {rows} are read"


def try_parquet(folder: Path, rng: random.Random) -> str:
    """Import a mutated Parquet file, or one of a kind that is not read."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns: dict[str, Any] = {
        name: list(values) for name, values in zip(HEAD, zip(*NUMBERS, strict=True), strict=True)
    }
    name = rng.choice(HEAD)
    damaged = False
    table = pa.table(columns)
    index = HEAD.index(name)
    match rng.randrange(6):
        case 0:
            columns[name][rng.randrange(30)] = rng.choice((None, float("nan"), float("inf"), 1e308))
            table = pa.table(columns)
        case 1:
            other = rng.choice(
                (
                    pa.string(),
                    pa.float32(),
                    pa.int8(),
                    pa.bool_(),
                    pa.decimal128(20, 4),
                    pa.timestamp("s"),
                    pa.int64(),
                )
            )
            changed = pa.array([None] * 30, other)
            with suppress(pa.ArrowException):
                changed = table.column(name).cast(other, safe=False)
            table = table.set_column(index, name, changed)
            columns[name] = changed.to_pylist()
        case 2:
            table = table.drop_columns([name])
            damaged = True
        case 3:
            table = table.set_column(index, name, pa.array([[value] for value in columns[name]]))
            damaged = True
        case _:
            damaged = True
    content = io.BytesIO()
    pq.write_table(table, content, write_page_checksum=True)
    data = content.getvalue()
    if rng.random() < 0.1:
        archive = io.BytesIO()
        np.savez(archive, **{each: np.array(values, dtype=object).astype(str) for each, values in columns.items()})
        file = folder / "m.npz"
        file.write_bytes(archive.getvalue())
        return (
            "npz is read"
            if call("runs", "import", file, "--input", "u", "--output", "y", "--out", folder / "runs").code == 0
            else ""
        )
    file = folder / "m.parquet"
    file.write_bytes(mutated_bytes(data, rng) if damaged else data)
    rows = [
        HEAD,
        *(
            ["" if v is None else repr(float(v)) if isinstance(v, bool | int) else str(v) for v in row]
            for row in zip(*columns.values(), strict=True)
        ),
    ]
    return check(folder, file, rows)


KINDS = {
    "text": try_text, "spreadsheet": try_spreadsheet, "matlab": try_matlab, "hdf5": try_hdf5, "numpy": try_numpy,
    "tdms": try_tdms, "parquet": try_parquet,
}  # fmt: skip
