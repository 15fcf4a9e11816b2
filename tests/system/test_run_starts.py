"""A run that cannot start leaves nothing behind; one whose record is lost says how many steps it has."""

import inspect
import io
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from heater_laboratory import CLOSED, HeaterLaboratory
from heater_protocols import stairs
from rich.console import Console

from bench.base import ConfigurationError, RecordError
from bench.execution import Run, carry_out
from bench.protocol import Dwell, Messages, ProtocolParameters, Step, parameter, protocol
from bench.record import FILE_NAME, RIG_FILE_NAME, NewFolder, Record, recover


@pytest.fixture
def full():
    """Have no file of this process grow beyond a size."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    former = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, former)


@pytest.fixture
def asked(tmp_path, rig_file):
    CLOSED.clear()
    yield Run(stairs, {}, rig_file(), tmp_path / "runs" / "deep", clock="virtual", recording=False)
    assert HeaterLaboratory.opened == 0


def silent():
    return Console(file=io.StringIO())


@pytest.mark.parametrize(
    ("size", "said"), [(100, r"the folder of the run, .*, cannot be written: .*; nothing has moved"),
                       (30_000, r"journal\.sqlite cannot be made: ")],
)  # fmt: skip
def test_a_run_without_space_to_start_leaves_no_folder(asked, tmp_path, full, size, said):
    full(size)
    with pytest.raises(ConfigurationError, match=said):
        carry_out(asked, silent())
    assert not (tmp_path / "runs").exists()


def test_a_folder_above_that_was_there_stays(asked, tmp_path, full):
    (tmp_path / "runs").mkdir()
    full(100)
    with pytest.raises(ConfigurationError):
        carry_out(asked, silent())
    assert [*(tmp_path / "runs").iterdir()] == []


def test_a_start_that_fails_behind_the_journal_leaves_no_folder(asked, tmp_path, monkeypatch):
    def fail(*_):
        raise ConfigurationError("no display")

    monkeypatch.setattr("bench.execution.context.ProgressDisplay", fail)
    with pytest.raises(ConfigurationError, match="no display"):
        carry_out(asked, silent())
    assert not (tmp_path / "runs").exists()


LOADED = []


@protocol(needs=())
def see_what_is_loaded(parameters: ProtocolParameters) -> Messages:
    """Note whether the filters are loaded before the first step."""
    LOADED.append("filterpy.kalman" in sys.modules)
    yield Step({}, Dwell(0.0))


def test_filters_are_loaded_before_a_run_on_real_time_begins(asked, monkeypatch):
    monkeypatch.delitem(sys.modules, "filterpy.kalman", raising=False)
    LOADED.clear()
    carry_out(replace(asked, protocol=see_what_is_loaded, clock="x100", rehearse=False), silent())
    assert LOADED
    assert all(LOADED)


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_run_writes_nothing_into_the_repository_of_its_programs(tmp_path, rig_file):
    def git(*words):
        subprocess.run(["git", *words], cwd=tmp_path, check=True, capture_output=True)

    git("init")
    (tmp_path / "file").write_text("content")
    git("add", "file")
    git("-c", "user.name=n", "-c", "user.email=e", "commit", "-m", "first")
    # `git status` would note the new time in its index.
    os.utime(tmp_path / "file", (1.0, 1.0))
    index = (tmp_path / ".git" / "index").read_bytes()
    protocol_file = Path(inspect.getfile(stairs.generator))
    words = ["run", f"{protocol_file}:stairs", "--rig", rig_file(), "--clock", "virtual", "--out", tmp_path / "runs"]
    where = {**os.environ, "GIT_DIR": str(tmp_path / ".git"), "GIT_WORK_TREE": str(tmp_path)}
    subprocess.run([sys.executable, "-m", "bench", *words], check=True, capture_output=True, env=where)
    (folder,) = (tmp_path / "runs").iterdir()
    with Record(folder) as record:
        assert record.meta["git"].endswith(" with changes")
    assert (tmp_path / ".git" / "index").read_bytes() == index


class TestNewFolder:
    def test_with_something_of_others_stays(self, tmp_path):
        with NewFolder() as new:
            folder = new.make(tmp_path / "runs", "a")
            (folder / RIG_FILE_NAME).touch()
            (folder / "notes.txt").write_text("mine")
        assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", RIG_FILE_NAME]

    def test_with_a_file_that_should_be_empty_stays(self, tmp_path):
        for text in ("", "stacks"):
            with NewFolder(("a.jsonl",), ("stacks.txt",)) as new:
                folder = new.make(tmp_path / "runs", "a")
                (folder / "a.jsonl").write_text("begin")
                (folder / "stacks.txt").write_text(text)
            assert folder.exists() is bool(text)

    def test_beside_another_run_is_removed_alone(self, tmp_path):
        with NewFolder() as new:
            folder = new.make(tmp_path / "runs", "a")
            other = NewFolder().make(tmp_path / "runs", "b")
        assert [*(tmp_path / "runs").iterdir()] == [other]
        assert not folder.exists()


class Parameters(ProtocolParameters):
    folder: str = parameter("", unit="", help="below which the journal is")


@protocol(needs=("tec",))
def lose(parameters: Parameters) -> Messages:
    """Lose the journal before the third step is recorded."""
    for i in range(5):
        if i == 2:
            # None while the run is planned.
            for journal in Path(parameters.folder).rglob(FILE_NAME):
                journal.unlink()
        yield Step({"tec": 30.0 + i}, Dwell(0.5))


def test_the_step_that_a_lost_journal_ends_the_run_with_is_counted(rig_file, tmp_path):
    run = Run(lose, {"folder": str(tmp_path)}, rig_file(), tmp_path / "runs", clock="virtual", recording=False)
    outcome = carry_out(run, silent()).outcome
    assert isinstance(outcome.error, RecordError)
    assert outcome.is_safe
    (folder,) = (tmp_path / "runs").iterdir()
    found = recover(folder)
    assert found.is_complete
    with Record(found.copy) as record:
        assert len(record.steps()) == outcome.steps == 3
