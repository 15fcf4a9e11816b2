"""The command line as a newcomer meets it: mistakes with their cures, limits of the help, and runs by name."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from every_command import every_command

import bench as package
from bench.record import FILE_NAME

ROOT = Path(__file__).parents[2]
CREEP = "run creep --rig vo2 --set duration=2 --set settling=1"
LOOPS = "identify loops.csv --input voltage --output displacement --model"
BROKEN = """extends = "vo2"
[devices.tec]
current_limit = "much"
watchdgo = 1
[telemetry]
rate = -1
"""

# A command, and what its one line has to say: where, and the cure.
MISTAKES = [
    ("rnu creep", ["no command rnu", "did you mean run?"]),
    ("doctor vo2", ["bench doctor is now bench rig check"]),
    ("identify-anything a b", ["is now bench identify RUN... --model NAME"]),
    ("rig chek vo2", ["no command chek", "did you mean check?"]),
    ("runs exprt", ["no exprt", "did you mean export?"]),
    ("study vo3", ["no vo3", "did you mean vo2?"]),
    ("study night.toml", ["night.toml cannot be read", "No such file"]),
    ("run crep --rig vo2", ["no protocol 'crep'", "did you mean creep?"]),
    ("run creep", ["--rig is missing", "bench list"]),
    ("run creep --rig vo3", ["no rig 'vo3'", "did you mean vo2?"]),
    ("run creep --rig vo2 --sett a=1", ["no option --sett", "did you mean --set?"]),
    ("run creep --rig vo2 --seed x", ["--seed x", "a whole number"]),
    ("run creep --rig vo2 --set duration", ["--set 'duration'", "KEY=VALUE"]),
    ("run creep --rig vo2 --set duraton=5", ["no parameter 'duraton'", "did you mean duration?"]),
    ("run creep --rig vo2 --set duration=abc", ["duration = 'abc'", "1 to 86400 s", "a number"]),
    ("run creep --rig vo2 --clock fast", ["fast", "wall"]),
    ("run creep --rig broken.toml", ["broken.toml"]),
    ("run creep --rig none.toml", ["none.toml", "No such file"]),
    ("run --from loops.csv --seed 3", ["--from", "leave --seed out"]),
    ("rehearse", ["PROTOCOL and --rig", "bench list"]),
    ("predict", ["model.json, FILE, --input, --out", "bench predict --help"]),
    ("predict model.json loops.csv", ["missing: --input, --out;"]),
    ("identify loops.csv", ["--input COLUMN and --output COLUMN", "voltage [V], displacement [um]"]),
    ("identify loops.csv --input voltag --output displacement", ["no column 'voltag'", "voltage [V]"]),
    (f"{LOOPS} preisch", ["no model 'preisch'", "did you mean preisach?"]),
    (f"{LOOPS} preisach -o spacin=uniform", ["no spacin", "did you mean spacing?"]),
    (f"{LOOPS} preisach --levels many", ["--levels many", "numbers"]),
    (f"{LOOPS} preisach --smoothing -1", ["--smoothing -1", "≥ 0"]),
    ("identify loops.csv --format decmal=comma", ["no such word", "did you mean decimal?"]),
    ("report", ["recordings has no runs", "bench run"]),
    ("report none", ["none is not a run"]),
    ("resume @3", ["@3", "no runs"]),
    ("show preisac", ["'preisac'", "did you mean preisach?"]),
    ("invert a.json b.csv --column y --policy best", ["--policy best", "'nearest'"]),
    ("new bottle x", ["bottle", "'device'"]),
]

OF_PYTHON = re.compile(
    r"Traceback|pydantic|Errno|Field required|Input should|unable to parse|Value error|NoneType|PosixPath"
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in a folder with a table of measurements and a rig file with mistakes."""
    monkeypatch.chdir(tmp_path)
    inputs = 5 * np.sin(np.linspace(0, 6 * np.pi, 200)) * np.linspace(1, 0.2, 200)
    outputs = np.tanh(inputs) + 0.1 * inputs
    rows = "".join(f"{u:.4f},{y:.4f}\n" for u, y in zip(inputs, outputs, strict=True))
    Path("loops.csv").write_text(f"voltage [V],displacement [um]\n{rows}")
    Path("broken.toml").write_text(BROKEN)
    return tmp_path


@pytest.mark.parametrize(("words", "expected"), MISTAKES, ids=[words for words, _ in MISTAKES])
def test_a_mistake_is_one_line_with_its_cure(bench, folder, words, expected):
    code, out, err = bench(*shlex.split(words))
    assert code in (2, 3)
    assert out == ""
    lines = err.splitlines()
    assert all(line.startswith("error: ") for line in lines)
    assert len(lines) == 1 or "broken" in words
    assert not OF_PYTHON.search(err)
    for text in expected:
        assert text in err
    assert {path.name for path in folder.iterdir()} == {"loops.csv", "broken.toml"}


def test_all_mistakes_of_a_file_are_said_together(bench, folder):
    _, _, err = bench("run", "creep", "--rig", folder / "broken.toml")
    for text in (
        "current_limit = 'much': expected a number",
        "watchdgo: there is no such key; did you mean watchdog?",
        "telemetry.rate: there is no such key; there are: period",
    ):
        assert text in err
    _, _, err = bench(
        "run", "creep", "--rig", "vo2", "--set", "duration=x", "--set", "settling=y", "--set", "seling=1"
    )
    assert err.count("error: ") == 3


