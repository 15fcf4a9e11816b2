"""Rules of the whole project that no type checker knows: names, sizes, imports, the map of the packages."""

import ast
import importlib
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[3]
PACKAGES = sorted(path.parent for path in (ROOT / "bench").glob("*/__init__.py"))
FOLDERS = ("bench", "drivers", "sim_devices", "protocols", "rigs")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
LADDER = re.compile(
    r"isinstance\([^()]*(\([^()]*\)[^()]*)*\b"
    r"(Preisach|PrandtlIshlinskii|Polynomial|TwoStage|Summed|Linear|QuadraticTerm|PolynomialTerm|ThermalExpansion)\b"
)
# Names of the rigs, and of their specimens, devices and signals.
OF_A_RIG = re.compile(
    r"\b([Vv][Oo]2|(micro)?cantilever|sma|SMA|nitinol|[Mm]c[Kk]ibben|(artificial )?muscles?|[Hh]ybrid|piezo|psd"
    r"|peltier|tec_\w+|curvature_\w+|supply_voltage|wire_end\w*|load_cell_\w+|displacement_position)\b"
)
WHERE_A_RIG_IS_NAMED = {
    # Executed examples need a rig that is installed.
    "bench/api.py": {"vo2", "tec_temperature"},
    # The title of the paper.
    "bench/control/tracking.py": {"VO2"},
}
MACHINE = re.compile(
    r"/(home|root|tmp|Users|work)/\w|\b(pypi|index)\.[a-z]+\.(org|net|com)/simple|localhost:\d{4}/simple"
)
LONGEST = 700
OPENS_LINES = {("bench.rig", "Rig"), *((library, None) for library in ("serial", "can", "pymodbus", "pyvisa"))}
WHERE_LINES_ARE_OPENED = {
    "bench/batch/campaign/known_rig.py",
    "bench/contracts/emulated.py",
    "bench/contracts/on_a_rig.py",
    "bench/api.py",
    "bench/execution/guardian/__main__.py",
    "bench/execution/guardian/process.py",
    "bench/execution/rehearsal.py",
    "bench/execution/context.py",
    "bench/execution/station/local.py",
}
"""The guardian, and what has a rig in this process; a rig alone connects devices."""


def lines(paths, pattern):
    """Yield path, number and text of the lines in which a pattern is found."""
    for path in paths:
        text = path.read_text(encoding="utf-8")
        if not pattern.search(text):
            continue
        for number, line in enumerate(text.splitlines(), start=1):
            if pattern.search(line):
                yield path.relative_to(ROOT).as_posix(), number, line


def test_what_is_looked_for_is_found():
    assert LADDER.search("if isinstance(model.first, Preisach):")
    assert LADDER.search("isinstance(found(a), int | TwoStage)")
    assert not LADDER.search("isinstance(model, Operator)")
    assert OF_A_RIG.search("reading['tec_temperature']")
    assert OF_A_RIG.search("a VO2 film")
    assert not OF_A_RIG.search("small, plasma, a small prize")
    assert MACHINE.search("wheel from /home/somebody/x")
    assert len(SOURCES) > 150


def test_no_class_of_operator_is_asked_for():
    found = [
        f"{path}:{number}: {line.strip()}"
        for path, number, line in lines(SOURCES, LADDER)
        if not path.startswith("bench/models/")
    ]
    assert not found, "\n".join(found)


def test_the_core_names_no_rig():
    found, used = [], set()
    for path, number, line in lines((path for path in SOURCES if path.is_relative_to(ROOT / "bench")), OF_A_RIG):
        for match in OF_A_RIG.finditer(line):
            if match[0] in WHERE_A_RIG_IS_NAMED.get(path, ()):
                used.add(path)
            else:
                found.append(f"{path}:{number}: {match[0]}: {line.strip()}")
    assert not found, "\n".join(found)
    assert used == WHERE_A_RIG_IS_NAMED.keys()


