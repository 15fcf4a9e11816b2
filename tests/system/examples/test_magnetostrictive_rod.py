"""The example of a rig of one's own: its package installed beside the bench, and used by the command line."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[3] / "examples" / "magnetostrictive_rod"
RIG = ("--rig", "magnetostrictive-rod")
BENCH = ("-m", "bench")
TRY_EACH = """
import json, sys
from bench.cli import main
for command in map(json.loads, sys.argv[1:]):
    try:
        main(command)
    except SystemExit as stopped:
        print("exit code", stopped.code or 0)
"""
"""Several commands, each as a JSON array, in one process: most of the time of one is that of starting it."""


@pytest.fixture(scope="module")
def python(tmp_path_factory, warm_process):
    """Install the package in a folder of its own; return a function that runs Python with it."""
    home = tmp_path_factory.mktemp("installed")
    # A copy, as building leaves files beside the source.
    source = shutil.copytree(EXAMPLE, home / "source", ignore=shutil.ignore_patterns("build", "*.egg-info", "__pyc*"))
    environment = {**os.environ, "PYTHONPATH": str(home / "site"), "COLUMNS": "120"}

    def run(*arguments, cwd=home, both=False):
        done = warm_process([sys.executable, *map(str, arguments)], cwd, environment)
        assert done.returncode == 0, done.stdout + done.stderr
        return (done.stdout, done.stderr) if both else done.stdout

    options = ("--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check")
    run("-m", "pip", "install", *options, "--target", home / "site", source)
    return run


@pytest.fixture(scope="module")
def study(python, tmp_path_factory):
    """Carry a short study out, in processes that find its package too; return what was printed and found."""
    out = tmp_path_factory.mktemp("study")
    short = ("--set", "tracking.count=8", "--set", "damped-oscillation.half_cycles=16", "--workers", "2")
    shown = python(*BENCH, "study", "magnetostrictive-rod", *short, "--out", out, "--json", out / "study.json")
    return shown, json.loads((out / "study.json").read_text())


def test_the_list_names_its_parts_and_its_package(python, tmp_path):
    commands = [["list", "--json", str(tmp_path / "list.json")], ["show", "magnetostrictive-rod-hardware"]]
    shown, extended, _ = python("-c", TRY_EACH, *map(json.dumps, commands)).split("exit code 0\n")
    listed = json.loads((tmp_path / "list.json").read_text())
    assert "magnetostrictive-rod" in listed["rigs"]
    assert "butterfly-loop" in listed["protocols"]
    assert "quadratic-play" in listed["models"]
    for part in ("magnetostrictive-rod", "magnetostrictive-rod-hardware", "butterfly-loop", "quadratic-play"):
        following = shown.split(f"  {part}  ", 1)[1]
        assert "[magnetostrictive-rod]" in following[:300], part
    assert 'extends = "magnetostrictive-rod"' in extended


def test_its_study_is_reproduced(study):
    shown, found = study
    assert "models of the rod, RMS errors in µm/m (seed 0)" in shown
    for model in ("quadratic-play", "preisach-signed"):
        assert found["identification"][model]["rms"] < 4.0
        tracking = found["tracking"][model]
        assert tracking["closed-loop-inverse"]["rms"] < tracking["open-loop-inverse"]["rms"] < 25.0


def test_its_model_is_identified_by_the_command_and_reported(python, study, tmp_path):
    folder = Path(study[1]["folder"])
    (run,) = folder.glob("*-damped-oscillation-*")
    own, other = tmp_path / "model.json", folder / "preisach-signed.json"
    options = ("--input", "coil_current", "--output", "strain", "--model", "quadratic-play")
    identify = ["identify", run, *options, "--out", own, "--json", tmp_path / "fit.json"]
    report = ["report", run, "--model", own, "--model", other, "--out", tmp_path, "--json", tmp_path / "r.json"]
    commands = [json.dumps([str(word) for word in command]) for command in (identify, report)]
    assert python("-c", TRY_EACH, *commands).count("exit code 0") == 2
    assert json.loads((tmp_path / "fit.json").read_text())["rms_percent"] < 1.0
    saved = json.loads(own.read_text())
    assert saved["kind"] == "quadratic-play"
    assert (saved["model"]["input_unit"], saved["model"]["output_unit"]) == ("A", "µm/m")
    found = json.loads((tmp_path / "r.json").read_text())
    assert {"quadratic-play", "preisach-signed"} <= set(found["models"])
    assert all(model["rms"] > 0.0 for model in found["models"].values())
    assert all(Path(path).stat().st_size > 0 for path in found["figures"])


def test_its_protocol_finds_the_coercivity(python, tmp_path):
    shown = python(*BENCH, "run", "butterfly-loop", *RIG, "--clock", "virtual", "--out", tmp_path)
    # The pinning of the plant over the field of its coil is 0.33 A.
    coercivity = float(shown.split("coercivity", 1)[1].split()[0])
    assert 0.2 <= coercivity <= 0.45


@pytest.mark.parametrize(("device", "least"), [("coil", 13), ("bridge", 6)])
def test_its_devices_keep_their_contracts(python, device, least):
    shown = python(
        "-m", "pytest", "-q", "-p", "no:cacheprovider", "--pyargs", "bench.contracts", "--device", device, *RIG
    )
    assert int(shown.split(" passed")[0].split()[-1]) >= least
    assert "skipped" not in shown
    assert "failed" not in shown


RESTART = """
import bench
from bench.base import DeviceRestartedError
with bench.open_rig("magnetostrictive-rod") as rig:
    coil, source = rig.devices["coil"], rig.laboratory.coil
    coil.set(1.5).wait()
    coil.reconnect()
    assert abs(coil.measure()["coil_current"] - 1.5) < 0.01
    source.power_cycle()
    for call in (coil.glance, lambda: coil.set(1.0), coil.reconnect):
        try:
            call()
        except DeviceRestartedError as error:
            print(error)
        assert not source.on
    coil.safe()
