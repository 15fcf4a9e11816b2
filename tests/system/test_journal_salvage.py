"""What is left of a journal of which a page is overwritten, or that is gone: found, said, and read again."""

import json
import random
import shutil
import sqlite3
import warnings
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from heater_laboratory import RIG
from heater_protocols import stairs

import bench as face
from bench.base import DataError, IncompleteRecordWarning, RecordError
from bench.record import (
    FILE_NAME,
    NAME as SECOND_NAME,
    RECOVERED_NAME,
    Event,
    Journal,
    Record,
    find_journals,
    recover,
)
from bench.record.rows import Row, checksum
from bench.record.second_file import SecondFile


@pytest.fixture(scope="module")
def completed(tmp_path_factory):
    """The journal of a completed run on the heater."""
    folder = tmp_path_factory.mktemp("completed")
    (folder / "heater.toml").write_text(RIG, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        # The command is in the heading: with a long one it takes pages beside those of its copy.
        patch.setattr("sys.argv", ["bench"])
        return face.run(stairs, folder / "heater.toml", out=folder / "runs", count=6).folder


@pytest.fixture
def folder(completed, tmp_path):
    """A copy of it to damage."""
    return shutil.copytree(completed, tmp_path / completed.name)


def overwrite(folder, table):
    """Overwrite the page at which a table begins; of no table, the first page of the file."""
    path = folder / FILE_NAME
    with closing(sqlite3.connect(path)) as db:
        found = db.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchone()
    with path.open("r+b") as file:
        file.seek(4096 * ((found[0] if found else 1) - 1))
        file.write(random.Random(1).randbytes(4096))


def rows_of(path):
    with Record(path) as record:
        return [*record.step_records()], record.telemetry()["t"].tolist(), record.events(), record.files()


class TestAnOverwrittenPage:
    @pytest.mark.parametrize("table", ["steps", "telemetry", "events", "files"])
    def test_leaves_the_rows_of_the_other_tables(self, bench, completed, folder, tmp_path, table):
        overwrite(folder, table)
        journal = (folder / FILE_NAME).read_bytes()
        code, out, err = bench("runs", "repair", folder, "--json", tmp_path / "found.json")
        assert (code, err) == (8, "")
        assert "status: failed" in out
        assert "completed" not in out
        assert (folder / FILE_NAME).read_bytes() == journal
        found = json.loads((tmp_path / "found.json").read_text())
        assert (found["is_complete"], found["copy"]) == (False, str(folder / RECOVERED_NAME))
        assert {name for name, state in found["tables"].items() if state["missing"]} == {table}
        before = rows_of(completed)
        with pytest.warns(IncompleteRecordWarning):
            after = rows_of(Path(found["copy"]))
        place = ["steps", "telemetry", "events", "files"].index(table)
        assert [*after[:place], *after[place + 1 :]] == [*before[:place], *before[place + 1 :]]
        assert len(after[place]) < len(before[place])
        with pytest.warns(IncompleteRecordWarning), Record(folder / RECOVERED_NAME) as record:
            assert record.meta["recovered"]["from"] == str(folder / FILE_NAME)
        code, _, err = bench("runs", "repair", folder)
        assert code == 2
        assert "exists already" in err

    @pytest.mark.parametrize("table", ["meta", "signals", "heading", "the first page"])
    def test_that_has_the_heading_or_is_the_first_takes_nothing(self, bench, completed, folder, table):
        overwrite(folder, table)
        code, out, err = bench("runs", "repair", folder)
        assert (code, err) == (0, "")
        assert "status: completed" in out
        copy = folder / RECOVERED_NAME
        assert rows_of(copy) == rows_of(completed)
        with Record(completed) as before, Record(copy) as after:
            assert after.signals == before.signals
            assert after.meta == before.meta | {"recovered": after.meta["recovered"]}
        # The copy has its heading twice as well.
        shutil.move(copy, folder / FILE_NAME)
        overwrite(folder, "meta")
        assert recover(folder).status == "completed"

    def test_with_another_that_has_the_copy_leaves_nothing_and_says_so(self, bench, folder):
        for table in ("heading", "meta"):
            overwrite(folder, table)
        code, _, err = bench("runs", "repair", folder)
        assert code == 3
        assert "has lost its heading (table meta)" in err
        assert not (folder / RECOVERED_NAME).exists()

    def test_takes_the_rows_on_it_alone_wherever_it_is(self, completed, folder):
        """Whichever two pages are overwritten: all rows of other tables are read again."""
        whole = (folder / FILE_NAME).read_bytes()
        tables = ("steps", "telemetry", "events", "files")
        for first in range(len(whole) // 4096 - 1):
            damaged = bytearray(whole)
            damaged[4096 * first : 4096 * (first + 2)] = b"\xa5" * 8192
            (folder / FILE_NAME).write_bytes(damaged)
            found = recover(folder, out=folder / f"{first}.sqlite")
            with warnings.catch_warnings(action="ignore", category=IncompleteRecordWarning):
                after = rows_of(found.copy)
            for table, mine, theirs in zip(tables, after, rows_of(completed), strict=True):
                if not found.tables[table].missing:
                    assert mine == theirs, (first, table)
            assert len([table for table in found.tables.values() if table.missing]) <= 2

    def test_that_is_the_first_with_that_of_the_signals_leaves_nothing_and_says_so(self, bench, folder):
        for table in ("signals", "the first page"):
            overwrite(folder, table)
        code, _, err = bench("runs", "repair", folder)
        assert code == 3
        assert "nothing of it is readable by SQLite: file is not a database" in err
        assert f"there is no second file ({SECOND_NAME}) in its folder" in err
        (folder / SECOND_NAME).write_bytes(b"nothing")
        code, _, err = bench("runs", "repair", folder)
        assert code == 3
        assert f"nor of {folder / SECOND_NAME}" in err


class TestDamage:
    def test_is_found_by_a_quick_look(self, completed, folder):
        with Record(completed) as record:
            assert record.damage() == ""
        with closing(sqlite3.connect(folder / FILE_NAME)) as db, db:
            db.execute("UPDATE telemetry SET t = t + 1 WHERE tick = 3")
        with Record(folder) as record:
            assert "table telemetry, row 3: its checksum does not fit; `bench runs repair" in record.damage()

    def test_is_found_in_a_page_that_is_overwritten(self, folder):
        overwrite(folder, "telemetry")
        with Record(folder) as record:
            assert "bench runs repair" in record.damage()

    def test_is_none_in_a_whole_one_which_is_left_alone(self, bench, folder):
        before = sorted(folder.iterdir())
        code, out, _ = bench("runs", "repair", folder / FILE_NAME)
        assert code == 0
        assert "the journal is whole" in out
        assert sorted(folder.iterdir()) == before

    def test_cannot_be_looked_for_in_what_is_no_journal(self, bench, tmp_path):
        code, _, err = bench("runs", "repair", tmp_path)
        assert (code, err.count("\n")) == (3, 1)
        (tmp_path / FILE_NAME).write_bytes(b"nothing")
        code, _, err = bench("runs", "repair", tmp_path, "--second", tmp_path / "absent")
        assert code == 2


class TestALostJournal:
    @pytest.fixture
    def lost(self, tmp_path):
        """A folder whose journal was removed while its run went on."""
        folder = tmp_path / "runs" / "lost"
        folder.mkdir(parents=True)
        journal = Journal(folder / FILE_NAME, (), {"rig": "vo2"})
        journal.event(Event(0.0, "INFO", "note", "one"))
        (folder / FILE_NAME).unlink()
        with pytest.raises(RecordError, match="was removed"):
            journal.event(Event(1.0, "INFO", "note", "two"))
        journal.close()
        return folder

    def test_is_found_and_the_way_back_named(self, bench, lost):
        assert find_journals(lost.parent) == [lost / FILE_NAME]
        for path in (lost, lost / FILE_NAME):
            with pytest.raises(DataError, match=f"has lost its {FILE_NAME}, .*`bench runs repair {lost}`"):
                Record(path)
        for command in ("resume", "report"):
            code, _, err = bench(command, lost)
            assert code == 3
            assert f"`bench runs repair {lost}`" in err
        recover(lost)
        (lost / SECOND_NAME).unlink()
        assert find_journals(lost.parent) == [lost / FILE_NAME]
        with pytest.raises(DataError, match=f"{lost / RECOVERED_NAME} is a recovered copy of it"):
            Record(lost)

    def test_that_cannot_be_read_names_the_way_back(self, tmp_path):
        (tmp_path / FILE_NAME).write_bytes(b"nothing" * 99)
        with pytest.raises(DataError, match=r"not a readable journal: .*; `bench runs repair .* says what is left"):
            Record(tmp_path)
        (tmp_path / "notes.txt").write_bytes(b"nothing" * 99)
        with pytest.raises(DataError, match=r"not a readable journal: file is not a database$"):
            Record(tmp_path / "notes.txt")


class TestWritingOnACopyThatLacksRows:
    @pytest.fixture
    def copy(self, folder):
        """A recovered copy of a run that died, which lacks a tick in the middle."""
        with closing(sqlite3.connect(folder / FILE_NAME)) as db, db:
            db.execute("DELETE FROM meta WHERE key IN ('status', 'reason', 'finished', 'safe_state', 'counts')")
            db.execute("UPDATE telemetry SET t = t + 1 WHERE tick = 3")
        recover(folder)
        (folder / FILE_NAME).unlink()
        (folder / RECOVERED_NAME).rename(folder / FILE_NAME)
        return folder

    def test_gives_no_number_twice(self, copy):
        with Record(copy) as record:
            before = record.telemetry()["t"].tolist()
        journal = Journal.reopen(copy)
        assert journal.ticks == len(before) + 1
        journal.telemetry(99.0, 5, (1.0,) * len(journal.signals))
        with pytest.raises(RecordError, match="lacks rows that were lost before the run was resumed: 1 of telemetry"):
            journal.finish(status="completed", reason="", finished=99.0, safe_state={})
        journal.close()
        with Record(copy) as record:
            assert record.telemetry()["t"].tolist() == [*before, 99.0]
            assert record.status == "failed"
            assert "it lacks rows that were lost" in record.meta["reason"]
            np.testing.assert_equal(record.meta["counts"]["telemetry"], len(before) + 2)
        assert not (copy / SECOND_NAME).exists()

    def test_takes_a_row_in_that_a_second_file_has(self, completed, copy):
        with closing(sqlite3.connect(completed / FILE_NAME)) as db:
            row = db.execute("SELECT * FROM telemetry WHERE tick = 3").fetchone()
        with Record(copy) as record:
            second = SecondFile(copy / SECOND_NAME, record.identity)
        second.append([Row("telemetry", row[:-1])])
        second.close()
        assert checksum(row[:-1]) == row[-1]
        Journal.reopen(copy).close()
        with Record(completed) as before, Record(copy) as after:
            assert after.telemetry()["t"].tolist() == before.telemetry()["t"].tolist()

    @pytest.mark.parametrize(("table", "key"), [("steps", "step"), ("events", "event")])
    def test_is_refused_where_steps_or_events_are_lost(self, copy, table, key):
        with closing(sqlite3.connect(copy / FILE_NAME)) as db, db:
            db.execute(f"DELETE FROM {table} WHERE {key} = 2")
        with pytest.raises(DataError, match=f"lacks 1 of its {table}, which are lost"):
            Journal.reopen(copy)
