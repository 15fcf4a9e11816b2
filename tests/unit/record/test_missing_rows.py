"""A record that lacks rows says so wherever it is read, and one that lacks none never does."""

import json
import random
import shutil
import sqlite3
import tempfile
import warnings
from contextlib import closing, suppress

import pytest
from cases import cases
from written_run import META, SIGNALS, write_run

from bench.base import DataError, IncompleteRecordWarning
from bench.devices import Settled
from bench.record import FILE_NAME, NAME as SECOND_NAME, Event, Journal, Record, StepRecord
from bench.record.rows import Row
from bench.record.second_file import SecondFile

STEPS = 14
LOG_NAME = f"{FILE_NAME}-wal"
FRAME = 24 + 4096
KILLED = {**META, "run": "killed", "overrides": {}}

pytestmark = pytest.mark.usefixtures("other_disk")


@pytest.fixture(scope="module")
def other_disk(tmp_path_factory):
    """A folder for temporary files of these tests' own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("temporary")))
        yield


def write_steps(folder, copied_after, *, patience=None, ticks=1):
    """Record steps; return copies of the folder, as a killed process leaves it, after so many of them."""
    folder.mkdir()
    journal = Journal(folder / FILE_NAME, SIGNALS, KILLED, {"rig.toml": b"[rig]"}, patience=patience)
    copies = []
    for i in range(STEPS):
        values = (20.0 + i, 20.0 + i * i, 1e-6 * i, 0.0)
        for k in range(ticks):
            journal.telemetry(8.0 * i + 4.0 + k / ticks, i, values)
        journal.step(StepRecord(i, 8.0 * i, 8.0 * i + 8.0, "loops", "", Settled.DWELL, {"plate": 20.0 + i}, values))
        journal.event(Event(8.0 * i + 8.0, "INFO", "note", f"step {i}"))
        if i + 1 in copied_after:
            copies.append(shutil.copytree(folder, folder.with_name(f"{folder.name}-{i + 1}")))
    journal.close()
    return copies


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """The folder of a run whose process was killed after its last step."""
    (copy,) = write_steps(tmp_path_factory.mktemp("runs") / "run", {STEPS})
    return copy


@pytest.fixture
def folder(killed, tmp_path):
    return shutil.copytree(killed, tmp_path / "run")


def flip(path, bit):
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << (bit % 8)
    path.write_bytes(content)


def used(log):
    """Return how many bytes of a log are not the zeros that it was extended by."""
    return len(log.read_bytes().rstrip(b"\0"))


def missing(folder):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with Record(folder) as record:
            found = record.missing
            assert [str(each.message) for each in said] == ([str(found)] if found else [])
            return found


def test_one_bit_of_the_log_at_any_place_is_noticed(killed, tmp_path):
    chosen = random.Random(0)
    bits = 8 * used(killed / LOG_NAME)
    for number in range(60):
        copy = shutil.copytree(killed, tmp_path / str(number))
        flip(copy / LOG_NAME, chosen.randrange(bits))
        # Of the first frames are the tables themselves.
        with suppress(DataError):
            assert missing(copy), number


@cases("byte", [8, 12])
def test_a_damaged_salt_of_the_last_commit_is_noticed(killed, tmp_path, byte):
    copy = shutil.copytree(killed, tmp_path / "run")
    flip(copy / LOG_NAME, 8 * (32 + (used(killed / LOG_NAME) // FRAME - 1) * FRAME + byte))
    assert "write-ahead log is damaged" in missing(copy).damage


def test_what_is_missing_is_named(folder):
    flip(folder / LOG_NAME, 8 * (32 + used(folder / LOG_NAME) // 2 // FRAME * FRAME + 1000))
    with pytest.warns(IncompleteRecordWarning):
        opened = Record(folder)
    with opened as record:
        assert 0 < len(record.steps()) < STEPS
        assert "write-ahead log" in record.missing.damage
        assert f"bench runs repair {record.path}" in str(record.missing)


def test_a_log_that_is_cut_off_is_noticed(killed, tmp_path):
    whole = (killed / LOG_NAME).read_bytes()
    frames = used(killed / LOG_NAME) // FRAME
    # The last frame ends a commit.
    copy = shutil.copytree(killed, tmp_path / "cut")
    (copy / LOG_NAME).write_bytes(whole[: 32 + (frames - 1) * FRAME + 100])
    assert "cut off" in missing(copy).damage
    assert not missing(killed)


def test_rows_of_the_file_itself_that_are_gone_are_noticed(tmp_path):
    run = write_run(tmp_path / "run", steps=200)
    with closing(sqlite3.connect(run / FILE_NAME)) as db, db:
        db.execute("DELETE FROM telemetry WHERE tick BETWEEN 40 AND 60")
        db.execute("DELETE FROM steps WHERE step >= 190")
        db.execute("DELETE FROM events WHERE event = 1")
    assert missing(run).ranges == {"steps": ((190, 199),), "telemetry": ((40, 60),), "events": ((1, 1),)}


def test_a_page_of_the_file_itself_is_never_lost_in_silence(tmp_path):
    run = write_run(tmp_path / "run", steps=400)
    size = (run / FILE_NAME).stat().st_size
    chosen = random.Random(1)
    for number in range(40):
        copy = shutil.copytree(run, tmp_path / str(number))
        page = chosen.randrange(1, size // 4096)
        # The count of the cells of a page: it reads as a shorter one.
        flip(copy / FILE_NAME, 8 * (4096 * page + 4) + chosen.randrange(2))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                record = Record(copy)
        except DataError:
            continue
        with record:
            try:
                rows = len(record.steps()), len(record.telemetry()), len(record.events())
            except DataError:
                continue
            assert record.missing or rows == (400, 400, 3), page


def test_a_signal_that_is_gone_is_an_error(tmp_path, bench):
    run = write_run(tmp_path / "run", steps=5)
    with closing(sqlite3.connect(run / FILE_NAME)) as db, db:
        db.execute("DELETE FROM signals WHERE name = 'tip'")
    code, _, err = bench("runs", "export", run, "--format", "csv", "--out", tmp_path / "out")
    assert code == 3
    assert "table signals has no row of tip" in err


def test_a_tick_tells_of_a_step_that_is_gone(folder):
    with closing(sqlite3.connect(folder / FILE_NAME)) as db, db:
        db.execute("DELETE FROM steps WHERE step >= 10")
    assert missing(folder).ranges == {"steps": ((10, STEPS - 2),)}


@pytest.mark.parametrize("patience", [None, 30.0], ids=["caller", "background"])
def test_a_run_that_was_killed_lacks_nothing(tmp_path, patience):
    for copy in write_steps(tmp_path / "run", {1, 7, STEPS}, patience=patience, ticks=5):
        assert not missing(copy)


def test_a_finished_run_lacks_nothing(tmp_path):
    assert not missing(write_run(tmp_path / "run", steps=20))


class TestCommands:
    @pytest.fixture
    def damaged(self, folder):
        with closing(sqlite3.connect(folder / FILE_NAME)) as db, db:
            db.execute("DELETE FROM steps WHERE step BETWEEN 3 AND 5")
        return folder

    @pytest.mark.parametrize(
        "command",
        [
            ("runs", "export", "RUN", "--format", "csv", "--out", "OUT"),
            ("runs", "export", "RUN", "--format", "parquet", "--out", "OUT"),
            ("runs", "export", "RUN", "--format", "bluesky", "--out", "OUT"),
            ("runs", "compare", "RUN", "RUN"),
            ("runs", "RUN"),
            ("report", "RUN", "--out", "OUT"),
        ],
        ids=" ".join,
    )
    def test_each_says_once_what_is_missing(self, damaged, tmp_path, bench, command):
        out, result = tmp_path / "out", tmp_path / "result.json"
        words = [{"RUN": damaged, "OUT": out}.get(word, word) for word in command]
        code, _, err = bench(*words, "--json", result)
        assert code == 0
        assert err.count("lacks rows that were recorded") == 1
        assert "steps 3 to 5" in err
        content = json.loads(result.read_text())
        if isinstance(content, dict):
            (text,) = content["missing_rows"]
            assert "lacks rows" in text

    def test_what_is_exported_says_it_too(self, damaged, tmp_path, bench):
        import pyarrow.parquet as pq

        for kind in ("csv", "parquet", "bluesky"):
            assert bench("runs", "export", damaged, "--format", kind, "--out", tmp_path)[0] == 0
        schema = pq.read_schema(tmp_path / "readings.parquet")
        start = json.loads((tmp_path / "documents.jsonl").read_text().splitlines()[0])[1]
        for metadata in (
            json.loads((tmp_path / "metadata.json").read_text()),
            json.loads(schema.metadata[b"bench"]),
            start,
        ):
            assert metadata["missing_rows"]["rows"] == {"steps": [[3, 5]]}

    def test_so_does_the_page(self, damaged, bench):
        assert bench("report", damaged)[0] == 0
        assert "lacks rows that were recorded" in (damaged / "report.html").read_text()

    def test_a_fit_of_it_says_so(self, damaged, tmp_path, bench):
        result = tmp_path / "result.json"
        words = ("--model", "polynomial", "--input", "plate", "--output", "tip", "--json", result)
        _, _, err = bench("identify", damaged, *words)
        assert err.count("lacks rows that were recorded") == 1

    def test_a_recovered_copy_says_so_as_well(self, damaged, bench):
        assert bench("runs", "repair", damaged)[0] == 8
        assert missing(damaged / "journal.recovered.sqlite").ranges == {"steps": ((3, 5),)}

    def test_rows_of_a_second_file_are_said_once_and_are_not_missing(self, folder, tmp_path, bench):
        with Record(folder) as record:
            second = SecondFile(folder / SECOND_NAME, record.identity)
        second.append([Row("events", (STEPS + 1, 9.0, "INFO", "note", "waits"))])
        second.close()
        code, _, err = bench("runs", "export", folder, "--format", "csv", "--out", tmp_path / "out")
        assert code == 0
        assert err.count("lacks 1 rows that its second file") == err.count("warning") == 1
        assert "waits" in (tmp_path / "out" / "events.csv").read_text()
        assert json.loads((tmp_path / "out" / "metadata.json").read_text()).get("missing_rows") is None
        assert bench("runs", "repair", folder)[0] == 0
        with Record(folder / "journal.recovered.sqlite") as record:
            assert record.events()[-1].text == "waits"
