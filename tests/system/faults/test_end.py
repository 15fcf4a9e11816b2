"""A device that falls silent between the last reading of a run and its safe state."""

import json
import sys
from pathlib import Path

from bench.record import Record

RIG = Path(__file__).parents[3] / "examples" / "bench-supply.toml"
SET = ("hot=6", "cool=4", "duration=1", "settling=0")


def test_the_run_says_so_in_every_place(bench, tmp_path):
    def run(name, *options):
        out, result = tmp_path / name, tmp_path / f"{name}.json"
        keys = (word for each in SET for word in ("--set", each))
        code, *said = bench(
            "run", "creep", "--rig", RIG, *keys, "--no-rehearse", *options, "--out", out, "--json", result
        )
        found = json.loads(result.read_text())
        with Record(Path(found["folder"]) / "journal.sqlite") as record:
            return code, "".join(said), found, [*record.events()], record.steps()["finished"]

    code, _, result, events, steps = run("well")
    assert (code, result["is_safe"]) == (0, True)
    assert steps[-1] < events[-1].t
    faults, listener, told = tmp_path / "faults.toml", tmp_path / "listen.py", tmp_path / "told"
    faults.write_text(f'[[fault]]\nat = {(steps[-1] + events[-1].t) / 2}\nfault = "supply.hang"\n')
    listener.write_text(f"import sys\nopen({str(told)!r}, 'ab').write(sys.stdin.buffer.read() + b'\\n')\n")
    command = f'"{sys.executable}" "{listener}"'
    code, said, result, events, after = run("silent", "--faults", faults, "--notify", command)
    assert code == 7
    assert len(after) == len(steps)
    assert "supply is NOT in its safe state" in said
    assert (result["status"], result["is_safe"], result["safe_state"]["meter"]) == ("completed", False, "safe")
    assert events[-1].level == "WARN"
    (facts,) = map(json.loads, told.read_text().splitlines())
    assert (facts["event"], facts["level"]) == ("end", "WARN")
    assert "supply" in facts["text"]
    code, *said = bench("runs", "list", tmp_path / "silent", "--json", tmp_path / "list.json")
    assert code == 0, said
    (listed,) = json.loads((tmp_path / "list.json").read_text())
    assert "supply" in listed["result"]
