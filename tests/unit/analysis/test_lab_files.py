"""One table in the layouts in which laboratories have it: each is read, or refused with the option that reads it."""

import gzip
import json
from datetime import datetime, timedelta

import numpy as np
import pytest
from cases import cases
from lab_tables import (
    ROWS,
    TIME,
    WITH_UNITS,
    U,
    Y,
    body,
    hdf5,
    later_matlab,
    matlab,
    number,
    numpy_file,
    parquet,
    rows,
    sheets,
    strict,
    table,
    tdms,
    timed,
    write,
)  # fmt: skip

from bench.analysis import ColumnNames, ReadingOptions, read_dataset
from bench.base import BenchError

UNITS = {"units": ("V", "µm")}
TIMED = {"time": "time"}
NOT = {"by": None}
"""Of what no option reads."""
MOMENTS = [datetime.fromisoformat("2026-11-25 23:59") + timedelta(seconds=time) for time in TIME.tolist()]
CLOCK = [f"{moment:%H:%M:%S.%f}" for moment in MOMENTS]
DAYS = TIME / 86400
SETTINGS = "SETTINGS\nRange   N/A\n\nSegment  Final  Final\nNumber   Field  Index\n          (T)        \n"
ALIGNED = "                      Adjusted  \n    U          y         y      \n   (T)       (Am²)     (Am²)    \n"
LABVIEW = "LabVIEW Measurement\t\nVersion\t2\n***End_of_Header***\t\n\t\nX0\t0,0E+0\t0,0E+0\t\nDelta_X\t1,0\t1,0\t\n"
SEGMENT = "***End_of_Header***\t\t\t\nX_Value\tU\ty\tComment\n"
HALVES = [[column[part] for column in (TIME, U, Y)] for part in (slice(20), slice(20, None))]
BRANCHES = [column for half in HALVES for column in half[1:]]
ROW = body().splitlines(keepends=True)[20]
COLUMNS = {"time": TIME.tolist(), "U": U.tolist(), "y": Y.tolist()}
ORDER = np.argsort(np.round(U, 1), kind="stable")


def two_files(path, shorter=0):
    write(path.parent, "y\n" + body(columns=[Y[shorter:]]), path.name)
    write(path.parent, "U\n" + body(columns=[U]), "in.txt")


