"""`bench safe`, `bench rig clear` and `bench rig check` on served rigs; what is safe is read from the instruments."""

import io
import json
import re
import signal
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from html import unescape
from pathlib import Path

import pytest
from cases import cases

from bench.base import Stopwatch
from sim_devices.serving.process import serve

pytestmark = pytest.mark.usefixtures("warm_popen")

CLIENT = """
import sys
from pathlib import Path
from bench.rig import load_rig, opened
rig, file, *settings = sys.argv[1:]
overrides = {"devices.tec.watchdog": "300"} if rig in ("vo2", "hybrid") else {}
with opened(load_rig(rig, overrides), Path(file), "a run") as place:
    values = dict(setting.split("=") for setting in settings)
    devices = []
    for entry in place.entries:
        if entry.name in values:
            devices.append(entry.driver.connect(entry.name, entry.settings, place.clock))
            devices[-1].set(float(values[entry.name]))
    print("on", flush=True)
    sys.stdin.read()
"""


@contextmanager
def client(rig, *settings, file=None):
    """Switch devices on from another process, which holds them until it is killed."""
    command = [sys.executable, "-P", "-c", CLIENT, rig.name, str(file or rig.endpoints_file), *settings]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline() == "on\n", process.stderr.read()
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def served():
    """Serve a rig for all tests of the module, each once."""
    with ExitStack() as stack:
        rigs = {}

        def get(name):
            if name not in rigs:
                rigs[name] = stack.enter_context(serve(name, clock="x1"))
            return rigs[name]

        yield get


def attached(rig):
    return rig.name, "--attach", rig.endpoints_file


def renamed(rig, tmp_path):
    """Write an endpoints file with other names of the same lines: a link, and a host name."""
    content = json.loads(rig.endpoints_file.read_text())
    for name, endpoint in content["instruments"].items():
        if endpoint["port"].startswith("/"):
            (tmp_path / name).symlink_to(endpoint["port"])
            endpoint["port"] = str(tmp_path / name)
        else:
            endpoint["port"] = endpoint["port"].replace("127.0.0.1", "localhost")
    file = tmp_path / "renamed.json"
    file.write_text(json.dumps(content))
    return file


@contextmanager
def rescuing(rig, file=None):
    """Start `bench safe` in a process of its own."""
    command = [sys.executable, "-P", "-m", "bench", "safe", rig.name, "--attach", str(file or rig.endpoints_file)]
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


class TestSafe:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("name", "settings", "outputs"),
        [
            ("vo2", ["tec=30"], ["tec_output"]),
            ("hybrid", ["tec=0.1", "piezo=20"], ["tec_output", "amplifier_enable", "amplifier_command"]),
            ("sma", ["stage=0.005", "fan=1"], ["stage_torque", "fan", "supply_voltage"]),
        ],
    )
    def test_what_a_killed_process_left_on_is_switched_off(self, bench, served, name, settings, outputs):
        rig = served(name)
        with client(rig, *settings):
            before = rig.control.state()
        assert sum(bool(before[output]) for output in outputs) >= len(settings)
        code, out, _ = bench("safe", *attached(rig))
        assert code == 0
        assert "NOT" not in out
        after = rig.control.state()
        assert {output: after[output] for output in outputs} == dict.fromkeys(outputs, 0.0)

    @pytest.mark.slow
    def test_beside_an_instrument_in_error(self, bench, served):
        rig = served("hybrid")
        with client(rig, "tec=0.1", "piezo=20"):
            rig.control.fault("tec-over-current")
        assert rig.control.state()["amplifier_enable"] == 1.0
        assert bench("safe", *attached(rig))[0] == 0
        state = rig.control.state()
        assert (state["amplifier_enable"], state["tec_output"]) == (0.0, 0.0)
        # It stays in its error until that is cleared.
        assert bench("rig", "clear", *attached(rig), "--yes")[0] == 0

    @pytest.mark.slow
    def test_a_line_that_is_dead_delays_no_other_and_is_named(self, bench, served, tmp_path):
        rig = served("hybrid")
        file = tmp_path / "safe.json"
        with client(rig, "tec=0.1", "piezo=20"):
            rig.control.fault("t7.unplug")
        try:
            code, out, err = bench("safe", *attached(rig), "--json", file, "--limit", "3")
        finally:
            rig.control.plug_in("t7")
        assert code == 7
        assert "unplug what piezo drives" in " ".join(out.split())
        result = json.loads(file.read_text())
        assert {name: each["is_safe"] for name, each in result.items()} == {
            "tec": True, "displacement": True, "base": True, "tip": True, "piezo": False,
        }  # fmt: skip
        assert rig.control.state()["tec_output"] == 0.0
        assert err.count("s: piezo; trying again") > 1
        assert bench("safe", *attached(rig))[0] == 0
        assert rig.control.state()["amplifier_enable"] == 0.0

    def test_an_emulated_rig_in_process(self, bench):
        assert bench("safe", "hybrid")[0] == 0

    @pytest.mark.slow
    def test_it_goes_on_until_every_device_is_confirmed(self, served):
        rig = served("hybrid")
        with client(rig, "tec=0.1", "piezo=20"):
            rig.control.fault("t7.unplug")
        with rescuing(rig) as process:
            lines = iter(process.stderr.readline, "")
            assert sum("s: piezo; trying again" in next(lines) for _ in range(4)) >= 3
            assert process.poll() is None
            assert rig.control.state()["tec_output"] == 0.0
            rig.control.plug_in("t7")
            out, _ = process.communicate()
        assert process.returncode == 0
        assert "NOT" not in out
        assert rig.control.state()["amplifier_enable"] == 0.0

    @pytest.mark.slow
    def test_whoever_ends_it_is_told_what_may_be_on(self, served, tmp_path):
        rig = served("vo2")
        # A port that is not there is named at once, and tried again.
        content = json.loads(rig.endpoints_file.read_text())
        content["instruments"]["tec"]["port"] = str(tmp_path / "no-port")
        file = tmp_path / "endpoints.json"
        file.write_text(json.dumps(content))
        with rescuing(rig, file) as process:
            first, second = process.stderr.readline(), process.stderr.readline()
            assert "tec: NOT CONFIRMED: cannot open" in first
            assert "s: tec; trying again" in second
            process.send_signal(signal.SIGTERM)
            out, _ = process.communicate()
        assert process.returncode == 7
        assert "NOT CONFIRMED" in out


