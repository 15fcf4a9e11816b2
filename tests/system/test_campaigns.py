"""Campaigns: the file, its tasks, what is done again, and the tables."""

import csv
import json
import os
import shutil
import signal
import threading

import pyarrow.parquet as pq
import pytest
from cases import cases
from places import SUPPORT
from rich.console import Console

from bench.base import ConfigurationError, Workers, registry
from bench.batch import (
    ClusterExecutor,
    ResultTable,
    Study,
    StudyResult,
    WorkersExecutor,
    carry_out_tasks,
    check_address,
    done_before,
    expand,
    opened_folder,
    read_campaign,
)
from bench.batch.campaign.study_tables import OverSeeds, over_seeds
from bench.batch.campaign.tasks import DONE_NAME, UNFINISHED
from bench.cli import main
from bench.execution import carry_out
from bench.record import Record

pytestmark = pytest.mark.usefixtures("warm_popen")

PROTOCOLS = SUPPORT / "heater_protocols.py"
STAIRS = f'''
[[runs]]
name = "climb"
protocol = "{PROTOCOLS}:stairs"
rigs = "heater.toml"
seeds = [3, 5]
[runs.parameters]
increment = [5.0, 10.0]
'''
CHAIN = """
[[runs]]
name = "characterize"
protocol = "damped-oscillation"
rigs = ["vo2"]
seeds = "0..1"
[runs.parameters]
increment = 8.0
half_cycles = 6
dwell = 2.0

[[models]]
name = "density"
runs = "characterize"
model = "preisach-nonmonotonic"
levels = 6
plane = [30.0, 70.0]

[[runs]]
name = "track"
protocol = "tracking"
rigs = ["vo2"]
seeds = "0..1"
seed_offset = 1000
[runs.parameters]
model = "@density"
count = 2
[runs.overrides]
emulation.session_offset = [0.1, 0.2]
"""


@pytest.fixture
def campaign(tmp_path, rig_file):
    """Write a campaign file beside the heater's rig file."""
    rig_file()

    def write(text, *replacements):
        for old, new in replacements:
            assert old in text, old
            text = text.replace(old, new)
        path = tmp_path / "night.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def start(*arguments):
    """Return the exit code of `bench study`."""
    with pytest.raises(SystemExit) as end:
        main(["study", *map(str, arguments)])
    return end.value.code


def content(folder):
    """Everything that a run measured, and what happened in it."""
    with Record(folder) as record:
        tables = record.steps(), record.telemetry()
        return [
            {name: column.tobytes() for name, column in table.columns.items()} for table in tables
        ], record.events()


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


