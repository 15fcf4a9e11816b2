import pytest
from benches import TOOLS, is_on, seconds_until
from killing import kill_after

from bench.base import DeviceError
from bench.cli import main
from bench.record import BLACK_BOX_NAME, Record
from bench.rig import clear_expired_watchdogs, load_rig, opened
from sim_devices.serving.process import serve

pytestmark = pytest.mark.usefixtures("warm_popen")

WATCHDOG = 600.0
"""Laboratory time (s), 150 s of the wall clock: a busy machine trips none."""
PATIENT = {"devices.tec.watchdog": WATCHDOG, "devices.tec.timeout": 10, "devices.psd.timeout": 60}


@pytest.fixture
def served():
    with serve("vo2", clock="x4") as rig:
        yield rig


KILL_ITS_GUARDIAN = f"""
    import sys
    sys.path.append({str(TOOLS)!r})
    from benches import rescuer_of
    from guarded_run import find_guardian
    guardian = find_guardian(journal.path.parent)
    os.kill(rescuer_of(guardian), signal.SIGKILL)
    os.kill(guardian, signal.SIGKILL)
"""


def test_clears_what_the_watchdogs_left_and_goes_on(served, tmp_path, capsys):
    settings = ("increment=31.5", "half_cycles=1", "dwell=1")
    command = ["run", "damped-oscillation", "--rig", "vo2", "--attach", str(served.endpoints_file)]
    command += ["--no-rehearse", "--out", str(tmp_path), *(f"--set={setting}" for setting in settings)]
    command += [f"--override={key}={value}" for key, value in PATIENT.items()]
    folder = kill_after(1, tmp_path, *command, before=KILL_ITS_GUARDIAN)
    with Record(folder) as record:
        total = record.meta["plan"]["steps"]
        before = len(record.steps())
    assert before < total
    # Nobody is left who could switch it off: its own watchdog does, and it stays in error.
    assert is_on(served)
    served.control.advance(WATCHDOG)
    seconds_until(lambda: not is_on(served))
    with pytest.raises(SystemExit) as refused:
        main(["resume", str(folder)])
    assert refused.value.code == 2
    assert "name its endpoints by --attach" in " ".join(capsys.readouterr().err.split())
    again = ["resume", str(folder), "--attach", str(served.endpoints_file), "--accept-disagreement"]
    with pytest.raises(SystemExit) as ended:
        main(again)
    printed = capsys.readouterr()
    said = " ".join(printed.out.split())
    assert not ended.value.code, printed.err
    assert "tec: cleared: error 183 (communication watchdog" in said
    assert not is_on(served)
    with Record(folder) as record:
        assert record.status == "completed"
        assert [step.step for step in record.step_records()] == list(range(total))
        # The time of the laboratory went on while nobody was there.
        assert record.meta["resumes"][0]["t"] > record.steps()["finished"][before - 1]


def test_goes_on_with_a_run_that_its_guardian_calls_failed(served, tmp_path, capsys):
    settings = ("increment=31.5", "half_cycles=1", "dwell=2")
    command = ["run", "damped-oscillation", "--rig", "vo2", "--attach", str(served.endpoints_file)]
    command += ["--no-rehearse", "--out", str(tmp_path), *(f"--set={setting}" for setting in settings)]
    folder = kill_after(2, tmp_path, *command)
    seconds_until(lambda: status_of(folder) == "failed")
    # Its guardian has the lines a moment longer.
    seconds_until(lambda: '"what": "end"' in (folder / BLACK_BOX_NAME).read_text())
    with pytest.raises(SystemExit) as ended:
        main(["resume", str(folder), "--attach", str(served.endpoints_file), "--accept-disagreement"])
    assert not ended.value.code, capsys.readouterr().err
    assert status_of(folder) == "completed"


def status_of(folder):
    with Record(folder) as record:
        return record.status


def test_clears_no_other_error(served):
    served.control.fault("tec-over-current")
    with (
        opened(load_rig("vo2"), served.endpoints_file, "a test") as place,
        pytest.raises(DeviceError, match=r"tec: error 1\d\d \((?!communication watchdog)"),
    ):
        clear_expired_watchdogs(place)