class TestOneBench:
    """Nothing reaches an instrument that another process holds, under whatever name."""

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("command", "names"), [("safe", "same"), ("rig clear", "same"), ("rig check", "same"), ("safe", "other")]
    )
    def test_the_second_is_refused_before_it_sends_a_byte(self, bench, served, tmp_path, command, names):
        rig = served("vo2")
        file = rig.endpoints_file if names == "same" else renamed(rig, tmp_path)
        with client(rig, "tec=30") as process:
            code, _, err = bench(*command.split(), "vo2", "--attach", file)
            assert code == 2
            assert len(err.splitlines()) == 1
            assert "rig vo2 is in use: line " in err
            assert f"process {process.pid}, a run (rig vo2), since" in err
            # Each of them would have switched it off.
            assert rig.control.state()["tec_output"] == 1.0
        assert bench("safe", "vo2", "--attach", file)[0] == 0

    @pytest.mark.slow
    def test_force_names_the_holder_and_goes_on(self, bench, served):
        rig = served("hybrid")
        with client(rig, "piezo=20") as process:
            _, _, err = bench("safe", *attached(rig), "--force", "--limit", "3")
            assert "warning: rig hybrid is in use" in err
            assert f"process {process.pid}" in err
            assert rig.control.state()["amplifier_enable"] == 0.0


class TestRecover:
    def trip(self, rig):
        """Let the watchdog of the TEC controller run out under a host that stopped."""
        with client(rig, "tec=30") as process:
            process.send_signal(signal.SIGSTOP)
            rig.control.advance(301.0)
        assert rig.control.state()["tec_output"] == 0.0

    @pytest.mark.slow
    def test_a_watchdog_that_tripped(self, bench, served, tmp_path):
        rig = served("vo2")
        self.trip(rig)
        code, _, err = bench("rig", "check", *attached(rig))
        assert code == 4
        code, out, err = bench("rig", "clear", *attached(rig))
        assert code == 2
        assert "--yes" in err
        assert "error 183" in out
        assert "in error" in out
        file = tmp_path / "recovered.json"
        code, out, err = bench("rig", "clear", *attached(rig), "tec", "--yes", "--json", file)
        assert (code, err) == (0, "")
        assert json.loads(file.read_text())["tec"]["state"] == "ready"
        assert rig.control.state()["tec_output"] == 0.0
        with client(rig, "tec=30"):
            assert rig.control.state()["tec_output"] == 1.0
        assert bench("safe", *attached(rig))[0] == 0

    def test_its_question_is_no_part_of_the_json(self, bench, served, monkeypatch):
        class Terminal(io.StringIO):
            def isatty(self):
                return True

        rig = served("vo2")
        rig.control.fault("tec-over-temperature")
        monkeypatch.setattr("sys.stdin", Terminal("n\n"))
        code, out, err = bench("rig", "clear", *attached(rig), "--json", "-")
        assert (code, out.strip()) == (130, "")
        assert "Clear the errors of tec" in err
        assert bench("rig", "clear", *attached(rig), "--yes")[0] == 0

    @pytest.mark.slow
    def test_a_servo_that_let_go(self, bench, served):
        rig = served("sma")
        rig.control.fault("servo-overload")
        code, out, _ = bench("rig", "clear", *attached(rig), "--yes")
        assert code == 0
        assert "overload" in out
        assert bench("rig", "clear", *attached(rig))[0] == 0

    def test_what_cannot_be_reached_is_no_error_to_clear(self, bench, served):
        rig = served("vo2")
        rig.control.fault("tec.unplug")
        try:
            code, out, err = bench("rig", "clear", *attached(rig), "--yes")
        finally:
            rig.control.plug_in("tec")
        assert code == 4
        assert "not reached" in out
        assert "error: tec: is not reached" in err

    def test_of_a_device_that_is_none(self, bench):
        code, _, err = bench("rig", "clear", "vo2", "plate")
        assert code == 2
        assert "has no device 'plate'; it has: tec, psd" in err