class TestFile:
    @cases(
        ("old", "new", "said"),
        [
            ("[3, 5]", '"5..3"', r"runs\.0\.seeds = '5\.\.3': expected a list such as .* or a range"),
            ("[5.0, 10.0]", "[]", r"runs\.0 \(climb\): parameters\.increment = \[\]: expected at least one value"),
            (
                "[5.0, 10.0]",
                "[5.0, 99.0]",
                r"night\.toml: runs\.0 \(climb\): parameters \(rig heater, increment = 99\.0\): protocol stairs: "
                r"parameter increment = 99\.0 is not allowed; allowed: -50 to 50 K",
            ),
            ("increment", "incrememt", r"there is no parameter 'incrememt'; did you mean increment"),
            ("heater.toml", "haeter.toml", r"runs\.0 \(climb\): rigs = 'haeter\.toml': rig file .* cannot be read"),
            ('"heater.toml"', '["vo2-hardware"]', r"rigs = 'vo2-hardware': .*not all instruments are emulated"),
            ('name = "climb"\n', "", r"runs\.0: name is missing; a table with several protocols"),
            (
                "[[runs]]",
                "[[runs]]\nfaults = 'none.toml'",
                r"faults = 'none\.toml', rig heater: .*none\.toml cannot be",
            ),
            ("[[runs]]", "most_runs = 3\n[[runs]]", r"1 × 1 × 2 × 1 × 2 runs make 4 .*; most_runs = 3 are allowed"),
            (
                "[runs.parameters]",
                "[runs.overrides]\n'emulation.noise' = [0.1, -1]\n[runs.parameters]",
                r"rigs = 'heater\.toml' with overrides \{'emulation\.noise': '-1'\}: .*emulation\.noise = -1",
            ),
            (
                "[[runs]]",
                "[[studies]]\nname = 'v02'\n[[runs]]",
                r"studies\.0 \(v02\): name = 'v02': there is no study",
            ),
            (STAIRS, "", r"night\.toml: asks for nothing; expected tables \[\[runs\]\] or \[\[studies\]\]"),
            (STAIRS, STAIRS + STAIRS, r"runs\.1 \(climb\): name = 'climb': an earlier table has this name"),
        ],
    )
    def test_what_is_wrong_is_said_before_anything_moves(self, campaign, old, new, said, tmp_path, capsys):
        path = campaign(STAIRS, (old, new))
        assert start(path, "--out", tmp_path / "out") == 2
        assert not (tmp_path / "out").exists()
        with pytest.raises(ConfigurationError, match=said):
            expand(read_campaign(path))
        assert "Traceback" not in capsys.readouterr().err

    @cases(
        ("old", "new", "said"),
        [
            ("@density", "@densty", r"runs\.1 \(track\): parameters\.model = '@densty': .* did you mean @density"),
            ('runs = "characterize"', 'runs = "charac"', r"models\.0 \(density\): runs = 'charac': .* characterize"),
            ("preisach-nonmonotonic", "preisak", r"model = 'preisak': there is no such model; did you mean preisach"),
            ("levels = 6", "levels = 6\nseed = 9", r"models\.0 \(density\): seed = 9: .* it has: 0, 1"),
            (
                '"0..1"\nseed_',
                '"0..2"\nseed_',
                r"parameters\.model = '@density': characterize has no run on vo2 with seed 2",
            ),
            ("levels = 6", "levels = -6", r"models\.0 \(density\): .*-6.* \(rig vo2\)"),
            (
                'runs = "characterize"',
                'runs = ["characterize", "track"]',
                r"models\.0 \(density\): runs: a model preisach-nonmonotonic is identified from one run",
            ),
            (
                '"preisach-nonmonotonic"\nlevels = 6\nplane = [30.0, 70.0]',
                '"hybrid"',
                r"models\.0 \(density\): runs: expected one run each of current-steps, thermomechanical, .* on a rig "
                r"and seed; on vo2 with seed 0 there are: damped-oscillation",
            ),
        ],
    )
    def test_models_have_to_be_there(self, campaign, old, new, said):
        with pytest.raises(ConfigurationError, match=said):
            expand(read_campaign(campaign(CHAIN, (old, new))))


