import io
import random
import shutil
import sqlite3
from dataclasses import replace
from functools import reduce
from hashlib import sha256
from itertools import pairwise

import numpy as np
import pytest
from heater_laboratory import CLOSED, HeaterLaboratory, Plate
from heater_protocols import stairs
from killing import distance, kill_after
from rich.console import Console

import bench
from bench.base import AbortError, AgreementError, ConfigurationError, DataError
from bench.cli import main
from bench.execution import Resume, resume
from bench.execution.engine import Engine
from bench.execution.resumption.corners import corners
from bench.execution.resumption.feeding import Past
from bench.models import MemoryCurve
from bench.record import FILE_NAME, RECOVERED_NAME, Journal, Record
from bench.rig import Holder, Locks

pytestmark = pytest.mark.usefixtures("warm_popen")

OSCILLATION = {
    "vo2": {"increment": 3.0, "half_cycles": 12},
    "sma": {"increment": 0.5, "half_cycles": 10, "dwell": 10.0},
    "hybrid": {"increment": 8.0, "half_cycles": 12},
}


LOOPS = """
from bench.control import Trace
from bench.protocol import FixedRate, Messages, ProtocolParameters, protocol

class P(ProtocolParameters):
    pass

class Counting:
    count = 0
    trace = Trace()

    def update(self, t, measured):
        self.count += 1
        return (30.0 + 0.1 * self.count,)

@protocol(needs=("tec",), controls="probe_temperature")
def loops(parameters: P) -> Messages:
    "Count."
    first = Counting()
    second = first if SHARED else Counting()
    for label, controller in (("first", first), ("second", second)):
        yield FixedRate(
            controller=controller, rate=2.0, duration=6.0, inputs=("probe_temperature",),
            actuators=("tec",), label=label
        )
"""


def silent():
    return Console(file=io.StringIO())


def steps_of(folder):
    with Record(folder) as record:
        return list(record.step_records())


def cut(folder, steps):
    """Leave a record as if its process had died some time after a step."""
    db = sqlite3.connect(folder / FILE_NAME)
    end = db.execute("SELECT finished FROM steps WHERE step = ?", (steps - 1,)).fetchone()[0]
    db.execute("DELETE FROM steps WHERE step >= ?", (steps,))
    for table in ("telemetry", "events"):
        db.execute(f"DELETE FROM {table} WHERE t > ?", (end + 0.5,))
    db.execute("DELETE FROM meta WHERE key IN ('status', 'reason', 'finished', 'safe_state', 'counts')")
    db.commit()
    db.close()


class TestCorners:
    def test_are_those_that_a_hysteresis_remembers(self):
        rng = np.random.default_rng(3)
        for _ in range(50):
            values = np.round(np.cumsum(rng.normal(size=60)), 1)
            plane = values.min(), values.max()
            way = [values[i] for i in corners(values.tolist())]
            # From saturation to either side the shortest way leads to the same memory.
            below = MemoryCurve.from_negative_saturation(plane[0] - 9.0)
            above = MemoryCurve.from_positive_saturation(plane[1] + 9.0)
            found = {
                str(reduce(MemoryCurve.step, path, start).staircase(*plane))
                for start in (below, above)
                for path in (values, way)
            }
            assert len(found) == 1
            assert len(way) < len(values)


@pytest.fixture
def climb(tmp_path, rig_file):
    """Carry stairs out on the heater, and let them die after some steps."""

    def run(steps=6, died_after=3, **settings):
        folder = bench.run(stairs, rig_file(), out=tmp_path / "runs", count=steps, **settings).folder
        cut(folder, died_after)
        return folder

    CLOSED.clear()
    yield run
    assert HeaterLaboratory.opened == 0


