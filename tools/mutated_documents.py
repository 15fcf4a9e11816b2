"""Mutated files of JSON and TOML: no number of another type is taken, and no key that is unknown or comes twice."""

import functools
import json
import math
import random
import re
import shutil
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from commands import call
from mutations import mutated_bytes, mutated_document, mutated_lines, objections

from bench.base import BenchError
from bench.rig import load_rig

ROOT = Path(__file__).parents[1]

MODELS = {
    "preisach": ("--levels", 5), "preisach-signed": ("--levels", 4), "prandtl-ishlinskii": ("-o", "plays=4"),
    "polynomial": ("-o", "degree=3"), "duhem": (), "bouc-wen": (), "maxwell-slip": (),
    "generalized-prandtl-ishlinskii": (), "krasnoselskii-pokrovskii": ("--levels", 4), "polynomial-plays": (),
    "hammerstein": ("--time", "t", "-o", "static=polynomial", "-o", "dynamics=lag"),
}  # fmt: skip
CALIBRATION = {
    "format": "bench-calibration", "version": 2, "signal": "psd_position", "unit": "m", "serial_number": "",
    "date": "2026-01-05", "interval_days": 365, "reference": "a gauge", "reference_unit": "m",
    "reference_uncertainty": 1e-8, "low": -4e-5, "high": 9e-5, "coefficients": [1e-7, 2e-7],
    "covariance": [[1e-18, 0.0], [0.0, 1e-18]], "degrees_of_freedom": 30, "lateness": 0.01, "repeatability": 2e-8,
    "readings": 40, "run": "somewhere",
}  # fmt: skip
CALIBRATED = 'extends = "vo2"\n[derived.tip]\nkind = "calibrated"\nsource = "psd_position"\ncalibration = "c.json"\n'
TUNING = {
    "tuning": {"open-loop-inverse": {"lead": 1.14}, "closed-loop-inverse": {"lead": 1.1, "walk_variance": 30.0}},
    "provenance": {"source": "a twin", "error": 1.5},
}  # fmt: skip
FAULTS = {"fault": [{"fault": "tec.delay", "at": 3.0, "duration": 2.0, "values": {"seconds": 0.1}}]}


def toml_of(document: dict[str, Any]) -> str:
    """Return a document as TOML; what TOML does not have becomes a text."""
    return "".join(f"{_key(key)} = {_toml(value)}\n" for key, value in document.items())


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(key)} = {_toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value) if value is not None else '""'


def _key(key: str) -> str:
    return json.dumps(key)


def parsed(text: str, *, toml: bool) -> Any:
    """Return a document; raise ValueError if there is none, or a key comes twice with another value."""
    if toml:
        return tomllib.loads(text)

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in pairs:
            if key in found and found[key] != value:
                raise ValueError(f"{key} comes twice")
            found[key] = value
        return found

    return json.loads(text, object_pairs_hook=once)