def test_lines_are_opened_by_the_guardian_and_by_rigs_in_this_process_only():
    opening = set()
    for path in (path for path in SOURCES if path.is_relative_to(ROOT / "bench")):
        text = path.read_text(encoding="utf-8")
        # Parsing takes long, and few modules name these.
        if not any(module in text for module, _ in OPENS_LINES):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom):
                imported = {(node.module, alias.name) for alias in node.names} | {(node.module, None)}
            elif isinstance(node, ast.Import):
                imported = {(alias.name, None) for alias in node.names}
            else:
                continue
            if imported & OPENS_LINES:
                opening.add(path.relative_to(ROOT).as_posix())
    assert opening == WHERE_LINES_ARE_OPENED


def test_what_the_makefile_imports_is_there():
    found = re.findall(r"from (bench[\w.]*) import (\w+)", (ROOT / "Makefile").read_text("utf-8"))
    assert found
    for module, name in found:
        assert hasattr(importlib.import_module(module), name)


def test_no_file_is_long():
    lengths = {path.relative_to(ROOT).as_posix(): len(path.read_text("utf-8").splitlines()) for path in SOURCES}
    assert not {path: length for path, length in lengths.items() if length > LONGEST}


def test_no_modules_import_each_other_in_a_circle():
    graph = grimp.build_graph(*FOLDERS, cache_dir=None, exclude_type_checking_imports=True)
    left = {module: set(graph.find_modules_directly_imported_by(module)) for module in graph.modules}
    # What imports nothing that is left cannot be in a circle.
    while free := {module for module, imported in left.items() if not imported & left.keys()}:
        left = {module: imported for module, imported in left.items() if module not in free}
    assert not left, "\n".join(
        f"{module} imports {', '.join(imported & left.keys())}" for module, imported in left.items()
    )


def test_no_path_of_a_machine_and_no_registry():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a clone of the repository")
    here = Path(__file__).relative_to(ROOT).as_posix()
    paths = [
        ROOT / name for name in listed.stdout.split("\0") if name.endswith((".py", ".toml", ".md", ".txt", "file"))
    ]
    found = [f"{p}:{n}: {line.strip()}" for p, n, line in lines(filter(Path.is_file, paths), MACHINE) if p != here]
    assert not found, "\n".join(found)


def test_the_map_in_contributing_names_the_layers_of_the_tree():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \|.*\| `([\w.]+)` \|$", text, re.MULTILINE)
    layers = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    assert [name for name, _ in rows] == next(each["layers"] for each in layers if each.get("exhaustive"))
    modules = {path.stem for path in (ROOT / "bench").glob("*.py")} - {"__init__"}
    assert {name for name, _ in rows} == {path.name for path in PACKAGES} | modules
    starts = [(ROOT / "bench" / name / start).is_file() for name, start in rows if start.endswith(".py")]
    assert len(starts) == len(PACKAGES)
    assert all(starts)


def test_each_package_says_in_ten_lines_what_it_is_for():
    for folder in PACKAGES:
        package = importlib.import_module(f"bench.{folder.name}")
        assert 1 <= len((package.__doc__ or "").splitlines()) <= 10, folder.name
        assert isinstance(package.__all__, list), folder.name


FRESH = """
import gc, importlib, os, sys
gc.disable()
for name in sys.argv[1:]:
    child = os.fork()
    if not child:
        for loaded in [each for each in sys.modules if each.partition(".")[0] == "bench"]:
            del sys.modules[loaded]
        package = importlib.import_module("bench." + name)
        for public in package.__all__:
            getattr(package, public)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        sys.exit(name)
"""
"""What imports each package in a process that has loaded no other; the libraries are loaded, which takes long."""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_fresh_process_finds_every_public_name(warm_process):
    # With all modules loaded, a name that is none of its module would be found all the same.
    command = [sys.executable, "-c", FRESH, *(folder.name for folder in PACKAGES)]
    done = warm_process(command, ROOT, None)
    assert done.returncode == 0, done.stderr