LAYOUTS = {
    # name: (content, words of the line of assumptions or of the message, what is asked for beyond U and y, options)
    "plain": (table(), "comma-separated"),
    "semicolon": (table(";"), "semicolon-separated"),
    "tab": (table("\t"), "tab-separated"),
    "bar": (table("|"), "separated by |"),
    "names, units and remarks": ("time\tU\ty\ns\tV\tµm\n\t\tfiltered\n" + body("\t"), "units from a row", UNITS),
    "unit row, and a number above": (
        "x-axis,1,2\ntime,U,y\ns,V,µm\n" + body(), "1 line above the header, units from a row", UNITS
    ),
    "aligned blanks": ("".join(f"  {line}  \n" for line in table("    ").splitlines()), "separated by blanks"),
    "comma and blank": (table(", "), "comma-separated"),
    "semicolon, decimal comma": (table(";", ","), "semicolon-separated, decimal comma"),
    "tab, decimal comma": (table("\t", ","), "tab-separated, decimal comma"),
    "blanks, decimal comma": (table("  ", ","), "separated by blanks, decimal comma"),
    "quoted": ('"time","U","y, mean"\n' + body(form='"{}"'), "comma-separated", {"names": ("U", "y, mean")}),
    "quoted, decimal comma": ('"time","U","y"\n' + body(",", ",", form='"{}"'), "comma-separated, decimal comma"),
    "byte-order mark": (table(heads=WITH_UNITS).encode("utf-8-sig"), "comma-separated", UNITS),
    "cp1252": (table("\t", heads=("t", "U [V]", "y [°C]")).encode("cp1252"), "cp1252", {"units": ("V", "°C")}),
    "UTF-16": (table("\t", ",", WITH_UNITS).encode("utf-16"), "UTF-16, tab-separated", UNITS),
    "number sign": ("# sample 3\n#2026\n" + table(), "2 lines of comment"),
    "semicolons": ("; sample 3\n" + table(), "1 line of comment"),
    "comments between": (table().replace("\n0.1,", "\n# paused\n0.1,"), "1 line of comment"),
    "header in a comment": ("# sample 3\n# time U y\n" + body(" "), "header from a comment"),
    "lines above": ("Oscilloscope 5000\nSerial,A12\nSample rate,20\n\n" + table(), "3 lines above the header"),
    "unit row": ("time;U;y\ns;V;µm\n" + body(";", ","), "units from a row", UNITS),
    "unit row in brackets": ("time\tU\ty\n[s]\t[V]\t[µm]\n" + body("\t"), "units from a row", UNITS),
    "units in brackets, blanks": (table("  ", heads=WITH_UNITS), "separated by blanks", UNITS),
    "units in parentheses": (table(heads=("time (s)", "U (V)", "y (μm)")), "", UNITS),
    "units after a solidus": (table(heads=("time/s", "U/V", "y / um")), "", UNITS),
    "units after an underscore": (table(heads=("time_s", "U_V", "y_um")), "", UNITS),
    "units spelled out": (table(heads=("t", "U kV_per_cm", "y C_per_m2")), "", {"units": ("kV/cm", "C/m2")}),
    "units that nobody knows": (table(heads=("t", "U (statvolt)", "y m/s")), "", {"units": ("", "")}),
    "no header": (body(), "no header", {"names": ("2", "3")}),
    "no header, decimal comma": (body("\t", ","), "decimal comma, no header", {"names": ("2", "3")}),
    "by number": (table(heads=("x", "x", "x")), "has 3 columns", {"names": ("x", "x"), "by": ("2", "3")}),
    "trailing empty columns": (table().replace("\n", "," * 2000 + "\n"), "comma-separated"),
    "trailing empty rows": (table() + ",,\n" * 5, ""),
    "remark below": (table() + "\nend of measurement\n", "1 line below the table left out"),
    "gzip": (gzip.compress(table(";", ",").encode()), "gzip, semicolon-separated"),
    "heads aligned by blanks": (
        SETTINGS + "1,+1.5,20\n2,-1.5,40\n\n" + ALIGNED + body(columns=(U, Y, Y)),
        "heads aligned by blanks, the longest of 2 tables", {"names": ("U", "Adjusted y"), "units": ("T", "Am²")},
    ),
    "sections": (
        "[Header]\n; made by\nINFO,4.2,MASS\n[Data]\nComment,Time Stamp (sec),U (Oe),y (emu),M. Std. Err. (emu),\n"
        + "".join(f",{3.6e9 + t:.3f},{u},{y},,\n" for t, u, y in zip(TIME, U, Y, strict=True)),
        "times since the first row", {"time": "Time Stamp", "units": ("Oe", "emu")},
    ),
    "names and values below": (table("\t") + "\nPMax: 19.8\nPr: 7.1\n", "2 lines below the table left out"),
    "segments of LabVIEW": (
        LABVIEW + SEGMENT + body("\t", ",", HALVES[0]) + "\t\nX0\t0,0\t0\t\n" + SEGMENT + body("\t", ",", HALVES[1]),
        "2 of 3 tables, of equal columns, joined in order, 5 lines beside them left out", {"time": "X_Value"},
    ),
    "header again": (
        "time,U,y\n" + body(columns=HALVES[0]) + "time,U,y\n" + body(columns=HALVES[1]),
        "2 of 2 tables, of equal columns, joined in order",
    ),
    "a short table without heads below": (
        table() + "\nCalibration\n1,2,3\n4,5,6\n", "the longest of 2 tables, 3 lines beside them left out"
    ),
    "like tables": (
        table() + "\nU,x\n" + body(columns=(Y, U)), r"1 from line 2 \(40 × 3\), 2 from line 44 \(40 × 2\);",
        {"by": ("U", "y"), "table": "1"},
    ),
    "branches": (
        "U_up (V),y_up (um),U_down (V),y_down (um)\n" + body(columns=BRANCHES), "y_up and y_down joined in order",
        {"names": ("U_up,U_down", "y_up,y_down"), **UNITS},
    ),
    "branches of other numbers": (table(), "must be as many of each", {"names": ("U,y", "time"), **NOT}),
    "two files": (two_files, "in.txt: one column", {"names": ("in.txt:U", "y")}),
    "two files of other lengths": (
        lambda path: two_files(path, 1), "y 39, in.txt:U 40", {"names": ("in.txt:U", "y"), **NOT}
    ),
    "moments": (timed([f"{moment:%F %T.%f}" for moment in MOMENTS]), "dates and times", TIMED),
    "moments with a zone": (timed([f"{moment:%FT%T.%f}+01:00" for moment in MOMENTS]), "dates and times", TIMED),
    "moments of Greenwich": (timed([f"{moment:%FT%T.%f}Z" for moment in MOMENTS]), "dates and times", TIMED),
    "time of day": (timed(CLOCK), "dates and times, in s since the first row", TIMED),
    "elapsed hours": (timed([f"112{clock[2:]}" for clock in CLOCK]), "dates and times", TIMED),
    "time of day, decimal comma": (
        timed(CLOCK).replace(",", "\t").replace(".", ","), "decimal comma, time: dates and times", TIMED
    ),
    "a number before times of day": (timed(["0", *CLOCK[1:]]), "time: .* is not a number", {**TIMED, **NOT}),
    "a text among times": (timed([*CLOCK[:5], "late", *CLOCK[6:]]), "'late' is no date", {**TIMED, **NOT}),
    "days of Excel": (timed(43922.5 + DAYS), "times in days of Excel by their magnitude", TIMED),
    "days of MATLAB": (timed(736000.5 + DAYS), "times in days of MATLAB", {"near": 1e-4, **TIMED}),
    "days or seconds": (
        timed(43922.5 + TIME), "may be days of Excel or seconds: say --format time-unit=d or --format time-unit=s",
        {"by": ("U", "y"), "time_unit": "s", **TIMED},
    ),
    "seconds since 1970": (timed(1.7e9 + TIME), "times in s since 1970", TIMED),
    "milliseconds since 1970": (timed(1.7e12 + 1000 * TIME), "times in ms since 1970", TIMED),
    "days by the head": (timed(DAYS, "t (days)"), "", {"time": "t"}),
    "hours by the head": (timed(TIME / 3600, "t [h]"), "", {"time": "t"}),
    "milliseconds behind an underscore": (timed(TIME * 1000, "time_ms"), "", TIMED),
    "times without a unit": (timed(TIME), "times taken as s", TIMED),
    "a unit that is given": (timed(TIME * 1e6)[9:], "", {"names": ("2", "3"), "time": "1", "time_unit": "us"}),
    "times in two units": (timed(TIME, "t [ms]"), "is in ms by its head", {"time": "t", "time_unit": "s", **NOT}),
    "evenly sampled": (timed(TIME), "rows 0.05 s apart", {"interval": "50 ms"}),
    "equal stamps": (
        timed(np.where(np.arange(ROWS) == 20, TIME[19], TIME)), "1 row with the stamp of the row before spread",
        {"near": 0.03, **TIMED},
    ),
    "a slow clock": (timed(np.floor(TIME / 0.2 + 1e-9) * 0.2), "30 rows with the stamp of the row before", TIMED),
    "times that stand still": (timed(0 * TIME + 5), "is 5 in all 40 rows", {**TIMED, **NOT}),
    "times that go back": (timed(TIME[::-1]), "does not increase in row 2", {**TIMED, **NOT}),
    "sorted by its input": (
        "U,y\n" + body(columns=(np.round(U, 1)[ORDER], Y[ORDER])),
        "sorted by its input: the order of measurement is lost", {"expected": (np.round(U, 1)[ORDER], Y[ORDER])},
    ),
    "a mark of direction": (
        "\u200f(19,5;2,5\n" + body(";", ",", (U, Y)), "line 1: .* is neither a number nor the head of a column",
        {"names": ("1", "2"), "by": ("1", "2"), "skip_lines": 1},
    ),
    "a mark of direction below": (
        body(";", ",", (U, Y)) + "1,5;\u200f(19,5\n", "is not a number", {"names": ("1", "2"), **NOT}
    ),
    "rows of texts": (
        "".join(f"{name},{body(columns=[column]).strip()}\n".replace("\n", ",").rstrip(",") + "\n"
                for name, column in (("t,s", TIME), ("U,V", U), ("y,um", Y))),
        "comma-separated, 3 × 40, its rows read as columns, units from a row", {"time": "t", **UNITS},
    ),
    "rows of numbers": (
        "".join(body(columns=[column]).replace("\n", "  ") + "\n" for column in (TIME, U, Y)),
        "separated by blanks, 3 × 40, its rows read as columns", {"names": ("2", "3"), "time": "1"},
    ),
    "rows of numbers, decimal comma": (
        "".join(body(";", ",", [column]).replace("\n", ";") + "\n" for column in (TIME, U, Y)),
        "semicolon-separated, 3 × 40, its rows read as columns, decimal comma", {"names": ("2", "3"), "time": "1"},
    ),
    "rows written twice": (
        table().replace(ROW, ROW + ROW), "1 row equal to the row before", TIMED
    ),
    "segments behind blank lines": (
        table().replace("\n0.5,", "\n\n\n0.5,"), "2 of 2 tables, of equal columns, joined in order", TIMED
    ),
    "segments behind titles": (
        "time,U,y\nCycle 1,,\n" + body(columns=HALVES[0]) + "Cycle 2,,\n" + body(columns=HALVES[1]),
        "2 of 2 tables, of equal columns, joined in order, 1 line beside them left out", TIMED,
    ),
    "a serial monitor": (
        timed([f"{clock[:-3]} -> " for clock in CLOCK])[9:].replace(" -> ,", " -> "),
        "times of day before ->, comma-separated", {"names": ("2", "3"), "time": "1"},
    ),
    "German moments": (
        timed([f"{moment:%d.%m.%Y %T.%f}" for moment in MOMENTS]), "dates and times", {"near": 1e-6, **TIMED}
    ),
    "German moments, decimal comma": (
        "time;U;y\n" + "".join(
            f"{moment:%d.%m.%Y %T},{moment:%f};{number(u, ',')};{number(y, ',')}\n"
            for moment, u, y in zip(MOMENTS, U, Y, strict=True)
        ),
        "decimal comma, time: dates and times", {"near": 1e-6, **TIMED},
    ),
    "American moments": (
        timed([f"{moment:%m/%d/%Y %I:%M:%S.%f %p}" for moment in MOMENTS]), "dates and times", TIMED
    ),
    "times of day past midnight": (
        timed([f"{moment + timedelta(seconds=59):%T.%f}" for moment in MOMENTS]), "first row, past midnight", TIMED
    ),
    "minutes and seconds": (timed([f"10:{time:06.3f}" for time in TIME]), "dates and times", TIMED),
    "units in any brackets": (table(";", heads=("t <s>", "U {V}", "y <um>")), "", UNITS),
    "units behind a comma": ('"t, s","U, V","y in um"\n' + body(), "", UNITS),
    "columns that are numbers": (
        "x-axis,1,2\nsecond,Volt,Volt\n" + body(), "units from a row",
        {"names": ("1", "2"), "time": "x-axis", "units": ("V", "V")},
    ),
    "units beside a label": (
        "names,time,U,y\nunits,s,V,µm\nvalues," + body().replace("\n", "\n,"), "units from a row", {**TIMED, **UNITS}
    ),
    "names above types": (
        '"TOA5","x","7","1"\n"time","U","y"\n"TS","mV","Deg C"\n"","Smp","Avg"\n' + body(), "heads from line 2"
    ),
    "a head too few": (
        "U y\n" + body(" "), "does not fit the 3 columns below it, .* by number", {"by": ("2", "3")}
    ),
    "UTF-32": (table().encode("utf-32"), "UTF-32"),
    "an overload": (table().replace(f",{Y[7]:g}\n", ",9.9E37\n"), "row 8, column y: 9.9e.37 is what", NOT),
    "thousands": (table(";", ",").replace("\n0,5;", "\n1.000,5;"), "is not a number", {**TIMED, **NOT}),
    "text with the ending of a spreadsheet": (table("\t"), "tab-separated", {"file": "d.xls"}),
    "text with the ending of MATLAB": (body("  "), "separated by blanks", {"names": ("2", "3"), "file": "d.mat"}),
    **{
        f"a cell {cell!r}": (
            table(";").replace(f";{Y[7]:g}\n", f";{cell}\n"), "line 9, row 8, column y: .* not a number", NOT
        )
        for cell in (
            "OVERLOAD", "#N/A", "--", "1.#INF", "1,5", "1.5V", "5%", "(1.5)", "1_000", "１２", "1\xa0000", "'1'",
        )
    },
    "a sheet": (
        sheets(run=[["Sample 3"], [], ["time", "U", "y"], ["s", "V", "µm"], *rows()[1:], ["Total", 600, 3]]),
        "sheet run, 1 line above the header, units from a row, 1 line below the table left out",
        {"file": "d.xlsx", **UNITS},
    ),
    "a long sheet": (sheets(notes=[["none"]], run=rows()), "sheet run, the longest of 2", {"file": "d.xlsx"}),
    "like sheets": (
        sheets(other=rows(U, Y, U), run=rows()), r"2 sheets: other \(41 × 3\), run \(41 × 3\)",
        {"file": "d.xlsx", "by": ("U", "y"), "table": "2"},
    ),
    "tables of a sheet": (
        sheets(run=[*rows(), [], *rows(U, Y, heads=("a", "b"))]), "choose one with --format table=N, run:1 to run:2",
        {"file": "d.xlsx", "by": ("U", "y"), "table": "run:1"},
    ),
    "a wrong cell of a sheet": (
        sheets(run=[["U", "y"], [1.0, 2.0], [3.0, "bad"]]), "sheet run: line 3, row 2, column y: 'bad' is not a",
        {"file": "d.xlsx", **NOT},
    ),
    "days of Excel in a sheet": (
        sheets(run=rows(43922.5 + DAYS, U, Y)[1:]), "times in days of Excel by their magnitude",
        {"names": ("2", "3"), "time": "1", "file": "d.xlsx"},
    ),
    "moments in a sheet": (
        sheets(run=rows([moment + timedelta(seconds=59) for moment in MOMENTS], U, Y)), "dates and times",
        {"file": "d.xlsx", **TIMED},
    ),
    "Strict Open XML": (strict, "sheet run", {"file": "d.xlsx"}),
    "vectors of MATLAB": (matlab(U=U, y=Y[:, None], note="x"), "MATLAB", {"file": "d.mat"}),
    "a matrix of MATLAB": (
        matlab(d=np.column_stack([TIME, U, Y])), "MATLAB", {"file": "d.mat", "names": ("2", "d(:,3)")}
    ),
    "a matrix of rows": (
        matlab(d=np.vstack([TIME, U, Y])), "d: 3 × 40, its rows read as columns",
        {"file": "d.mat", "names": ("2", "3"), "time": "1"},
    ),
    "records of MATLAB": (
        matlab(a=np.array([*zip(U, Y, strict=True)], dtype=[("U", float), ("y", float)])), "MATLAB", {"file": "d.mat"}
    ),
    "cells of MATLAB": (
        matlab(c=np.array([[u, y] for u, y in zip(U, Y, strict=True)], dtype=object)), "MATLAB",
        {"file": "d.mat", "names": ("c(:,1)", "c(:,2)")},
    ),
    "no numbers of MATLAB": (matlab(note="x"), "has no vector, matrix or table of numbers", {"file": "d.mat", **NOT}),
    "structures of MATLAB": (
        matlab(a={"U": U, "y": Y}, b={"U": Y, "y": U}), r"no column 'U'; there are: a\.U",
        {"file": "d.mat", "by": ("U", "y"), "table": "a"},
    ),
    "no such variable": (matlab(a={"U": U, "y": Y}), "has: a .2 parts", {"file": "d.mat", "table": "b", **NOT}),
    "vectors of other lengths": (matlab(U=U, y=Y[1:]), "U 40, y 39", {"file": "d.mat", **NOT}),
    "a damaged vector, which ends the process": (
        matlab(145, U=np.arange(12.0), y=np.arange(12.0)), r"cannot be read as a MATLAB file: the process .* ended",
        {"file": "d.mat", **NOT},
    ),
    "a table of MATLAB": (later_matlab, "MATLAB", {"file": "d.mat", **TIMED}),
    "MATLAB 7.3": (later_matlab, "MATLAB", {"file": "d7.3.mat", **TIMED}),
    "HDF5": (hdf5, "HDF5", {"file": "d.h5", **TIMED, **UNITS}),
    "TDMS": (tdms, "TDMS", {"file": "d.tdms", **TIMED, **UNITS}),
    "Parquet": (parquet(time=MOMENTS), "dates and times", {"file": "d.parquet", **TIMED, **UNITS}),
    "arrays of NumPy": (numpy_file(U=U, y=Y, note="x"), "NumPy", {"file": "d.npz"}),
    "a matrix of NumPy": (
        numpy_file(np.vstack([TIME, U, Y])), "d: 3 × 40, its rows read as columns",
        {"file": "d.npy", "names": ("2", "d(3,:)")},
    ),
    "signals of Simulink": (
        matlab(
            out={
                "time": TIME,
                "signals": np.array(
                    [(U, "U", 1), (Y, "y", 1)], dtype=[("values", "O"), ("label", "O"), ("dimensions", "O")]
                ),
            }
        ), "MATLAB", {"file": "d.mat", **TIMED},
    ),
    "signals of dSPACE": (
        matlab(
            X={"Raster": "task", "Data": TIME},
            Y=np.array([("U", U, "V"), ("y", Y, "µm")], dtype=[("Name", "O"), ("Data", "O"), ("Unit", "O")]),
        ), "MATLAB", {"file": "d.mat", "time": "X.Data", **UNITS},
    ),
    "columns of JSON": (json.dumps(COLUMNS), "JSON", {"file": "d.json", **TIMED}),
    "records of JSON": (
        json.dumps([dict(zip(COLUMNS, row, strict=True)) for row in zip(*COLUMNS.values(), strict=True)]), "JSON",
        {"file": "d.json", **TIMED},
    ),
    "lines of JSON": (
        "".join(
            json.dumps({"time": f"{moment:%FT%T.%f}", "U": u, "y": y}) + "\n"
            for moment, u, y in zip(MOMENTS, U, Y, strict=True)
        ), "dates and times", {"file": "d.jsonl", **TIMED},
    ),
    "a null of JSON": (json.dumps({"U": [1, 2, 3], "y": [1, None, 3]}), "row 2, .* nan", {"file": "d.json", **NOT}),
    "numbers of JSON": ("[1.5, 2.5,\n3.5]", "no column 'U'", {"file": "d.json", **NOT}),
    "objects of NumPy": (numpy_file(np.array([None, {}])), "allow_pickle", {"file": "d.npy", **NOT}),
    "texts in Parquet": (parquet(), "no column 'note'", {"file": "d.parquet", "names": ("U", "note"), **NOT}),
    **{
        f"a damaged {name}": (start + bytes(600), words, {"file": name, **NOT})
        for name, start, words in (
            ("d.xls", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "cannot be read as a spreadsheet"),
            ("d.ods", b"PK\x03\x04", "cannot be read as a spreadsheet"),
            ("d.mat", b"nothing" * 20, "cannot be read as a MATLAB file"),
            ("d.h5", b"\x89HDF\r\n\x1a\n", "cannot be read"),
            ("d.parquet", b"PAR1", "cannot be read as a parquet file"),
            ("d.npy", b"\x93NUMPY\x01\0", "cannot be read as a NumPy file"),
            ("d.npz", b"PK\x03\x04", "cannot be read as a NumPy file"),
            ("d.png", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\x80\x90", "is no table of text"),
            ("d.gz", b"\x1f\x8b", "cannot be read"),
        )
    },
}  # fmt: skip
pytestmark = pytest.mark.usefixtures("warm_popen")
SOUGHT = ColumnNames("U", "y", times=("time",))
OPTIONS = ("table", "skip_lines", "interval", "time_unit")


@cases("name", LAYOUTS)
def test_a_layout_is_read_or_refused_with_what_reads_it(tmp_path, name):
    content, words, *more = LAYOUTS[name]
    asked = {"names": ("U", "y"), "time": None, "near": 1e-5, "expected": (U, Y), **(more or [{}])[0]}
    options = {key: asked[key] for key in OPTIONS if key in asked}
    path = write(tmp_path, content, asked.get("file", "data.txt"))
    names = asked["names"]
    if "by" in asked:
        columns = ColumnNames(*names, time=asked["time"])
        with pytest.raises(BenchError, match=words):
            read_dataset([path], columns, ReadingOptions(**(options if asked["by"] is None else {})))
        if asked["by"] is None:
            return
        names, words = asked["by"], ""
    data = read_dataset([path], ColumnNames(*names, time=asked["time"]), ReadingOptions(**options))
    np.testing.assert_array_equal([data.inputs, data.outputs], asked["expected"])
    assert words in data.assumptions
    assert (data.input.unit, data.output.unit) == asked.get("units", (data.input.unit, data.output.unit))
    if asked["time"] or "interval" in asked:
        np.testing.assert_allclose(data.times - data.times[0], TIME, atol=asked["near"])


@cases(
    "head",
    [
        "time", "T", "Timestamp", "Date/Time", "X_Value", "Running Time [s]", "Prüfzeit (s)", "time_s", "x-axis [s]",
        "clock [s],clock [s]",
    ],
)  # fmt: skip
def test_times_are_found_by_their_name_or_their_unit(tmp_path, head):
    times = np.transpose(np.tile(TIME, (head.count(",") + 1, 1))).tolist()
    path = write(tmp_path, timed([",".join(map(str, row)) for row in times], head))
    np.testing.assert_allclose(read_dataset([path], SOUGHT).times, TIME)


def test_times_are_found_by_dates_whatever_their_name(tmp_path):
    path = write(tmp_path, timed([f"{moment:%F %T.%f}" for moment in MOMENTS], "logged"))
    np.testing.assert_allclose(read_dataset([path], SOUGHT).times, TIME, atol=1e-5)


@cases("head", ["run", "time [V]", "step", "temperature [°C]"])
def test_other_columns_are_no_times(tmp_path, head):
    assert read_dataset([write(tmp_path, timed(TIME, head))], SOUGHT).times is None


def test_times_that_cannot_be_read_are_left_out_and_said(tmp_path):
    data = read_dataset([write(tmp_path, timed([*TIME[:9], "late", *TIME[10:]]))], SOUGHT)
    assert data.times is None
    assert "'late' is not a number" in data.assumptions
