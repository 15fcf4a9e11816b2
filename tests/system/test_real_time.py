"""A loop at 100 Hz on the wall clock: instruments on ptys in one process, their lines in another, the loop here."""

import sys
from pathlib import Path

import pytest
from following_supplies import rig_of, supplies
from rich.console import Console

from bench.cli import main
from bench.execution import Run, carry_out
from bench.record import Record
from sim_devices.serving.process import serve

pytestmark = pytest.mark.usefixtures("warm_popen")


@pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")
def test_lateness_is_in_record_report_and_dashboard(tmp_path, capsys):
    rig = tmp_path / "supplies.toml"
    rig.write_text(rig_of(1), encoding="utf-8")
    with serve(str(rig), clock="x1") as served:
        assert all(Path(each.port).is_char_device() for each in served.instruments.values()), served.instruments
        run = Run(
            protocol=supplies, settings={}, rig=str(rig), folder=tmp_path / "runs", attach=served.endpoints_file,
            rehearse=False,
        )  # fmt: skip
        result = carry_out(run, Console(quiet=True))
    assert result.outcome.status == "completed", result.outcome.reason
    with Record(result.folder) as record:
        late = record.meta["lateness"]["sine"]
        ticks = record.telemetry()
    assert late["rate"] == 100.0
    assert late["samples"] + late["left_out"] == 200
    assert sum(late["counts"]) == late["samples"] > 0
    assert late["mean"] <= late["worst"]
    assert late["worst"] == pytest.approx(max(ticks["lateness"][ticks["lateness"] == ticks["lateness"]]), abs=1e-9)
    with pytest.raises(SystemExit):
        main(["report", str(result.folder)])
    assert f"lateness of sine: {late['samples']} samples at 100 Hz" in capsys.readouterr().out
