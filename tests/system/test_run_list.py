"""Lists of runs, and two of them side by side."""

import io
import json
import shutil
import sqlite3
from contextlib import closing

import pytest
from cases import cases
from heater_laboratory import RIG
from heater_protocols import stairs
from rich.console import Console

from bench.analysis import compare_runs
from bench.execution import Run, carry_out
from bench.protocol import Messages, Note, NumberList, ProtocolParameters, parameter, protocol
from bench.record import FILE_NAME, Difference, Record, run_name
from bench.rig import Holder, Locks


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs that differ by a parameter and one like the first; one that goes on, and one that is damaged."""
    folder = tmp_path_factory.mktemp("runs")
    rig = folder / "heater.toml"
    rig.write_text(RIG, encoding="utf-8")

    def run(seed=0, **settings):
        asked = Run(stairs, settings, str(rig), folder / "runs", seed=seed, clock="virtual", recording=False)
        return carry_out(asked, Console(file=io.StringIO())).folder

    found = {
        "plain": run(),
        "hotter": run(increment=7.5, count=3),
        "again": run(),
        "unfinished": run(seed=5),
        "damaged": run(),
    }
    with closing(sqlite3.connect(found["unfinished"] / FILE_NAME)) as db, db:
        db.execute("DELETE FROM meta WHERE key IN ('status', 'finished', 'reason')")
    (found["damaged"] / FILE_NAME).write_bytes(b"no journal at all" * 99)
    return found


def listed(bench, tmp_path, *options):
    code, out, err = bench("runs", *options, "--json", tmp_path / "runs.json")
    assert (code, err) == (0, "")
    return out, json.loads((tmp_path / "runs.json").read_text(encoding="utf-8"))


def test_every_run_below_a_folder_is_listed(bench, runs, tmp_path):
    out, found = listed(bench, tmp_path, runs["plain"].parents[1])
    by_name = {name: next(run for run in found if run["folder"] == str(path)) for name, path in runs.items()}
    assert len(found) == len(runs)
    assert [run["started"] for run in found] == sorted(run["started"] for run in found)
    plain, hotter = by_name["plain"], by_name["hotter"]
    assert (plain["status"], plain["protocol"], plain["rig"]) == ("completed", "stairs", "heater")
    assert (plain["steps"], plain["seconds"], plain["changed"]) == (4, 8.0, {})
    assert hotter["changed"] == {"count": 3, "increment": 7.5}
    assert by_name["unfinished"]["status"] == "unfinished"
    assert by_name["damaged"]["status"] == "damaged"
    assert "is not a readable journal" in by_name["damaged"]["result"]
    assert "count=3, increment=7.5" in out
    assert "5 runs" in out


def test_damaged_rows_and_lost_journals_are_marked(bench, runs, tmp_path):
    damaged, lost = tmp_path / "all" / "damaged", tmp_path / "all" / "lost"
    for folder in (damaged, lost):
        shutil.copytree(runs["plain"], folder)
    with closing(sqlite3.connect(damaged / FILE_NAME)) as db, db:
        db.execute("UPDATE telemetry SET t = t + 1 WHERE tick = 3")
    (lost / FILE_NAME).rename(lost / "journal.second")
    _, found = listed(bench, tmp_path, tmp_path / "all")
    by_name = {run["folder"]: run for run in found}
    assert [run["status"] for run in found] == ["damaged", "damaged"]
    assert by_name[str(damaged)]["protocol"] == "stairs"
    assert "table telemetry, row 3" in by_name[str(damaged)]["result"]
    assert f"`bench runs repair {lost}`" in by_name[str(lost)]["result"]


def test_a_run_that_goes_on_is_told_from_one_that_died(bench, runs, tmp_path):
    folder = runs["unfinished"]
    with Locks(Holder.of_this_process("heater", str(folder))) as locks:
        locks.take_folder(folder)
        _, found = listed(bench, tmp_path, folder.parent, "--status", "running")
        assert [run["folder"] for run in found] == [str(folder)]
    _, found = listed(bench, tmp_path, folder.parent, "--status", "running")
    assert found == []


@cases(
    ("options", "expected"),
    [
        (["--where", "increment=7.50"], {"hotter"}),
        (["--where", "count=4", "--where", "seed=5"], {"unfinished"}),
        (["--where", "count=4", "--status", "completed"], {"plain", "again"}),
        (["--status", "damaged"], {"damaged"}),
        (["--protocol", "stairs", "--rig", "heater", "--where", "increment=7.5"], {"hotter"}),
        (["--rig", "heater", "--status", "failed"], set()),
    ],
)
def test_runs_are_found_by_what_was_set(bench, runs, tmp_path, options, expected):
    _, found = listed(bench, tmp_path, runs["plain"].parent, *options)
    assert {run["folder"] for run in found} == {str(runs[name]) for name in expected}


def test_what_cannot_be_found_is_named(bench, runs, tmp_path):
    code, _, err = bench("runs", runs["plain"].parent, "--where", "incremnt=7.5")
    assert code == 2
    assert "--where incremnt: no run has such a parameter; they have: clock, count, dwell, increment" in err
    code, _, err = bench("runs", tmp_path / "nowhere")
    assert code == 2
    assert "nowhere is not a folder" in err


def test_where_nothing_has_run_there_are_no_runs(bench, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, text, _ = bench("runs")
    assert code == 0
    assert "no runs" in text


def test_the_folder_tells_the_parameters_that_differ(runs):
    assert runs["hotter"].name.startswith("heater-stairs-count-3-increment-7.5-2")
    assert runs["plain"].name.startswith("heater-stairs-2")


def test_two_runs_are_compared(bench, runs, tmp_path):
    result = tmp_path / "result.json"
    code, out, _ = bench("runs", "compare", runs["plain"], runs["hotter"], "--json", result)
    assert code == 0
    found = json.loads(result.read_text(encoding="utf-8"))
    different = {each["key"]: (each["first"], each["second"]) for each in found["differences"]}
    assert different == {"parameters.count": (4, 3), "parameters.increment": (5.0, 7.5)}
    assert found["common_steps"] == 3
    setpoint = found["signals"]["tec_setpoint"]
    assert (setpoint["maximum"], setpoint["step"], setpoint["unit"]) == (5.0, 2, "°C")
    assert setpoint["rms"] == pytest.approx(((0 + 2.5**2 + 5**2) / 3) ** 0.5)
    assert found["equal"] == {"steps": False, "telemetry": False, "events": False}
    assert [each["steps"] for each in found["outcomes"]] == [4, 3]
    assert "parameters.increment" in out
    with Record(runs["plain"]) as first, Record(runs["again"]) as second:
        same = compare_runs(first, second)
    assert same.differences == ()
    assert all(same.equal.values())


def test_of_a_list_only_what_differs_is_named(bench, tmp_path, rig_file):
    warning = '\n[[interlocks]]\nsignal = "probe_temperature"\nhigh = 80.0\nlevel = "warn"\n'
    current = '\n[[interlocks]]\nsignal = "tec_current"\nhigh = 5.0\n'
    difference = '\n[[interlocks]]\nsignal = "probe_temperature"\nminus = "tec_temperature"\nhigh = {}\n'
    folders = []
    for append in (current + warning + difference.format(9.0), warning.replace("80", "85") + difference.format(0.0)):
        asked = Run(stairs, {}, rig_file(append=append), tmp_path / "runs", clock="virtual", recording=False)
        folders.append(carry_out(asked, Console(file=io.StringIO())).folder)
    result = tmp_path / "result.json"
    code, out, _ = bench("runs", "compare", *folders, "--json", result)
    assert code == 0
    found = json.loads(result.read_text(encoding="utf-8"))["differences"]
    different = {each["key"]: (each["first"], each["second"]) for each in found if each["key"] != "files.rig.toml"}
    interlocks = "rig_content.interlocks"
    assert different == {
        f"{interlocks}.tec_current.signal": ("tec_current", None),
        f"{interlocks}.tec_current.high": (5.0, None),
        f"{interlocks}.probe_temperature #2.high": (80.0, 85.0),
        f"{interlocks}.probe_temperature - tec_temperature.high": (9.0, 0.0),
    }
    assert "[{" not in out
    key = f"{interlocks}.probe_temperature - tec_temperature.high"
    assert str(Difference(key, *different[key])) == f"{key}: 9.0 → 0.0"


@cases(
    ("arguments", "expected"),
    [
        (["a.json", "b.json"], "a.json is not a run"),
        (["a", "b", "--skip", "3"], "--skip"),
    ],
)
def test_a_comparison_of_what_are_not_two_runs_is_refused(bench, arguments, expected):
    code, _, err = bench("runs", "compare", *arguments)
    assert code in (2, 3)
    assert expected in err


def test_the_name_of_a_folder_is_short_and_fits_every_file_system():
    class Parameters(ProtocolParameters):
        model: str = parameter("", unit="", help="file", file=True)
        levels: NumberList = parameter("1", unit="1", help="some")
        text: str = parameter("", unit="", help="any")
        more: float = parameter(0.0, unit="1", help="any")

    @protocol(needs=("tec",))
    def try_out(parameters: Parameters) -> Messages:
        """Try."""
        yield Note("x")

    def name(overrides, rig="heater", **settings):
        changed = try_out.changed(try_out.parse(settings), {}, {})
        return run_name(try_out, {"rig": rig, "changed": changed, "overrides": overrides})

    assert name({}) == name({}, more="0") == "heater-try-out"
    assert name({}, model="C:\\models\\m 1.json", more="-2.50") == "heater-try-out-more--2.5-model-m-1"
    assert name({"emulation.offset": "0.3"}, levels="1,2.5") == "heater-try-out-levels-1+2.5-offset-0.3"
    assert name({}, text='a/b:c*"<|>?\n. ') == "heater-try-out-text-a-b-c"
    assert name({}, "twin ö-climb") == "twin-o-climb-try-out"
    assert name({}, ".§ℵ?") == "x-try-out"
    assert len(name({}, "r" * 200)) <= 96
    long = name({f"table.key{i}": "0123456789" for i in range(20)}, text="x" * 500)
    assert len(long) <= 96
    assert long.endswith("-more")


class TestWhatIsAskedFor:
    @cases(
        ("option", "value", "said"),
        [
            ("--status", "nonsense", "'completed', 'aborted', 'failed', 'running', 'unfinished', 'damaged'"),
            ("--rig", "nosuch", "--rig nosuch: no run is of it; there are runs of: heater"),
            ("--protocol", "nosuch", "--protocol nosuch: no run is of it; there are runs of: stairs"),
        ],
    )
    def test_a_name_that_no_run_has_is_refused_with_those_that_there_are(self, bench, runs, option, value, said):
        code, out, err = bench("runs", runs["plain"].parent, option, value)
        assert (code, out) == (2, "")
        assert said in " ".join(err.replace("│", " ").split())

    def test_a_status_that_there_is_finds_none(self, bench, runs):
        code, out, _ = bench("runs", runs["plain"].parent, "--status", "aborted")
        assert code == 0
        assert out.endswith("0 runs\n")

    def test_one_run_that_is_named_itself(self, bench, runs):
        _, out, _ = bench("runs", runs["plain"])
        assert out.endswith("\n1 run\n")
        assert f"    {runs['plain'].name}\n" in out