class TestResume:
    def test_goes_on_in_the_same_record(self, climb):
        folder = climb()
        before, last = steps_of(folder), steps_of(folder)[-1]
        result = resume(Resume(folder=folder), silent())
        assert result.outcome.status == "completed"
        assert result.folder == folder
        after = steps_of(folder)
        assert after[:3] == before
        assert [step.step for step in after] == list(range(6))
        assert all(later.started >= earlier.finished for earlier, later in pairwise(after))
        with Record(folder) as record:
            events = record.events()
            assert [e.text for e in events if e.kind == "phase"] == ["climb"]
            # Those of the readings that were fed back are not noted a second time.
            notes = [e.text for e in events if e.kind == "note"]
            assert notes == ["climbing", *(f"step {s.step} at {s.values[-1]:.3f} °C" for s in after)]
            (how, *_) = [e.text for e in events if e.kind == "resumed"]
            assert "after step 2 (up)" in how
            (entry,) = record.meta["resumes"]
            assert entry["after_step"] == 2
            way = record.telemetry()
            assert (way["t"][way["step"] == -1] > last.finished).all()
            assert (way["step"] == -1).any()

    def test_feeds_back_to_the_last_step_of_several_deaths(self, climb):
        folder = climb(steps=8, died_after=2)
        resume(Resume(folder=folder), silent())
        cut(folder, 5)
        resume(Resume(folder=folder), silent())
        assert [step.step for step in steps_of(folder)] == list(range(8))
        with Record(folder) as record:
            assert [entry["after_step"] for entry in record.meta["resumes"]] == [1, 4]

    def test_of_a_recovered_copy_says_where_it_has_to_be(self, climb):
        folder = climb()
        (folder / FILE_NAME).rename(folder / RECOVERED_NAME)
        other = folder.with_name(f"{folder.name}-recovered")
        with pytest.raises(ConfigurationError) as refused:
            resume(Resume(folder=folder / RECOVERED_NAME), silent())
        command = f"mkdir {other} && cp {folder / RECOVERED_NAME} {other / FILE_NAME}"
        assert f"`{command}`, and then `bench resume {other}`" in str(refused.value)
        other.mkdir()
        shutil.copy(folder / RECOVERED_NAME, other / FILE_NAME)
        assert resume(Resume(folder=other), silent()).outcome.status == "completed"

    def test_refuses_what_cannot_be_resumed(self, climb, tmp_path, rig_file):
        completed = bench.run(stairs, rig_file(), out=tmp_path / "done").folder
        with pytest.raises(ConfigurationError, match=r"was completed; there is nothing to resume"):
            resume(Resume(folder=completed), silent())
        (tmp_path / "foreign.txt").write_text("not a run")
        with pytest.raises(DataError, match=r"foreign\.txt is not a readable journal"):
            resume(Resume(folder=tmp_path / "foreign.txt"), silent())
        with pytest.raises(DataError, match=r"is not a run"):
            resume(Resume(folder=tmp_path), silent())
        folder = climb()
        with pytest.raises(ConfigurationError, match=r"is a run on rig heater; vo2 is another one"):
            resume(Resume(folder=folder, rig="vo2"), silent())
        with Locks(Holder.of_this_process("heater", f"run {folder}")) as locks:
            locks.take_folder(folder)
            with pytest.raises(ConfigurationError, match=r"folder .* is in use: it is held by .*process \d+"):
                resume(Resume(folder=folder), silent())
        assert len(steps_of(folder)) == 3

    def test_refuses_a_run_without_a_finished_step(self, climb):
        folder = climb(died_after=1)
        db = sqlite3.connect(folder / FILE_NAME)
        db.execute("DELETE FROM steps")
        db.execute("DELETE FROM events WHERE text LIKE 'step 0 at%'")
        db.commit()
        db.close()
        with pytest.raises(ConfigurationError, match=r"has no finished step to go on from; start the run again"):
            resume(Resume(folder=folder), silent())

    def test_refuses_another_version_unless_it_is_accepted(self, climb):
        folder = climb()
        Journal.reopen(folder, {"packages": {"numpy": "1.0"}}).close()
        with pytest.raises(ConfigurationError, match=r"started otherwise: .*packages\.numpy: 1\.0 → "):
            resume(Resume(folder=folder), silent())
        assert len(steps_of(folder)) == 3
        assert resume(Resume(folder=folder, accept_changes=True), silent()).outcome.status == "completed"
        with Record(folder) as record:
            assert any("accepted changes: packages" in event.text for event in record.events())

    def test_refuses_a_protocol_that_does_other_than_the_record(self, tmp_path, rig_file):
        file = tmp_path / "own.py"
        text = (
            "from bench.protocol import Dwell, Messages, ProtocolParameters, Step, protocol\n\n"
            "class P(ProtocolParameters):\n    pass\n\n"
            "@protocol(needs=('tec',))\ndef own(parameters: P) -> Messages:\n    'Mine.'\n"
            "    for i in range(4):\n        yield Step({'tec': 30.0 + 5.0 * i}, Dwell(1.0))\n"
        )
        file.write_text(text)
        folder = bench.run(str(file), rig_file(), out=tmp_path / "runs").folder
        cut(folder, 2)
        # The file is in the record; it counts, not what has become of it.
        file.unlink()
        db = sqlite3.connect(folder / FILE_NAME)
        other = text.replace("5.0 * i", "6.0 * i").encode()
        db.execute(
            "UPDATE files SET content = ?, sha256 = ? WHERE name = 'protocol.py'", (other, sha256(other).hexdigest())
        )
        db.commit()
        for accepted in (False, True):
            with pytest.raises(ConfigurationError, match=r"step 1 sets \{'tec': 36\.0\}, in the record \{'tec': 35"):
                resume(Resume(folder=folder, accept_changes=accepted), silent())
        same = text.encode()
        db.execute(
            "UPDATE files SET content = ?, sha256 = ? WHERE name = 'protocol.py'", (same, sha256(same).hexdigest())
        )
        db.commit()
        db.close()
        assert resume(Resume(folder=folder), silent()).outcome.status == "completed"

    @pytest.mark.parametrize("shared", [False, True])
    def test_refuses_a_fast_loop_that_goes_on_with_the_controller_of_another(self, shared, tmp_path, rig_file):
        file = tmp_path / "loops.py"
        file.write_text(LOOPS.replace("SHARED", str(shared)))
        folder = bench.run(str(file), rig_file(), out=tmp_path / "runs").folder
        cut(folder, 1)
        if shared:
            with pytest.raises(ConfigurationError, match=r"the fast loop 'second' goes on with a controller"):
                resume(Resume(folder=folder), silent())
        else:
            assert resume(Resume(folder=folder), silent()).outcome.status == "completed"
        assert len(steps_of(folder)) == 2 - shared

    def test_stops_where_the_specimen_is_another(self, climb, monkeypatch):
        folder = climb(dwell=20.0)
        # A tenth of what it went through.
        monkeypatch.setattr(Plate, "sensed", lambda plate: plate.now() + 1.0)
        result = resume(Resume(folder=folder), silent())
        assert isinstance(result.outcome.error, AgreementError)
        assert result.outcome.is_safe
        assert len(steps_of(folder)) == 3
        again = resume(Resume(folder=folder, accept_disagreement=True), silent())
        assert again.outcome.status == "completed"
        assert [step.step for step in steps_of(folder)] == list(range(6))


