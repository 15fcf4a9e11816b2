"""What is left of a journal of which a page is overwritten, or that is gone: found, said, and read again."""

import random
import shutil
import sqlite3
import time
from contextlib import closing
from datetime import datetime

import numpy as np
import pytest
from heater_laboratory import RIG
from heater_protocols import stairs

import bench as face
from bench.base import ConfigurationError, DataError, RecordError
from bench.devices import Signal
from bench.record import (
    FILE_NAME,
    NAME as MIRROR_NAME,
    RECOVERED_NAME,
    Event,
    Journal,
    Record,
    find_journals,
    recover,
)
from bench.record.keeping import Keeper
from bench.record.mirror import Mirror
from bench.record.rows import checksum, ticks


@pytest.fixture(params=["America/Los_Angeles"])
def zone(request):
    """Let the computer stand in another time zone; Windows has no such variable."""
    set_zone = getattr(time, "tzset", int)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", request.param)
        set_zone()
        yield
    set_zone()


@pytest.fixture(scope="module")
def completed(tmp_path_factory):
    """The journal of a completed run on the heater."""
    folder = tmp_path_factory.mktemp("completed")
    (folder / "heater.toml").write_text(RIG, encoding="utf-8")
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
    @pytest.mark.parametrize("table", ["meta", "signals", "files"])
    def test_leaves_the_rows_of_the_other_tables(self, bench, completed, folder, tmp_path, table):
        overwrite(folder, table)
        code, out, err = bench("recover-journal", folder)
        assert (code, err) == (8, "")
        assert "status: failed" in out
        before, after = rows_of(completed), rows_of(folder / RECOVERED_NAME)
        assert after[:3] == before[:3]
        assert after[3] == ({} if table == "files" else before[3])
        with Record(folder / RECOVERED_NAME) as record:
            assert record.status == "failed"
            assert record.meta["recovered"]["lost"][table] > 0
            assert list(record.meta["recovered"]["lost"]) == [table]
            assert [signal.name for signal in record.signals][:2] == ["tec_setpoint", "tec_temperature"]
            assert (record.signals[0].unit == "?") is (table == "signals")
        # What is read of a run can be read of the copy.
        copy = tmp_path / "copy"
        copy.mkdir()
        shutil.copy(folder / RECOVERED_NAME, copy / FILE_NAME)
        for command in (
            ["runs", tmp_path],
            ["report", copy, "--out", tmp_path / "report"],
            ["compare", copy, completed],
        ):
            assert bench(*command)[0] == 0

    @pytest.mark.usefixtures("zone")
    def test_that_has_the_metadata_leaves_what_other_rows_tell_of_them(self, completed, folder):
        overwrite(folder, "meta")
        found = recover(folder)
        assert found.tables["meta"].missing > 20
        with Record(completed) as before, Record(found.copy) as after:
            assert after.meta["rig_file"] == before.meta["rig_file"]
            assert after.meta["run"] == folder.name
            assert after.meta["finished"] == before.meta["finished"]
            assert (after.meta["rig"], after.meta["protocol"]) == ("unknown", "unknown")
            assert "protocol" in after.meta["recovered"]["substituted"]
            # The folder is named after the second, in UTC wherever the computer stands.
            assert abs(_seconds(after.meta["epoch"]) - _seconds(before.meta["host"]["started"])) < 60.0

    def test_of_a_copy_without_metadata_is_neither_repeated_nor_resumed(self, bench, folder, tmp_path):
        overwrite(folder, "meta")
        copy = tmp_path / "copy"
        copy.mkdir()
        recover(folder, out=copy / FILE_NAME)
        for command in (["repeat", copy, "--out", tmp_path / "again"], ["resume", copy]):
            code, _, err = bench(*command)
            assert code in (2, 3)
            assert "a recovered copy of a record whose metadata were lost" in err

    def test_that_is_the_first_leaves_nothing_and_says_so(self, bench, folder):
        overwrite(folder, None)
        code, _, err = bench("recover-journal", folder)
        assert code == 3
        assert "nothing of it is readable by SQLite: file is not a database" in err
        assert "there is no second file of it (journal.mirror in its folder" in err
        (folder / MIRROR_NAME).write_bytes(b"nothing")
        code, _, err = bench("recover-journal", folder)
        assert code == 3
        assert f"nor of {folder / MIRROR_NAME}" in err

    def test_of_rows_that_only_a_second_file_has_is_no_loss(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, (), {"rig": "vo2"})
        journal.event(Event(0.0, "INFO", "note", "one"))
        mirror = (tmp_path / MIRROR_NAME).read_bytes()
        journal.close()
        (tmp_path / MIRROR_NAME).write_bytes(mirror)
        overwrite(tmp_path, "meta")
        found = recover(tmp_path)
        assert found.is_complete
        # The number of the journal is one of them.
        assert found.tables["meta"].added == 3

    def test_of_a_second_file_that_has_lost_its_beginning_leaves_the_rows(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, [Signal("force", "N", "")], {"rig": "vo2"})
        for tick in range(3):
            journal.telemetry(0.1 * tick, 0, (float(tick),))
        journal.event(Event(1.0, "INFO", "note", "one"))
        content = (tmp_path / MIRROR_NAME).read_bytes()
        journal.close()
        # The rows of metadata, signals and telemetry begin with the number of their table.
        (tmp_path / MIRROR_NAME).write_bytes(content[content.index(b"\xb5row\x03") :])
        (tmp_path / FILE_NAME).unlink()
        found = recover(tmp_path)
        assert not found.is_complete
        with Record(found.copy) as record:
            assert record.telemetry()["signal_0"].tolist() == [0.0, 1.0, 2.0]
            assert record.signals[0].unit == "?"


