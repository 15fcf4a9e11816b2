"""CPU time of reading measurements beside pandas and the csv module. Asserts no time."""

import csv
import time
import tracemalloc

import numpy as np
import pytest

from bench.analysis import read_columns

ROWS = 1_000_000


def seconds(call):
    start = time.process_time()
    result = call()
    return time.process_time() - start, result


@pytest.mark.benchmark
def test_a_million_rows_of_three_columns(tmp_path, capsys):
    import pandas

    array = np.random.default_rng(0).normal(size=(ROWS, 3))
    path, comma = tmp_path / "data.csv", tmp_path / "comma.csv"
    with path.open("w") as file:
        file.write("time,force,length\n")
        np.savetxt(file, array, fmt="%.9g", delimiter=",")
    comma.write_text(path.read_text().replace(",", ";").replace(".", ","))

    def by_csv():
        with path.open(newline="") as file:
            rows = csv.reader(file)
            next(rows)
            return np.array([[float(cell) for cell in row] for row in rows])

    names = ("time", "force", "length")
    own, columns = seconds(lambda: read_columns(path, names))
    own_comma, columns_comma = seconds(lambda: read_columns(comma, names))
    by_pandas, frame = seconds(lambda: pandas.read_csv(path))
    by_module, table = seconds(by_csv)
    for index, name in enumerate(names):
        np.testing.assert_array_equal(columns.values[name], table[:, index])
        np.testing.assert_array_equal(columns_comma.values[name], table[:, index])
        np.testing.assert_allclose(frame[name], table[:, index], rtol=1e-12)
    tracemalloc.start()
    read_columns(path, names)
    peak = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    with capsys.disabled():
        print(
            f"\n{ROWS} rows of 3 columns, CPU: {own:.2f} s, {own_comma:.2f} s with decimal commas; "
            f"pandas {by_pandas:.2f} s, csv module {by_module:.2f} s; peak {peak:.0f} MB"
        )