WATCHED = """
from drivers.meerstetter import MeerstetterTEC

class Watched(MeerstetterTEC):
    heats = True
    watchdog = 2.0
"""


class TestDoctor:
    def findings(self, bench, tmp_path, rig, *options):
        """Give the exit code, and the findings with an advice by device and subject."""
        file = tmp_path / "check.json"
        code, _, err = bench("rig", "check", rig, *options, "--json", file)
        assert err == ""
        result = json.loads(file.read_text())
        assert result["exit_code"] == code
        return code, {
            (check["device"], finding["subject"]): finding
            for check in result["devices"]
            for finding in check["findings"]
            if finding["advice"]
        }

    @cases("rig", ["vo2", "hybrid"])
    def test_identifies_each_instrument(self, bench, tmp_path, rig):
        file = tmp_path / "check.json"
        bench("rig", "check", rig, "--json", file)
        for check in json.loads(file.read_text())["devices"][:-1]:
            assert "serial number" in check["identity"]
            assert "firmware" in check["identity"]

    def test_a_healthy_rig(self, bench, tmp_path):
        assert self.findings(bench, tmp_path, "vo2", "--exercise") == (0, {})

    @cases(
        ("override", "place", "words"),
        [
            ("roles.drive.range=[0.0,120.0]", ("tec", "limits"), "0 and 120 beyond 15 to 95 °C"),
            (
                "roles.drive.reset.noise=1e-6",
                ("tec", "tec_temperature"),
                "quick readings (stated: 1e-06 K, roles.drive.reset.noise)",
            ),
            ("devices.tec.temperature_limits=[-10,95]", ("tec", "error thresholds"), "0 to 105 °C of the object"),
            ("telemetry.period=0.01", ("", "time"), "every 0.01 s"),
            (
                "uncertainty.psd_position.noise.standard=1e-10",
                ("psd", "psd_position"),
                "measurements (stated: 0.1 nm, uncertainty.psd_position)",
            ),
            ("devices.psd.calibration_due=2020-02-29", ("psd", "calibration"), "due on 2020-02-29, "),
        ],
    )
    def test_what_should_be_mended(self, bench, tmp_path, override, place, words):
        code, findings = self.findings(bench, tmp_path, "vo2", "--override", override)
        assert code == 1
        assert words in findings[place]["text"]

    def test_a_watchdog_that_does_not_fit(self, bench, tmp_path, monkeypatch):
        monkeypatch.setattr(sys, "path", [*sys.path])
        (tmp_path / "watched.py").write_text(WATCHED)
        rig = tmp_path / "watched.toml"
        rig.write_text('extends = "vo2"\n[devices.tec]\ndriver = "watched:Watched"\n')
        code, findings = self.findings(bench, tmp_path, rig)
        assert code == 1
        assert "2 s between two readings" in findings["tec", "watchdog"]["text"]

    def test_every_reading_has_a_unit_and_every_actuator_says_whether_it_was_moved(self, bench, tmp_path):
        file = tmp_path / "check.json"
        bench("rig", "check", "sma", "--exercise", "--json", file)
        texts = {
            (check["device"], finding["subject"]): finding["text"]
            for check in json.loads(file.read_text())["devices"]
            for finding in check["findings"]
        }
        reading = r"[-\d.]+ µm, noise [\d.]+ µm of 20 quick readings, [\d.]+ µm of 5 measurements \(stated: [\d.]+ µm"
        assert re.match(reading, texts["wire_end", "wire_end_position"])
        assert "supply_voltage went from 0.000 V to 0.100 V" in texts["supply", "exercise"]
        assert "100% of the way; noise " in texts["supply", "exercise"]
        assert "2 interlocks looked at" in texts["supply", "exercise"]
        assert "not moved" in texts["stage", "exercise"]

    def test_a_page_has_all_that_was_found(self, bench, tmp_path):
        html = tmp_path / "check.html"
        self.findings(bench, tmp_path, "vo2", "--exercise", "--html", html)
        page = html.read_text()
        for check in json.loads((tmp_path / "check.json").read_text())["devices"]:
            assert all(unescape(page).count(finding["text"]) for finding in check["findings"])

    def test_the_name_of_the_protocol_that_others_know_leads_there(self, bench):
        for words in (["shakedown"], ["run", "shakedown", "--rig", "vo2"]):
            code, _, err = bench(*words)
            assert code == 2
            assert "bench rig check RIG --exercise" in err

    def test_an_actuator_that_does_not_follow(self, bench, tmp_path):
        options = ["--exercise", "--override", "roles.drive.reading=tec_sink_temperature"]
        code, findings = self.findings(bench, tmp_path, "vo2", *options)
        assert code == 1
        assert "does not follow" in findings["tec", "exercise"]["text"]

    @cases(("factor", "code"), [(4, 0), (0, 1)])
    def test_of_a_reading_in_another_unit_only_that_it_moves_is_known(self, bench, tmp_path, factor, code):
        rig = Path(__file__).parents[2] / "examples/bench-supply.toml"
        overrides = (
            "roles.drive.reading=meter_temperature",
            'roles.drive.unit="°C"',
            f"emulation.signals.meter_temperature.constants.thermal_resistance={factor}00 K/W",
        )
        _, findings = self.findings(
            bench, tmp_path, rig, "--exercise", *(word for each in overrides for word in ("--override", each))
        )
        assert [*findings] == [("supply", "watchdog"), *([("supply", "exercise")] if code else [])]

    @cases(
        ("override", "subject", "words"),
        [
            ("emulation.signals.supply_voltage.expression=0.5 * supply_output", "scale", "50% of the way"),
            ("emulation.signals.supply_voltage.expression=-1.0 * supply_output", "exercise", "does not follow"),
            ("roles.drive.dwell=0.01", "settling", "the dwell of its role is 0.01 s"),
            (
                "interlocks=[{signal='supply_voltage', high=0.5}]",
                "interlock",
                "supply_voltage was 1.000 V meanwhile, allowed is ≤ 0.5 V",
            ),
        ],
    )
    def test_an_actuator_that_arrives_elsewhere(self, bench, tmp_path, override, subject, words):
        rig = Path(__file__).parents[2] / "examples/bench-supply.toml"
        # That it heats without a watchdog is found anyway.
        assert [*self.findings(bench, tmp_path, rig, "--exercise")[1]] == [("supply", "watchdog")]
        code, findings = self.findings(bench, tmp_path, rig, "--exercise", "--override", override)
        assert code == 1
        assert words in findings["supply", subject]["text"]

    @pytest.mark.slow
    def test_a_device_that_is_gone_keeps_no_other_from_being_checked(self, bench, served, tmp_path):
        rig = served("vo2")
        rig.control.fault("tec.unplug")
        try:
            code, findings = self.findings(bench, tmp_path, *attached(rig))
        finally:
            rig.control.plug_in("tec")
        assert code == 4
        assert list(findings) == [("tec", "connection")]

    @pytest.mark.slow
    def test_moves_nothing_but_when_it_is_asked_to(self, bench, tmp_path):
        log = tmp_path / "state.jsonl"
        command = [sys.executable, "-P", "-m", "bench", "rig", "emulate", "vo2", "--clock", "x1",
                   "--json", str(tmp_path / "ports.json"), "--state", str(log)]  # fmt: skip
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as server:
            try:
                watch = Stopwatch()
                while not (tmp_path / "ports.json").exists():
                    assert watch.seconds() < 240.0
                    with pytest.raises(subprocess.TimeoutExpired):
                        server.wait(0.05)
                attach = ("vo2", "--attach", tmp_path / "ports.json")
                assert self.findings(bench, tmp_path, *attach)[0] in (0, 1)
                assert outputs(log) == {0.0}
                assert self.findings(bench, tmp_path, *attach, "--exercise")[0] in (0, 1)
            finally:
                server.terminate()
                server.wait(60)
        assert outputs(log) == {0.0, 1.0}
        assert json.loads(log.read_text().splitlines()[-1])["values"]["tec_output"]["value"] == 0.0


def outputs(log):
    return {json.loads(line)["values"]["tec_output"]["value"] for line in log.read_text().splitlines()}
