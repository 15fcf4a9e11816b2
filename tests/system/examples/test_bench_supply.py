"""The example of instruments that a rig file describes: it runs, repeats itself, and keeps the contracts."""

import sys
from pathlib import Path

import pytest

import bench as face

RIG = Path(__file__).parents[3] / "examples" / "bench-supply.toml"


def test_a_general_protocol_runs_on_it_and_repeats_itself(tmp_path):
    runs = [
        face.run("creep", str(RIG), clock="virtual", seed=seed, out=tmp_path / str(i), hot=8.0, cool=4.0)
        for i, seed in enumerate((3, 3, 4))
    ]
    assert [run.status for run in runs] == ["completed"] * 3
    temperatures = [list(run.readings["meter_temperature"]) for run in runs]
    assert temperatures[0] == temperatures[1] != temperatures[2]
    # 22 °C and 4 K/W, at 8 V on 10 ohms, after four time constants.
    assert max(temperatures[0]) == pytest.approx(22.0 + 4.0 * 6.4, abs=0.8)


def test_its_physics_and_its_instruments_agree():
    with face.open_rig(str(RIG)) as rig:
        supply = rig.devices["supply"]
        supply.set(10.0).wait()
        rig.clock.sleep(150.0)
        values = rig.measure()
        assert values["supply_voltage"] == pytest.approx(10.0, abs=5e-3)
        assert values["supply_current"] == pytest.approx(1.0, abs=2e-3)
        assert values["meter_temperature"] == pytest.approx(62.0, abs=0.2)
        supply.safe()
        rig.clock.sleep(1.0)
        assert rig.measure()["supply_current"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("device", "least"), [("supply", 15), ("meter", 6)])
def test_its_devices_keep_their_contracts(device, least, warm_process, tmp_path):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--pyargs", "bench.contracts"]
    done = warm_process([*command, "--device", device, "--rig", str(RIG)], tmp_path, None)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stdout.split(" passed")[0].split()[-1]) >= least
    assert "skipped" not in done.stdout