class TestTasks:
    def test_a_folder_is_named_by_what_differs(self, campaign):
        tasks = expand(read_campaign(campaign(STAIRS))).tasks
        assert [name.rpartition("-")[0] for name in tasks] == [
            f"climb/increment={increment}-seed={seed}" for increment in (5.0, 10.0) for seed in (3, 5)
        ]

    def test_the_identity_is_that_of_all_that_determines_the_results(self, campaign, tmp_path):
        program = tmp_path / "mine.py"
        program.write_text(PROTOCOLS.read_text())
        text = STAIRS.replace(str(PROTOCOLS), "mine.py")

        def identity(*replacements):
            return next(iter(expand(read_campaign(campaign(text, *replacements))).tasks.values())).identity

        first = identity()
        # Other runs, other names, and defaults that are written down do not matter.
        assert identity(("[3, 5]", "[3, 7]")) == first
        assert identity(("increment", "count = 4\nincrement")) == first
        found = {
            first,
            identity(("[3, 5]", "[4]")),
            identity(("[5.0, 10.0]", "5.5")),
            identity(("[3, 5]", "[3]\nseed_offset = 7")),
            identity(("[3, 5]", "[3]\ninterlock_rate = 2")),
            identity(("[runs.parameters]", "[runs.overrides]\ntelemetry.period = 1.5\n[runs.parameters]")),
        }
        program.write_text(program.read_text() + "# changed\n")
        assert len(found | {identity()}) == 7
        rig = tmp_path / "heater.toml"
        rig.write_text(rig.read_text().replace("high = 90.0", "high = 91.0"))
        assert len(found | {identity()}) == 7

    def test_a_campaign_is_one_table_and_goes_on_where_it_was(self, campaign, tmp_path, capsys):
        path, out = campaign(CHAIN), tmp_path / "out"
        assert start(path, "--out", out, "--workers", 1, "--json", tmp_path / "first.json") == 0
        assert "6 runs, 2 models to do; " in capsys.readouterr().out
        first = json.loads((tmp_path / "first.json").read_text())["tasks"]
        assert {task["status"] for task in first.values()} == {"completed"}
        assert not (out / UNFINISHED).exists()
        found = rows(out / "results.csv")
        assert [row["seed"] for row in found] == ["0", "1", "0", "1", "0", "1"]
        characterized, tracked = found[:2], found[2:]
        assert all(float(row["density_rms [1/m]"]) > 0.0 and not row["tracking_rms [1/m]"] for row in characterized)
        assert all(0.0 < float(row["tracking_rms [1/m]"]) < 300.0 for row in tracked)
        assert [row["emulation.session_offset"] for row in tracked] == ["0.1", "0.1", "0.2", "0.2"]
        schema = pq.read_schema(out / "results.parquet")
        assert schema.field("tracking_seconds_per_target [s]").metadata[b"unit"] == b"s"
        assert schema.field("seed").type == "int64"
        summary = rows(out / "summary.csv")
        assert [row["runs"] for row in summary] == ["2", "2", "2"]
        of_track = sorted(float(row["tracking_rms [1/m]"]) for row in tracked[:2])
        assert float(summary[1]["tracking_rms worst [1/m]"]) == of_track[1]
        assert float(summary[1]["tracking_rms median [1/m]"]) == pytest.approx(sum(of_track) / 2)

        # One run was lost, the seed of others is new, and a folder is named by less; the rest is not done again.
        (out / tracked[0]["folder"] / DONE_NAME).unlink()
        (out / UNFINISHED / "died").mkdir(parents=True)
        path = campaign(CHAIN, ("0..1", "0..2"), ("[0.1, 0.2]", "0.1"))
        assert start(path, "--out", out, "--workers", 1, "--json", tmp_path / "second.json") == 0
        said = capsys.readouterr().out
        assert "3 runs, 1 model to do, 5 done before; " in said
        assert "9 of 9 carried out, 5 of them before" in said
        assert not (out / UNFINISHED).exists()
        second = json.loads((tmp_path / "second.json").read_text())["tasks"]
        again = [second[row["folder"]]["results"] for row in rows(out / "results.csv")[3:5]]
        before = [first[row["folder"]]["results"] for row in tracked[:2]]
        # Done again, so that it took another time; not done again.
        assert again[0].pop("wall_time") != before[0].pop("wall_time")
        assert again == before

    def test_what_is_gone_is_made_again_and_what_was_left_stays(self, campaign, tmp_path, capsys):
        path, out = campaign(CHAIN, ("[0.1, 0.2]", "0.1"), ("0..1", "0..0")), tmp_path / "out"
        assert start(path, "--out", out, "--workers", 1) == 0
        tasks = expand(read_campaign(path)).tasks
        run, model, _ = tasks
        before = content(out / run)
        (out / run / "journal.sqlite").unlink()
        (out / run / "notes.txt").write_text("mine")
        (out / model / "model.json").unlink()
        found = done_before(tasks, out)
        assert found.lost == {run: "journal.sqlite", model: "model.json"}
        assert found.done.keys() == tasks.keys() - {run, model}
        capsys.readouterr()
        assert start(path, "--out", out, "--workers", 1) == 0
        assert "3 of 3 carried out, 1 of them before" in capsys.readouterr().out
        assert content(out / run) == before
        assert (out / model / "model.json").is_file()
        assert (out / f"{run}.incomplete" / "notes.txt").read_text() == "mine"
        assert start(path, "--out", out, "--workers", 1) == 0
        assert "nothing to do, 3 done before" in capsys.readouterr().out
        # A result that cannot be used is named with what to remove.
        (out / model / "model.json").write_text("broken")
        other = campaign(CHAIN, ("[0.1, 0.2]", "0.2"), ("0..1", "0..0"))
        assert start(other, "--out", out, "--workers", 1) == 1
        assert f"; remove {model} from the campaign, and the next start makes it again" in capsys.readouterr().err
        (out / run / "journal.sqlite").unlink()
        (line,) = done_before(tasks, out).put_in_place(out)
        assert line.startswith(f"{run} is done again, as journal.sqlite is gone; what was left is in ")
        assert line.endswith(".incomplete-2 beside it")

    def test_models_are_compared_on_runs(self, campaign, tmp_path, capsys):
        compared = CHAIN[: CHAIN.index('[[runs]]\nname = "track"')].replace("levels = 6", "levels = [4, 6]")
        for name, recalibrate in (("own", ""), ("offset", 'recalibrate = "offset"\nrecalibrate_rows = 20\n')):
            compared += f'[[comparisons]]\nname = "{name}"\nruns = "characterize"\nmodels = "density"\n{recalibrate}'
        out = tmp_path / "out"
        assert start(campaign(compared), "--out", out, "--workers", 1) == 0
        assert "2 runs, 2 models, 4 comparisons to do" in capsys.readouterr().out
        found = rows(out / "comparisons.csv")
        assert [(row["comparison"], row["model"]) for row in found] == [("own", "density")] * 2 + [
            ("offset", "density")
        ] * 2
        # On the runs that they were identified from the errors are those of the identification.
        identified = rows(out / "results.csv")
        for mine, its in zip(found, identified, strict=False):
            assert mine["run"] == its["folder"]
            assert float(mine["rms [1/m]"]) == pytest.approx(float(its["density_rms [1/m]"]), rel=1e-9)
        summary = rows(out / "comparisons-summary.csv")
        largest = [float(row["max [1/m]"]) for row in found[:2]]
        assert float(summary[0]["max worst [1/m]"]) == max(largest)
        assert float(summary[0]["max spread [1/m]"]) == pytest.approx(max(largest) - min(largest))
        assert summary[1]["runs"] == "2"

    @cases(
        ("table", "said"),
        [
            (
                'runs = "charac"\nmodels = "density"',
                r"comparisons\.0 \(c\): runs = 'charac': .* did you mean characterize",
            ),
            ('runs = "track"\nmodels = "densty"', r"models = 'densty': there is no table of models .*density"),
            ('runs = "track"\nmodels = "density"\nrecalibrate = "of"', "recalibrate"),
        ],
    )
    def test_what_is_compared_has_to_be_there(self, campaign, table, said):
        path = campaign(CHAIN + f'[[comparisons]]\nname = "c"\n{table}\n')
        with pytest.raises(ConfigurationError, match=said):
            expand(read_campaign(path))

    def test_a_run_that_an_interlock_ends_is_a_result(self, campaign, tmp_path, capsys):
        path = campaign(STAIRS, ("[5.0, 10.0]", "[5.0, 20.0]\ndwell = 30"), ("[3, 5]", "3"))
        assert start(path, "--out", tmp_path / "out", "--workers", 1) == 0
        completed, failed = rows(tmp_path / "out" / "results.csv")
        assert (completed["status"], failed["status"]) == ("completed", "failed")
        assert "probe_temperature" in failed["reason"]
        assert start(path, "--out", tmp_path / "out", "--workers", 1) == 0
        assert "nothing to do, 2 done before" in capsys.readouterr().out

    def test_a_defect_is_named_and_its_run_done_again(self, campaign, tmp_path, capsys):
        program = tmp_path / "mine.py"
        text = PROTOCOLS.read_text()
        program.write_text(
            text.replace(
                'yield Note(f"step',
                "assert reading['probe_temperature'] < 35.0 or not reading.step\n        yield Note(f\"step",
            )
        )
        assert program.read_text() != text
        path = campaign(STAIRS.replace(str(PROTOCOLS), "mine.py"), ("[3, 5]", "3"), ("[5.0, 10.0]", "[0.0, 5.0]"))
        assert start(path, "--out", tmp_path / "out", "--workers", 1) == 1
        assert "crashed: climb/increment=5.0-" in capsys.readouterr().err
        assert start(path, "--out", tmp_path / "out", "--workers", 1) == 1
        assert "1 run to do, 1 done before" in capsys.readouterr().out

    def test_one_process_at_a_time_works_in_a_folder(self, campaign, tmp_path, capsys):
        path, out = campaign(STAIRS), tmp_path / "out"
        with opened_folder(out):
            assert start(path, "--out", out, "--workers", 1) == 2
        assert "out is in use: " in capsys.readouterr().err

    def test_nothing_is_done_in_a_dry_run(self, campaign, tmp_path, capsys):
        assert start(campaign(STAIRS), "--out", tmp_path / "out", "--dry-run") == 0
        said = capsys.readouterr().out
        assert said.startswith("4 runs to do; 0.0 h of laboratory time, less than a minute on ")
        assert said.count("climb/increment=") == 4
        assert not (tmp_path / "out").exists()