@pytest.fixture(scope="module", params=["hybrid", "sma"])
def whole(request, tmp_path_factory):
    """A run along a random sequence, to be cut anywhere."""
    out = tmp_path_factory.mktemp(request.param)
    return bench.run("random-validation", request.param, out=out, count=125).folder


@pytest.mark.slow
class TestAgreement:
    """A battery that is read in steps, a room that wanders and a piezo that creeps are no change of the specimen."""

    def compared(self, whole, copy, steps, monkeypatch):
        """Bring the specimen back from where a run died; return what the events say of the comparison."""
        shutil.copytree(whole, copy)
        cut(copy, steps)
        # What follows the comparison is not what is tested.
        monkeypatch.setattr(Engine, "_step", _leave)
        with Record(copy) as record:
            before = len(record.events())
        outcome = resume(Resume(folder=copy, accept_changes=True), silent()).outcome
        with Record(copy) as record:
            return outcome.error, [event.text for event in record.events()[before:] if event.kind == "resumed"]

    @pytest.mark.parametrize("steps", [31, 122])
    def test_the_specimen_of_the_run_is_accepted(self, whole, tmp_path, monkeypatch, steps):
        error, texts = self.compared(whole, tmp_path / "run", steps, monkeypatch)
        assert not isinstance(error, AgreementError), error
        assert texts[-1].endswith("as in the last readings of the record")

    @pytest.mark.parametrize("share", [-0.1, 0.1])
    def test_one_that_is_elsewhere_is_refused(self, whole, tmp_path, monkeypatch, share):
        read = Past.of
        monkeypatch.setattr(Past, "of", lambda record: _shifted(read(record), share))
        error, _ = self.compared(whole, tmp_path / "run", 61, monkeypatch)
        assert isinstance(error, AgreementError)


