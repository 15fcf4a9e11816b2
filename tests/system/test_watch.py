"""Runs that are watched from another process, replayed, and shown in a browser."""

import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import pytest
import rerun_cli
from rerun.chunk import RrdReader

from bench.base import WallClock
from bench.cli import main
from bench.dashboard import JournalView, has_display, web_viewer
from bench.record import FILE_NAME, Record

BENCH = [sys.executable, "-P", "-u", "-m", "bench"]
# As where nobody sits at the machine.
NO_DISPLAY = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}
PATIENCE = 120.0
# Does not end by itself within a test.
ENDLESS = ["run", "creep", "--rig", "vo2", "--clock", "x20", "--no-rehearse", "--set", "duration=36000"]
CREEP = ["creep", "--rig", "vo2", "--clock", "virtual", "--set", "duration=20", "--set", "settling=2"]


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs")
    with pytest.raises(SystemExit) as stopped:
        main(["run", *CREEP, "--out", str(out)])
    assert not stopped.value.code
    (journal,) = out.glob(f"*/{FILE_NAME}")
    return journal.parent


@contextmanager
def started(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [*BENCH, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=NO_DISPLAY
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate()


def wait_for(process: subprocess.Popen[str], text: str) -> str:
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if text in line:
            return line
    raise AssertionError(f"{text!r} is not in {''.join(lines)}")


def wait_until(condition: object) -> None:
    clock = WallClock()
    while not condition():  # type: ignore[operator]
        assert clock.now() < PATIENCE
        clock.sleep(0.2)


def received(uri: str, path: Path, enough: int) -> int:
    """Return how many readings a client gets from an address, which it asks until there are enough."""
    viewer = Path(rerun_cli.__file__).parent / "rerun"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    command = [str(viewer), "--save", str(path), "--bind", "127.0.0.1", "--port", port, uri]
    saving = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def count() -> int:
        if not path.is_file() or path.stat().st_size < 10_000:
            return 0
        # A copy, as it is still written.
        shutil.copy(path, path.with_suffix(".copy.rrd"))
        with warnings.catch_warnings():
            # It has no footer yet.
            warnings.simplefilter("ignore")
            chunks = list(RrdReader(path.with_suffix(".copy.rrd")).stream())
        readings = (chunk for chunk in chunks if str(chunk.entity_path) == "/readings/temperature")
        return sum(chunk.num_rows for chunk in readings if not chunk.is_static)

    try:
        wait_until(lambda: count() >= enough)
    finally:
        saving.terminate()
        saving.wait()
    return count()


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stopped:
        main(list(arguments))
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return int(stopped.value.code or 0), said


@pytest.mark.seeds
def test_a_run_in_progress_is_watched_from_another_process_and_once_more(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    with started(*ENDLESS, "--out", str(runs)) as run:
        wait_until(lambda: list(runs.glob(f"*/{FILE_NAME}")))
        (journal,) = runs.glob(f"*/{FILE_NAME}")
        for i, what in enumerate((str(runs), str(journal.parent))):
            with started("view", what, "--port", "0") as watch:
                uri = wait_for(watch, "rerun+http").split()[-1]
                assert received(uri, tmp_path / f"{i}.rrd", enough=10) >= 10
        assert run.poll() is None
        # What is watched ends with the run.
        with started("view", str(runs), "--port", "0") as watch:
            wait_for(watch, "rerun+http")
            run.send_signal(signal.SIGTERM)
            assert "aborted" in wait_for(watch, "the run has ended")
    with Record(journal) as record:
        assert record.status == "aborted"


def test_a_view_follows_a_journal_and_knows_its_end(ended: Path) -> None:
    with JournalView(ended, 0) as view:
        assert view.follow() == "completed"
        # Nothing twice.
        with Record(ended) as record:
            assert view._tail.parts(record) == []


def test_a_replay_takes_its_time(ended: Path, tmp_path: Path) -> None:
    with Record(ended) as record:
        steps = len(list(record.step_records()))
    with started("view", str(ended), "--speed", "1000", "--port", "0") as replay:
        uri = wait_for(replay, "rerun+http").split()[-1]
        wait_for(replay, "the replay has ended")
        assert received(uri, tmp_path / "all.rrd", enough=steps) == steps


def test_what_cannot_be_shown_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "runs").mkdir()
    code, said = refused(capsys, "view", str(tmp_path / "runs"))
    assert code in (2, 3)
    assert str(tmp_path / "runs") in said
    code, said = refused(capsys, "view", "rerun+http://127.0.0.1:1/proxy")
    assert code == 3
    assert "nothing is shown there" in said


def test_a_damaged_run_is_not_replayed(tmp_path: Path, ended: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(ended, tmp_path / "damaged")
    journal = tmp_path / "damaged" / FILE_NAME
    db = sqlite3.connect(journal)
    db.execute("UPDATE telemetry SET t = t + 1 WHERE tick = 3")
    db.commit()
    db.close()
    code, said = refused(capsys, "view", str(journal))
    assert code == 3
    assert "row 3" in said
    journal.write_bytes(b"no database")
    code, said = refused(capsys, "view", str(journal))
    assert code == 3
    assert "not a readable journal" in said


def test_a_window_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":0")
    assert has_display()
    monkeypatch.delenv("DISPLAY")
    assert not has_display()


def test_the_viewer_for_browsers_is_not_reachable_from_outside(ended: Path) -> None:
    with JournalView(ended, 0) as view, web_viewer(view.uri) as address:
        host = address.split("/")[2]
        with urlopen(f"http://{host}/") as page:
            assert b"rerun" in page.read().lower()
        # A server of every address of the machine answers at this one, too.
        with pytest.raises(OSError, match=r"refused|assign|unreachable"):
            socket.create_connection(("127.0.0.2", int(host.rpartition(":")[2])), timeout=PATIENCE)