"""


def test_a_restart_of_its_source_is_found_and_nothing_is_set_after_it(python):
    said = "coil: its output is off and its set-point is lost: it has restarted; connect again\n"
    assert python("-c", RESTART) == 3 * said


WRONG = {
    '[roles.response]\nsignal = "stain"': ("roles.response.signal = 'stain': there is no such signal", "strain"),
    '[roles.drive]\nunit = "mA"': ("roles.drive.unit = 'mA': coil_current is in A",),
    '[roles.drive]\ndevice = "bridge"': ("roles.drive.device = 'bridge' takes no set-point; there are: coil",),
    '[derived.strain]\nexpression = "2 * bridge_voltage_c / (5 * gauge_factor)"': (
        "derived.strain.expression: 'bridge_voltage_c': there is no such signal", "bridge_voltage_b",
    ),
    '[derived.strain]\nunit = "mm"': ("derived.strain.expression = ", "not in unit = 'mm'"),
}  # fmt: skip
"""Wrong keys of a rig file, and what the message has to say."""


def test_a_wrong_rig_file_is_one_message_before_anything_moves(python, tmp_path):
    rigs = [tmp_path / f"wrong-{i}.toml" for i in range(len(WRONG))]
    for rig, change in zip(rigs, WRONG, strict=True):
        rig.write_text(f'extends = "magnetostrictive-rod"\n{change}\n')
    commands = [json.dumps(["run", "butterfly-loop", "--rig", str(rig), "--out", "runs"]) for rig in rigs]
    codes, errors = python("-c", TRY_EACH, *commands, cwd=tmp_path, both=True)
    assert codes.splitlines() == ["exit code 2"] * len(WRONG)
    for rig, said, message in zip(rigs, WRONG.values(), errors.splitlines(), strict=True):
        assert message.startswith(f"error: {rig}: ")
        for part in said:
            assert part in message
    assert not (tmp_path / "runs").exists()