def try_document(
    file: Path,
    text: str,
    rng: random.Random,
    take: Callable[[], bool],
    free: tuple[str, ...] = (),
    *,
    new_keys: bool = True,
) -> str:
    """Write a mutated document and have it taken; return what is wrong with that, empty if it was refused.

    Parameters
    ----------
    file : Path
        Where it is written; TOML or JSON by its ending.
    text : str
        The document.
    take : callable
        Gives the file to the bench; returns whether it was taken.
    free : tuple of str
        Keys below which anything may stand.
    new_keys : bool
        Whether keys that it does not know have to be refused.
    """
    toml = file.suffix == ".toml"
    template = parsed(text, toml=toml)
    if rng.random() < 0.02:
        file.write_text(text, encoding="utf-8")
        return "" if take() else "it is refused unchanged"
    kind = rng.random()
    if kind < 0.6:
        changed = mutated_document(template, rng)
        content = (toml_of(changed) if toml else json.dumps(changed, indent=1)).encode("utf-8", "surrogatepass")
    elif kind < 0.85:
        content = mutated_lines(text, rng)
    else:
        content = mutated_bytes(text.encode(), rng)
    file.write_bytes(content)
    if not take():
        return ""
    try:
        changed = parsed(content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n"), toml=toml)
    except (ValueError, RecursionError) as error:
        return f"it is taken, although {error}"
    said = (each for each in objections(template, changed, free) if new_keys or not each.endswith("a new key"))
    return "; ".join(f"it is taken with {each}" for each in said)


def is_loaded(file: Path) -> bool:
    """Return whether a rig file is taken."""
    try:
        load_rig(str(file), {})
    except BenchError:
        return False
    return True


def try_rig(folder: Path, rng: random.Random) -> str:
    """Have a mutated rig file loaded, and a run on it planned."""
    file = folder / "rig.toml"
    name = rng.choice(("rigs/vo2/vo2.toml", "rigs/muscles/sma.toml", "examples/bench-supply.toml"))
    is_planned = "vo2" in name and rng.random() < 0.3
    text = (ROOT / name).read_text(encoding="utf-8")

    def take() -> bool:
        return is_loaded(file) and not (is_planned and call("run", "creep", "--rig", file, "--dry-run").code)

    # Every protocol may name parameters of its own, and a rig names its roles as it likes.
    wrong = try_document(file, text, rng, take, ("protocols", "emulation"))
    return "" if re.fullmatch(r"it is taken with \.roles\.[^.;]*: a new key", wrong) else wrong


def try_campaign(folder: Path, rng: random.Random) -> str:
    """Have a mutated campaign file checked."""
    file = folder / "campaign.toml"
    shutil.copy(ROOT / "examples/campaign-faults.toml", folder)
    text = (ROOT / "examples/campaign.toml").read_text(encoding="utf-8").replace("..2", "..1")
    return try_document(
        file, text, rng, lambda: call("study", file, "--dry-run", "--out", folder / "out").code == 0,
        ("parameters", "overrides", "seeds", "levels", "rigs", "controller", "protocol", "model", "runs"),
    )  # fmt: skip


@functools.cache
def models() -> dict[str, tuple[str, str]]:
    """Return the text of a model file of each kind, and what it predicts."""
    found = {}
    folder = Path(tempfile.mkdtemp(prefix="mutated-models-"))
    data, predicted = write_measurements(folder), folder / "p.csv"
    for name, options in MODELS.items():
        file = folder / f"{name}.json"
        ended = call(
            "identify", data, "--input", "u", "--output", "y", "--model", name, "--out", file, *(options or ())
        )
        assert ended.code == 0, (name, ended)
        assert call("predict", file, data, "--input", "u", "--out", predicted).code == 0
        found[name] = file.read_text(encoding="utf-8"), predicted.read_text(encoding="utf-8")
    shutil.rmtree(folder)
    return found


def write_measurements(folder: Path) -> Path:
    """Write measurements of a hysteresis; return the file."""
    file = folder / "data.csv"
    rows = (
        f"{0.1 * i},{52 + 20 * math.sin(0.1 * i) * (1 + 0.002 * i)},{math.sin(0.1 * i - 0.3)}" for i in range(200)
    )
    file.write_text("\n".join(["t,u,y", *rows, ""]), encoding="utf-8")
    return file


def try_model(folder: Path, rng: random.Random) -> str:
    """Have a mutated model file predict."""
    name = rng.choice(list(models()))
    text, reference = models()[name]
    file, predicted, data = folder / "model.json", folder / "p.csv", write_measurements(folder)
    # Keys that it does not know are left alone.
    wrong = try_document(
        file, text, rng, lambda: call("predict", file, data, "--input", "u", "--out", predicted).code == 0,
        ("provenance", "initial", "memory", "band", "dynamics", "_kept"), new_keys=False,
    )  # fmt: skip
    if wrong or not predicted.exists():
        return wrong
    template, changed = json.loads(text), json.loads(file.read_text(encoding="utf-8-sig"))
    same = template["model"] == changed["model"] and template.get("initial") == changed.get("initial")
    if same and predicted.read_text(encoding="utf-8") != reference:
        return "the same numbers predict something else"
    if "nan" in predicted.read_text(encoding="utf-8") or "inf" in predicted.read_text(encoding="utf-8"):
        return "predictions are not finite"
    return ""


def try_calibration(folder: Path, rng: random.Random) -> str:
    """Have a rig with a mutated calibration loaded."""
    rig, file = folder / "rig.toml", folder / "c.json"
    rig.write_text(CALIBRATED, encoding="utf-8")
    return try_document(file, json.dumps(CALIBRATION, indent=1), rng, lambda: is_loaded(rig))


def try_tuning(folder: Path, rng: random.Random) -> str:
    """Have a run planned with mutated numbers of controllers."""
    file, model = folder / "tuning.toml", folder / "model.json"
    document = json.loads(models()["preisach"][0])
    document["model"] |= {"input_unit": "°C", "output_unit": "1/m"}
    model.write_text(json.dumps(document), encoding="utf-8")
    words = ["run", "following", "--rig", "vo2", "--dry-run", "--set", f"model={model}", "--set", f"tuning={file}",
             "--set", "controller=open-loop-inverse", "--set", "fallback=open-loop",
             "--set", "low=0", "--set", "high=0.5"]  # fmt: skip
    return try_document(file, toml_of(TUNING), rng, lambda: call(*words).code == 0, ("provenance", "tuning"))


def try_faults(folder: Path, rng: random.Random) -> str:
    """Have a run with a mutated file of faults planned."""
    file = folder / "faults.toml"
    words = ["run", "creep", "--rig", "vo2", "--clock", "virtual", "--dry-run", "--faults", file]
    return try_document(file, toml_of(FAULTS), rng, lambda: call(*words).code == 0, ("values",))


KINDS = {
    "rig": try_rig, "campaign": try_campaign, "model": try_model, "calibration": try_calibration,
    "tuning": try_tuning, "faults": try_faults,
}  # fmt: skip