def _seconds(time):
    return datetime.fromisoformat(time).timestamp()


class TestDamage:
    def test_is_found_by_a_quick_look(self, completed, folder):
        with Record(completed) as record:
            assert record.damage() == ""
        with closing(sqlite3.connect(folder / FILE_NAME)) as db, db:
            db.execute("UPDATE telemetry SET t = t + 1 WHERE tick = 3")
        with Record(folder) as record:
            assert "table telemetry, row 3: its checksum does not fit; `bench recover-journal" in record.damage()

    def test_is_found_in_a_page_that_is_overwritten(self, folder):
        overwrite(folder, "telemetry")
        with Record(folder) as record:
            assert "bench recover-journal" in record.damage()

    def test_is_a_row_that_is_missing(self, folder):
        with closing(sqlite3.connect(folder / FILE_NAME)) as db, db:
            db.execute("DELETE FROM telemetry WHERE tick = 3")
        with Record(folder) as record:
            assert record.missing.ranges == {"telemetry": ((3, 3),)}
            assert "bench recover-journal" in record.damage()

    def test_that_recovery_says_is_not_called_completed(self, bench, folder):
        with closing(sqlite3.connect(folder / FILE_NAME)) as db, db:
            db.execute("UPDATE telemetry SET t = t + 1 WHERE tick = 3")
        code, out, _ = bench("recover-journal", folder)
        assert code == 8
        assert "status: failed" in out
        assert "completed" not in out


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
            with pytest.raises(DataError, match=f"has lost its {FILE_NAME}, .*`bench recover-journal {lost}`"):
                Record(path)
        for command in ("resume", "report"):
            code, _, err = bench(command, lost)
            assert code == 3
            assert f"`bench recover-journal {lost}`" in err
        recover(lost)
        (lost / MIRROR_NAME).unlink()
        assert find_journals(lost.parent) == [lost / FILE_NAME]
        with pytest.raises(DataError, match=f"{lost / RECOVERED_NAME} is a recovered copy of it"):
            Record(lost)

    def test_is_told_from_no_run(self, tmp_path):
        (tmp_path / "nothing").mkdir()
        assert find_journals(tmp_path) == []
        with pytest.raises(DataError, match=f"nothing is not a run: there is no {FILE_NAME}"):
            Record(tmp_path / "nothing")

    def test_that_cannot_be_read_names_the_way_back(self, tmp_path):
        (tmp_path / FILE_NAME).write_bytes(b"nothing" * 99)
        with pytest.raises(
            DataError, match=r"not a readable journal: .*; `bench recover-journal .* says what is left"
        ):
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
        assert not (copy / MIRROR_NAME).exists()

    def test_takes_a_row_in_that_a_second_file_has(self, completed, copy):
        with closing(sqlite3.connect(completed / FILE_NAME)) as db:
            row = db.execute("SELECT * FROM telemetry WHERE tick = 3").fetchone()
        with Record(copy) as record:
            mirror = Mirror(copy / MIRROR_NAME, record.identity)
        mirror.append([ticks([row[:-1]])])
        mirror.close()
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


def test_a_journal_that_cannot_be_made_leaves_nothing(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError("no space")

    monkeypatch.setattr(Keeper, "begin", refuse)
    with pytest.raises(ConfigurationError, match="cannot be made: no space"):
        Journal(tmp_path / FILE_NAME, (), {})
    assert [*tmp_path.iterdir()] == []
