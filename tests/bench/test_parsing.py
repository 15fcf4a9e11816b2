"""Files that are nested deeper than they can be read, and names that no file can have: one message each."""

import pytest

from bench.parsing import parse_json, parse_toml

DEEP = "[" * 100_000 + "]" * 100_000
TOML, JSON = f"rig = {DEEP}\n", f'{{"kind": {DEEP}}}'
CREEP = ["run", "creep", "--clock", "virtual"]


@pytest.mark.parametrize("parse", [parse_json, parse_toml])
def test_what_is_too_deep_is_a_value_error(parse):
    with pytest.raises(ValueError, match="nested too deeply"):
        parse(f"a = {DEEP}" if parse is parse_toml else DEEP)


@pytest.mark.parametrize(
    ("name", "text", "command"),
    [
        ("rig.toml", TOML, [*CREEP, "--rig", "FILE"]),
        ("rig.toml", f'extends = "vo2"\n[devices.psd]\ncalibrations = {DEEP}\n', ["list", "FILE"]),
        ("campaign.toml", TOML, ["campaign", "FILE"]),
        ("faults.toml", TOML, [*CREEP, "--rig", "vo2", "--faults", "FILE"]),
        ("faults.jsonl", JSON, [*CREEP, "--rig", "vo2", "--faults", "FILE"]),
        ("endpoints.json", JSON, ["run", "creep", "--rig", "vo2", "--attach", "FILE"]),
        ("model.json", JSON, ["compare", "FILE", "--data", "RIG"]),
        ("calibration.json", JSON, [*CREEP, "--rig", "RIG"]),
    ],
    ids=["rig", "key", "campaign", "faults", "lines", "endpoints", "model", "calibration"],
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
    [*CREEP, "--rig", "vo2", "--out"], ["runs"], ["identify", "--input", "u", "--output", "y"], ["report"], ["watch"],
    ["new", "rig"], ["repeat"], ["resume"], ["reproduce", "vo2", "--out"], ["emulate", "vo2", "--json"],
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