def the_study(series):
    """A study of one run."""
    reached = series.run(f"{PROTOCOLS}:stairs", {"count": "2"})
    table = ResultTable("a {word}", ("seed", "steps"), [("{seed:.1f}", "{nested[steps]:g}")])
    return StudyResult({"seed": series.seed, "nested": {"steps": reached.outcome.steps}, "word": "no"}, (table,), ())


def test_a_study_runs_with_several_seeds(campaign, tmp_path, monkeypatch, capsys):
    study = Study(str(tmp_path / "heater.toml"), "", "", the_study)
    monkeypatch.setattr(registry, "load", lambda *_: study)
    path = campaign("[[studies]]\nname = 'climbs'\nseeds = [1, 2, 6]\n")
    assert start(path, "--out", tmp_path / "out", "--workers", 1) == 0
    by_number = {row["number"]: row for row in rows(tmp_path / "out" / "studies.csv")}
    assert set(by_number) == {"seed", "nested.steps"}
    assert [float(by_number["seed"][head]) for head in ("seeds", "median", "worst", "spread")] == [3, 2, 6, 5]
    assert len(rows(tmp_path / "out" / "study-values.csv")) == 6
    said = capsys.readouterr().out
    assert "climbs, 3 seeds: median (least–greatest)" in said
    assert "2.0 (1.0–6.0)" in said
    written = (tmp_path / "out" / "studies.md").read_text(encoding="utf-8")
    assert "**A no**\n\n| seed | steps |\n| --- | --- |\n| 2.0 (1.0–6.0) | 2 |" in written


