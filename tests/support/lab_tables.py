"""A table of measurements, and files of many kinds that hold it."""

import warnings
import zipfile

import numpy as np

ROWS = 40
U = np.round(2.0 + 1.75 * np.sin(0.3 * np.arange(ROWS)), 4)
Y = np.round(-3.5 + 12.25 * np.cos(0.3 * np.arange(ROWS)), 3)
TIME = np.arange(ROWS) * 0.05
WITH_UNITS = ("time [s]", "U [V]", "y [µm]")


def number(value, decimal="."):
    return f"{value:.6g}".replace(".", decimal)


def body(delimiter=",", decimal=".", columns=(TIME, U, Y), form="{}"):
    rows = zip(*columns, strict=True)
    return "".join(delimiter.join(form.format(number(value, decimal)) for value in row) + "\n" for row in rows)


def table(delimiter=",", decimal=".", heads=("time", "U", "y")):
    return delimiter.join(heads) + "\n" + body(delimiter, decimal)


def timed(times, head="time"):
    rows = "".join(f"{time},{u},{y}\n" for time, u, y in zip(times, U.tolist(), Y.tolist(), strict=True))
    return f"{head},U,y\n{rows}"


def write(folder, content, name="data.txt"):
    path = folder / name
    if callable(content):
        content(path)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def check(columns, names=("U", "y")):
    np.testing.assert_array_equal([columns.values[name] for name in names], [U, Y])


def rows(*columns, heads=("time", "U", "y")):
    values = [column.tolist() if hasattr(column, "tolist") else column for column in columns or (TIME, U, Y)]
    return [list(heads), *map(list, zip(*values, strict=True))]


def sheets(**content):
    def save(path):
        import openpyxl

        book = openpyxl.Workbook()
        book.remove(book.active)
        for title, lines in content.items():
            sheet = book.create_sheet(title)
            for line in lines:
                sheet.append(line)
        book.save(path)

    return save


def strict(path):
    """Write Strict Open XML, as Excel does if it is asked to."""
    sheets(run=rows())(path)
    with zipfile.ZipFile(path) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    with zipfile.ZipFile(path, "w") as file:
        for name, part in parts.items():
            for kind in (b"spreadsheetml", b"officeDocument"):
                old = b"http://schemas.openxmlformats.org/" + kind + b"/2006/"
                part = part.replace(old, b"http://purl.oclc.org/ooxml/" + kind + b"/")
            file.writestr(name, part)


def matlab(damage=None, **content):
    def save(path):
        from scipy.io import savemat

        savemat(path, content)
        raw = path.read_bytes()
        if damage is not None:
            path.write_bytes(raw[:damage] + b"\xff" + raw[damage + 1 :])

    return save


def later_matlab(path):
    """Write a table, in the format of version 7.3 where the name of the file says so."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import matio
        import pandas as pd

        columns = pd.DataFrame({"time": TIME, "U": U, "y": Y})
        matio.save_to_mat(str(path), {"T": columns}, version="v7.3" if "7.3" in path.name else "v7")


def hdf5(path):
    import h5py

    with h5py.File(path, "w") as file:
        for name, values, unit in (("U", U, "V"), ("y", Y, "um"), ("time", TIME, "s")):
            file[f"run/{name}"] = values
            file[f"run/{name}"].attrs["units"] = unit


def tdms(path):
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(path) as file:
        for name, values, unit in (("U", U, "V"), ("y", Y, "um")):
            properties = {"unit_string": unit, "wf_increment": 0.05, "wf_start_offset": 0.0}
            file.write_segment([ChannelObject("run", name, values, properties)])


def numpy_file(*array, **arrays):
    def save(path):
        with path.open("wb") as file:
            np.savez(file, **arrays) if arrays else np.save(file, *array)

    return save


def parquet(**columns):
    def save(path):
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table({"U [V]": U, "y [µm]": Y, "note": ["x"] * ROWS, **columns}), path)

    return save
