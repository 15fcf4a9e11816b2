"""What a message advises can be followed."""

import sqlite3
from contextlib import closing

import pytest

from bench.base import DataError
from bench.record import Journal, Record


@pytest.mark.parametrize("value", ["0,5", "1,5e1", "-0,25"])
def test_a_decimal_comma_is_named(bench, value):
    for option in ("--set", "--override"):
        name = "duration" if option == "--set" else "telemetry.period"
        code, _, err = bench("run", "creep", "--rig", "vo2", option, f"{name}={value}")
        assert code == 2
        assert f"the decimal sign is a point: {value.replace(',', '.')}" in " ".join(err.split())


def test_a_list_is_no_decimal_comma(bench):
    _, _, err = bench("run", "creep", "--rig", "vo2", "--override", "telemetry.period=a,b")
    assert "decimal" not in err


def test_a_journal_that_is_locked_says_what_may_keep_it(tmp_path):
    with closing(Journal(tmp_path / "journal.sqlite", (), {})):
        pass
    other = sqlite3.connect(tmp_path / "journal.sqlite")
    try:
        other.execute("PRAGMA locking_mode = EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(DataError, match=r"locked: another program .* or its folder is on a file system without"):
            Record(tmp_path / "journal.sqlite")
    finally:
        other.close()