def test_a_study_takes_the_file_of_its_rig_along(campaign, tmp_path, monkeypatch):
    study = Study("vo2", "", "", the_study)
    monkeypatch.setattr(registry, "load", lambda *_: study)
    (task,) = expand(read_campaign(campaign("[[studies]]\nname = 'climbs'\nrigs = 'heater.toml'\n"))).tasks.values()
    rig = tmp_path / "heater.toml"
    assert list(task.files) == [rig]
    assert task.moved({str(rig): "/elsewhere/heater.toml"}).rig == "/elsewhere/heater.toml"


def test_a_killed_worker_is_replaced_and_its_run_equals_one_alone(campaign, tmp_path):
    path = campaign(STAIRS, ("increment = [5.0, 10.0]", "increment = 0.0\ncount = 800"))
    expansion = expand(read_campaign(path))
    out = tmp_path / "out"
    killed = []
    with Workers(2) as workers:

        def kill_one():
            # Once its journal is there a run is going on, for a second at least.
            while not any(out.glob(f"{UNFINISHED}/*/*/*/journal.sqlite")):
                if over.wait(0.01):
                    return
            process = next(iter(workers._processes))
            os.kill(process.pid, signal.SIGKILL)
            killed.append(process.pid)

        over = threading.Event()
        killer = threading.Thread(target=kill_one)
        killer.start()
        done = carry_out_tasks(expansion.tasks, {}, WorkersExecutor(workers, out))
        over.set()
        killer.join()
    assert killed
    assert [each.status for each in done.values()] == ["completed", "completed"]
    assert done_before(expansion.tasks, out).done == done
    for task in expansion.tasks.values():
        alone = carry_out(task.run(out, tmp_path / "alone"), Console(quiet=True))
        assert content(alone.folder) == content(out / task.name)