def _leave(*_):
    raise AbortError("the comparison is over")


def _shifted(past, share):
    """Return a past in which the response was elsewhere, by a share of what it went through."""
    (column,) = (past.names.index(n) for n in ("displacement_position", "wire_end_position") if n in past.names)
    values = [step.values[column] for step in past.steps]
    shift = share * (max(values) - min(values))
    moved = [
        replace(step, values=(*step.values[:column], step.values[column] + shift, *step.values[column + 1 :]))
        for step in past.steps
    ]
    return replace(past, steps=tuple(moved))


@pytest.mark.parametrize("rig", [pytest.param("vo2", marks=pytest.mark.seeds), "sma", "hybrid"])
def test_a_killed_run_is_resumed_to_the_model_of_an_uninterrupted_one(rig, tmp_path, capsys):
    settings = OSCILLATION[rig]
    whole = bench.run("damped-oscillation", rig, out=tmp_path / "whole", **settings)
    arguments = [f"--set={name}={value}" for name, value in settings.items()]
    command = ["run", "damped-oscillation", "--rig", rig, "--clock", "virtual", *arguments]
    steps = random.Random(rig).randrange(5, 40)
    killed = kill_after(steps, tmp_path / "killed", *command, "--out", str(tmp_path / "killed"))
    with pytest.raises(SystemExit) as ended:
        main(["resume", str(killed)])
    assert not ended.value.code, capsys.readouterr().err
    assert len(steps_of(killed)) == len(whole.readings)
    assert distance(killed, whole.folder, "preisach-nonmonotonic", {"levels": 5}) < 1.0


def test_a_controller_goes_on_where_its_readings_had_brought_it(tmp_path):
    measured = bench.run("damped-oscillation", "vo2", out=tmp_path / "model", increment=6.0, half_cycles=4)
    model = tmp_path / "model.json"
    bench.identify(measured, "preisach-nonmonotonic", levels=8, plane=(30.0, 70.0)).file.save(model)
    settings = {"model": str(model), "count": 4, "readings": 2}
    folder = bench.run("tracking", "vo2", out=tmp_path / "runs", **settings).folder
    whole = steps_of(folder)
    assert [len(step.seen) > 3 for step in whole if step.label == "reach"] == [True] * 4
    cut(folder, 8)
    # It is in the record.
    model.unlink()
    assert resume(Resume(folder=folder), silent()).outcome.status == "completed"
    resumed = steps_of(folder)
    assert resumed[:8] == whole[:8]
    assert [step.label for step in resumed] == [step.label for step in whole]
    targets = [step.values[-5] for step in resumed if step.label == "reach"]
    assert targets == [step.values[-5] for step in whole if step.label == "reach"]
    assert not np.isnan(targets).any()


def test_what_was_done_by_hand_is_done_again_in_a_new_laboratory(tmp_path):
    folder = bench.run("force-voltage", "sma", out=tmp_path, points=11, conditioning=1, dwell=20.0).folder
    total = len(steps_of(folder))
    shutil.copytree(folder, tmp_path / "early")
    # After the prompt, before anything was set.
    early = tmp_path / "early"
    cut(early, 2)
    assert resume(Resume(folder=early), silent()).outcome.status == "completed"
    with Record(folder) as whole, Record(early) as resumed:
        forces = [record.steps()["load_cell_force"][-1] for record in (whole, resumed)]
    assert forces[1] == pytest.approx(forces[0], abs=0.1)
    cut(folder, total // 2)
    assert resume(Resume(folder=folder), silent()).outcome.status == "completed"
    assert len(steps_of(folder)) == total