def test_the_help_fits_on_screens(bench):
    code, out, _ = bench("--help")
    assert (code, out) == bench()[:2]
    assert len(out.splitlines()) < 40
    assert re.findall(r"^(\S.*):$", out, re.MULTILINE)[-4:] == ["Run", "Look", "Model", "Rig & extend"]
    assert len(re.findall(r"^  [a-z]+ {2,}\S", out, re.MULTILINE)) <= 17
    code, out, _ = bench("identify", "-h")
    assert code == 0
    assert max(map(len, out.splitlines())) <= 80


def test_every_command_answers_to_the_short_help(bench):
    for name, _ in every_command():
        code, out, _ = bench(*(word for word in name.split() if word != "FILE"), "-h")
        assert code == 0, name
        assert "Usage" in out


def test_the_version_is_that_of_the_package(bench):
    assert bench("--version")[:2] == (0, f"bench {package.__version__}\n")


def test_a_run_is_named_by_its_age_or_the_beginning_of_its_name(bench, folder):
    for temperature in (60, 65):
        code, out, err = bench(*shlex.split(CREEP), "--set", f"hot={temperature}")
        assert code == 0, err
        made = next(line for line in out.splitlines() if line.startswith("record: ")).removeprefix("record: ")
        assert f"next: bench report {made}" in out
    first, second = sorted(folder.joinpath("recordings").iterdir(), key=lambda run: "65" in run.name)
    for words, run in (((), second), (("@1",), second), (("@2",), first), ((first.name[:-3],), first)):
        code, _, err = bench("runs", "export", *words, "--format", "csv", "--out", folder / run.name)
        assert code == 0, err
        assert (folder / run.name / "readings.csv").exists()
    code, out, _ = bench("runs", "compare")
    assert code == 0
    assert first.name in out.replace("\n", "")
    # Unless told, an emulated rig runs on the virtual clock.
    _, out, _ = bench("runs", "--where", "clock=virtual")
    assert first.name in out
    code, _, err = bench("report", "vo2-creep")
    assert code == 2
    assert "2 runs begin so" in err


def test_a_model_without_a_file_is_kept_with_its_run(bench, folder):
    code, _, err = bench(*shlex.split(CREEP), "--set", "interval=0.1", "--out", "runs")
    assert code == 0, err
    (run,) = folder.glob("runs/*")
    code, out, err = bench("identify", run, "--model", "polynomial")
    assert code == 0, err
    assert "polynomial, kept with the run" in out
    # The columns of a run are those of its slots.
    named = ("--input", "tec_temperature", "--output", "curvature")
    assert bench("identify", run, *named, "--model", "polynomial", "--out", "named.json")[0] == 0
    kept = json.loads((run / "models" / "polynomial.json").read_text())
    assert kept.pop("kept")
    assert kept == json.loads(Path("named.json").read_text())
    assert [path.name for path in run.glob("models/*")] == ["polynomial.json"]


def test_a_newcomer_gets_a_report_of_his_own_identification_by_the_words_of_the_readme(bench, folder):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = [block.splitlines() for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL)]
    blocks = [[shlex.split(line, comments=True) for line in block if line.startswith("bench ")] for block in blocks]
    (own,) = (block for block in blocks if any(words[1] == "identify" and "." in words[2] for words in block))
    paths = [word for words in own for word in words[1:] if "." in word or "/" in word]
    assert len(paths) == len(set(paths)), "a path is typed twice"
    assert not [word for words in own for word in words if set(word) & set("*?[")]
    measurements = own[0][2]
    output = own[0][own[0].index("--output") + 1]
    table = Path("loops.csv").read_text()
    Path(measurements).write_text(table.replace("displacement", output))
    for words in (words for block in blocks for words in block):
        code, _, err = bench(*words[1:])
        assert code == 0, (words, err)
    assert [*folder.glob("recordings/*/report.html")]
    (card,) = (path for path in folder.glob("*.md"))
    assert measurements in card.read_text(encoding="utf-8")
    assert [*folder.glob("figures/*.png")]


def test_a_shell_completes_rigs_protocols_parameters_and_runs(folder, warm_process):
    import os
    import sys

    (folder / "recordings" / "a-run-20260101-000000").mkdir(parents=True)
    (folder / "recordings" / "a-run-20260101-000000" / FILE_NAME).touch()
    for line, expected in (
        ("bench ru", {"run", "runs"}),
        ("bench run cree", {"creep"}),
        ("bench run creep --rig vo2-h", {"vo2-hardware"}),
        ("bench run creep --set dura", {"duration="}),
        ("bench report a-", {"a-run-20260101-000000"}),
    ):
        environment = {**os.environ, "_BENCH_COMPLETE": "complete_bash", "COMP_WORDS": line}
        environment["COMP_CWORD"] = str(len(line.split()) - 1)
        done = warm_process([sys.executable, "-m", "bench"], folder, environment)
        assert expected <= set(done.stdout.split()), (line, done.stdout, done.stderr)