@cases("address", ["tls://lab-7:8786", "tcp://127.0.0.1:8786", "tcp://localhost:1", "[::1]:8786"])
def test_a_scheduler_is_encrypted_or_here(address):
    check_address(address)


@pytest.mark.parametrize(
    "address", ["tcp://lab-7:8786", "10.0.0.7:8786", "ws://127.0.0.1:80", "tls://", "", "://127.0.0.1:1"]
)
def test_no_other_scheduler_is_trusted(address, campaign, tmp_path, capsys):
    with pytest.raises(
        ConfigurationError, match=r"is unpickled, .* expected tls://HOST:PORT, .* or tcp://127\.0\.0\.1"
    ):
        check_address(address)
    if address == "tcp://lab-7:8786":
        assert start(campaign(STAIRS), "--out", tmp_path / "out", "--scheduler", address) == 2
        assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.seeds
def test_a_cluster_gives_the_same(campaign, tmp_path, rig_file):
    distributed = pytest.importorskip("distributed")
    program = tmp_path / "mine.py"
    program.write_text(PROTOCOLS.read_text())
    # What the rig file imports goes with it if it stands beside it; here it is found nowhere else.
    shutil.copy(SUPPORT / "heater_laboratory.py", tmp_path / "shipped_laboratory.py")
    chain = CHAIN.replace("0..1", "0..0").replace("[0.1, 0.2]", "0.1")
    path = campaign(chain + STAIRS.replace(str(PROTOCOLS), "mine.py"), ("[3, 5]", "3"), ("[5.0, 10.0]", "5.0"))
    rig_file(("heater_laboratory:", "shipped_laboratory:"))
    # Its processes begin with the import path of this one, so they come before the folder of the rig is on it.
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
    ) as cluster:
        expansion = expand(read_campaign(path))
        with ClusterExecutor(cluster.scheduler_address, tmp_path / "there", Console(quiet=True)) as executor:
            there = carry_out_tasks(expansion.tasks, {}, executor)
    with Workers(1) as workers:
        here = carry_out_tasks(expansion.tasks, {}, WorkersExecutor(workers, tmp_path / "here"))
    assert [(each.status, each.reason) for each in there.values()] == [("completed", "")] * 4
    assert done_before(expansion.tasks, tmp_path / "there").done == there
    for name, task in expansion.tasks.items():
        assert there[name].identity == here[name].identity
        if task.kind == "run":
            assert content(tmp_path / "there" / name) == content(tmp_path / "here" / name)


def test_a_number_over_seeds_is_its_median_and_its_range():
    values = over_seeds(
        [{"a": [1.0, 0.2], "same": 7, "word": "x", "only": 1}, {"a": [4.0, -0.2], "same": 7, "word": "x"}]
    )
    assert set(values) == {"a", "same", "word"}
    assert "{a[0]:.1f}, {a[1]:+g}, {same}, {word}".format_map(values) == "2.5 (1.0–4.0), +0 (-0.2 to +0.2), 7, x"
    assert f"{OverSeeds((float('nan'), 3.0, 5.0)):.0f}" == "4 (3–5)"
