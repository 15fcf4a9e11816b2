"""Files that are nested deeper than they can be read, and names that no file can have: one message each."""

import ast
import json
import math
from pathlib import Path
from typing import Literal

import pytest
from cases import cases
from pydantic import Field, ValidationError

from bench.base import CheckedTable, parse_json, parse_toml

DEEP = "[" * 100_000 + "]" * 100_000
TOML, JSON = f"rig = {DEEP}\n", f'{{"kind": {DEEP}}}'
CREEP = ["run", "creep", "--clock", "virtual"]


@cases("parse", [parse_json, parse_toml])
def test_what_is_too_deep_is_a_value_error(parse):
    with pytest.raises(ValueError, match="nested too deeply"):
        parse(f"a = {DEEP}" if parse is parse_toml else DEEP)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1, "b": {"c": 1, "c": 1}}', "'c' comes twice"),
        ('{"a": 1e999}', "1e999 is beyond"),
        ("[-1e999]", "-1e999 is beyond"),
        ("9" * 400, "more than 308 digits"),
        ("[1, -" + "9" * 5000 + "]", "more than 308 digits"),
        (b"\xff", "utf-8"),
        ("\ufeff{}", "line 1"),
    ],
)
def test_json_that_would_be_read_as_something_else_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        parse_json(text)


@pytest.mark.parametrize("text", ["a = 1e999", "a = [1, -1e999]", f"a.b = [{{c = {'9' * 400}}}]", "a = 1\na = 1"])
def test_toml_that_would_be_read_as_something_else_is_refused(text):
    with pytest.raises(ValueError, match=r"beyond|digits|overwrite"):
        parse_toml(text)


def test_what_can_be_held_is_read():
    text = '{"a": [1, -2.5, 1e308, 123456789012345678901234567890, true, null, "x"]}'
    assert parse_json(text) == parse_json(text.encode()) == json.loads(text)
    assert parse_toml("a = [inf, -inf, 1e308, 1_000]")["a"] == [math.inf, -math.inf, 1e308, 1000]


class Limits(CheckedTable):
    low: float = 0.0
    count: int | None = None
    either: bool | float = False
    levels: tuple[float, ...] = ()
    named: dict[str, float | None] = Field(default_factory=dict)
    version: Literal[1] = 1


class Tables(CheckedTable):
    # A name that schemas of pydantic have as well.
    type: str = ""
    limits: tuple[Limits, ...] = ()


@pytest.mark.parametrize(
    "table",
    [
        {"low": True},
        {"count": False},
        {"levels": [1.0, True]},
        {"named": {"a": True}},
        {"low": math.nan},
        {"version": True},
    ],
)
def test_a_table_takes_no_truth_for_a_number(table):
    with pytest.raises(ValidationError):
        Tables(limits=[table])


def test_a_table_takes_no_text_with_a_null_character():
    with pytest.raises(ValidationError):
        Tables(type="a\0b")


def test_a_table_takes_numbers():
    table = Limits(low=1, count=2, either=True, levels=[1.0, 2], named={"a": None, "b": 1})
    assert (table.low, table.count, table.either) == (1.0, 2, True)
    assert (table.levels, table.named) == ((1.0, 2.0), {"a": None, "b": 1.0})


@pytest.mark.parametrize(
    ("key", "value"),
    [("devices.tec.watchdog", "true"), ("roles.drive.range", "[true, 84.0]"), ("telemetry.period", "true")],
)
def test_a_rig_file_takes_no_truth_for_a_number(bench, key, value):
    code, _, err = bench("run", "creep", "--rig", "vo2", "--dry-run", "--override", f"{key}={value}")
    assert (code, "Traceback" in err) == (2, False)
    assert key.rpartition(".")[2] in err


def test_json_and_toml_are_read_in_one_place():
    """A module that reads them by itself takes what the one reader refuses."""
    root = Path(__file__).parents[3]
    readers = {
        ("json", "load"),
        ("json", "loads"),
        ("json", "JSONDecoder"),
        ("tomllib", "load"),
        ("tomllib", "loads"),
    }
    found = set()
    for folder in ("bench", "drivers", "sim_devices", "protocols", "rigs"):
        for path in sorted((root / folder).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            # Parsing takes long, and few modules name these libraries.
            if not any(library in text for library, _ in readers):
                continue
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                    used = {(node.value.id, node.attr)}
                elif isinstance(node, ast.ImportFrom):
                    used = {(node.module, each.name) for each in node.names}
                else:
                    continue
                if used & readers:
                    found.add(path.relative_to(root).as_posix())
    assert found == {"bench/base/parsing.py"}


@pytest.mark.parametrize(
    ("name", "text", "command"),
    [
        ("rig.toml", TOML, [*CREEP, "--rig", "FILE"]),
        ("rig.toml", f'extends = "vo2"\n[devices.psd]\ncalibrations = {DEEP}\n', ["show", "FILE"]),
        ("campaign.toml", TOML, ["study", "FILE"]),
        ("faults.toml", TOML, [*CREEP, "--rig", "vo2", "--faults", "FILE"]),
        ("faults.jsonl", JSON, [*CREEP, "--rig", "vo2", "--faults", "FILE"]),
        ("faults.jsonl", JSON, ["run", "creep", "--rig", "vo2", "--dry-run", "--faults", "FILE"]),
        ("endpoints.json", JSON, ["run", "creep", "--rig", "vo2", "--attach", "FILE"]),
        ("model.json", JSON, ["model", "test", "FILE", "--data", "RIG"]),
        ("calibration.json", JSON, [*CREEP, "--rig", "RIG"]),
    ],
    ids=["rig", "key", "campaign", "faults", "lines", "dry run", "endpoints", "model", "calibration"],
)
def test_it_is_one_message(bench, tmp_path, name, text, command):
    file, rig = tmp_path / name, tmp_path / "calibrated.toml"
    file.write_text(text)
    rig.write_text('extends = "vo2"\n[derived.tip]\nkind = "calibrated"\ncalibration = "calibration.json"\n')
    words = [{"FILE": file, "RIG": rig}.get(word, word) for word in command]
    code, _, err = bench(*words)
    assert code in (2, 3)
    assert (err.count("error: "), "Traceback" in err) == (1, False)
    assert name in err


LONG, NO_TEXT = "a" * 4200, "a\udcff"
COMMANDS = (
    [*CREEP, "--rig", "vo2", "--out"], ["runs"], ["identify", "--input", "u", "--output", "y"], ["report"], ["view"],
    ["new", "rig"], ["run", "--from"], ["resume"], ["study", "vo2", "--out"], ["rig", "emulate", "vo2", "--json"],
)  # fmt: skip


@pytest.mark.parametrize("name", [LONG, NO_TEXT], ids=["long", "no text"])
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_name_that_no_file_has_is_one_message(bench, tmp_path, monkeypatch, command, name):
    monkeypatch.chdir(tmp_path)
    code, _, err = bench(*command, name)
    assert code == 2
    assert (err.count("error: "), "Traceback" in err) == (1, False)
    assert ("too long" if name is LONG else "no text") in err
    assert [*tmp_path.iterdir()] == []
