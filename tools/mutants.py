"""Mutants of the code that moves hardware: how many of them do the tests kill?

One operator, number or call of a module is changed at a time, and those tests are run that execute the changed line.
A mutant that no test notices is a gap in the tests, or an equivalent program. Compiled kernels are left out, as
numba's cache does not see the change; they are compared with brute-force oracles.

    python tools/mutants.py --sample 200          # a sample over all modules
    python tools/mutants.py bench/control/tracking.py

Those of a line that is executed when the module is loaded, such as a constant, may be killed by any test that
executes a line of the module or has its name, and by the tests of all settings and values. A mutant counts as
killed if a test fails or does not end within a minute; the latter are listed, as a busy machine can be the reason.
The sample is drawn with a seed. Needs POSIX, as each mutant is a fork of a process that has loaded the libraries.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib.abc
import importlib.util
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = ("bench/control", "bench/execution/engine.py", "bench/record", "drivers")
TESTS = ("tests/unit", "tests/contract", "tests/wire/drivers", "tests/system/test_cli.py")
TABLES = ("tests/contract/test_settings.py", "tests/contract/test_values.py")
MOST_TESTS, MOST_SECONDS = 600, 40.0
_TIMEOUT = 60.0  # s of one test
_NOT_LOADED = 99
COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
OPERATIONS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult}


@dataclass(frozen=True)
class Mutant:
    """One change: the file, the line, the number of the change in the file, and what it is.

    `first` is the first line of its statement, 0 if it is executed when the module is loaded.
    """

    file: str
    line: int
    first: int
    number: int
    what: str


class Mutator(ast.NodeTransformer):
    """Counts the possible changes of a module, and makes that of one number."""

    def __init__(self, wanted: int | None = None) -> None:
        self.wanted, self.count, self.found = wanted, 0, []
        self.depth = self.first = 0

    def visit(self, node):
        if self.depth and isinstance(node, ast.stmt):
            self.first = node.lineno
        return super().visit(node)

    def _change(self, node: ast.AST, what: str, make) -> ast.AST:
        number, self.count = self.count, self.count + 1
        self.found.append((node.lineno, self.first if self.depth else 0, number, what))
        return ast.copy_location(make(), node) if number == self.wanted else node

    def visit_FunctionDef(self, node):
        # Annotations, decorators and docstrings are not what a program does.
        self.depth += 1
        node.body = [self.visit(each) for each in node.body]
        self.depth -= 1
        return node

    def visit_AnnAssign(self, node):
        if node.value is not None:
            node.value = self.visit(node.value)
        return node

    def visit_Compare(self, node):
        self.generic_visit(node)
        if len(node.ops) == 1 and type(node.ops[0]) in COMPARISONS:
            other = COMPARISONS[type(node.ops[0])]
            what = f"{type(node.ops[0]).__name__} to {other.__name__}"
            return self._change(node, what, lambda: ast.Compare(node.left, [other()], node.comparators))
        return node

    def visit_BoolOp(self, node):
        self.generic_visit(node)
        other = ast.Or if isinstance(node.op, ast.And) else ast.And
        return self._change(node, f"to {other.__name__}", lambda: ast.BoolOp(other(), node.values))

    def visit_UnaryOp(self, node):
        self.generic_visit(node)
        if isinstance(node.op, ast.Not):
            return self._change(node, "not left out", lambda: node.operand)
        return node

    def visit_BinOp(self, node):
        self.generic_visit(node)
        if type(node.op) in OPERATIONS and not isinstance(node.left, ast.Constant | ast.JoinedStr):
            other = OPERATIONS[type(node.op)]
            what = f"{type(node.op).__name__} to {other.__name__}"
            return self._change(node, what, lambda: ast.BinOp(node.left, other(), node.right))
        return node

    def visit_Constant(self, node):
        if isinstance(node.value, bool):
            return self._change(node, f"{node.value} to {not node.value}", lambda: ast.Constant(not node.value))
        if isinstance(node.value, int | float):
            # One more is the same float, if it is large.
            other = node.value + 1 if node.value + 1 != node.value else 2 * node.value
            return self._change(node, f"{node.value} to {other}", lambda: ast.Constant(other))
        return node

    def visit_JoinedStr(self, node):
        # The wording of messages is not counted.
        return node

    def visit_Raise(self, node):
        return self._change(node, "raise left out", ast.Pass)

    def visit_Expr(self, node):
        self.generic_visit(node)
        if isinstance(node.value, ast.Call):
            return self._change(node, "call left out", ast.Pass)
        return node

    def visit_If(self, node):
        self.generic_visit(node)
        if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return node
        if isinstance(node.test, ast.Name | ast.Call | ast.Attribute):
            return self._change(
                node, "if turned", lambda: ast.If(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
            )
        return node


def mutants_of(file: str) -> Iterator[Mutant]:
    mutator = Mutator()
    mutator.visit(ast.parse((ROOT / file).read_text(encoding="utf-8")))
    return (Mutant(file, *found) for found in mutator.found)


def code_of(mutant: Mutant):
    tree = ast.parse((ROOT / mutant.file).read_text(encoding="utf-8"))
    changed = ast.fix_missing_locations(Mutator(mutant.number).visit(copy.deepcopy(tree)))
    return compile(changed, str(ROOT / mutant.file), "exec")


class Loader(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Gives the changed code in place of one module."""

    def __init__(self, mutant: Mutant) -> None:
        self.name = mutant.file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        self.mutant = mutant
        self.used = False

    def find_spec(self, name, path, target=None):  # noqa: ARG002 - as importlib calls it
        if name != self.name:
            return None
        file = ROOT / self.mutant.file
        inner = [str(file.parent)] if file.name == "__init__.py" else None
        return importlib.util.spec_from_file_location(name, file, loader=self, submodule_search_locations=inner)

    def exec_module(self, module):
        self.used = True
        exec(code_of(self.mutant), module.__dict__)


class Contexts:
    """A pytest plugin that notes which test executes which line, and how long each test takes."""

    def __init__(self, coverage) -> None:
        self.coverage, self.seconds = coverage, defaultdict(float)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.coverage.switch_context(item.nodeid)
        return (yield)

    def pytest_runtest_logreport(self, report):
        self.seconds[report.nodeid] += report.duration
        if report.failed:
            self.seconds[report.nodeid] = float("inf")


def measure(files: list[str], tests: list[str], out: Path) -> None:
    """Run the tests once, and write which of them execute which line: `out` as JSON."""
    import coverage

    measured = coverage.Coverage(data_file=None, include=[str(ROOT / file) for file in files], config_file=False)
    plugin = Contexts(measured)
    measured.start()
    arguments = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not slow and not benchmark and not seeds"]
    pytest.main([*arguments, f"--timeout={_TIMEOUT}", *tests], [plugin])
    measured.stop()
    lines = {}
    for file in measured.get_data().measured_files():
        contexts = measured.get_data().contexts_by_lineno(file)
        lines[str(Path(file).relative_to(ROOT))] = {
            line: [test for test in found if plugin.seconds.get(test, float("inf")) < 20.0]
            for line, found in contexts.items()
        }
    out.write_text(json.dumps({"lines": lines, "seconds": plugin.seconds}))


def forked(work, timeout: float) -> int | None:
    """Return the exit status of a function in a process of its own; None if it did not end in time."""
    child = os.fork()
    if child == 0:
        os.setsid()
        silent = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(silent, stream)
        try:
            status = work()
        except BaseException:
            status = 1
        os._exit(int(status))
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def judge(mutant: Mutant, known: dict, folder: Path) -> str:
    """Return `killed`, `did not end`, `survived`, `not executed`, or `not loaded`: the module was unchanged."""
    lines = known["lines"].get(mutant.file, {})
    # Of a statement on several lines, the constants may be loaded on the first one.
    found = set(lines.get(str(mutant.line)) or lines.get(str(mutant.first), []))
    own = tuple(f"test_{part}.py" for part in Path(mutant.file).with_suffix("").parts[1:])
    at_loading = not mutant.first or (not found and str(mutant.line) in lines)
    if at_loading:
        found = {test for tests in lines.values() for test in tests}
        found |= {test for test in known["seconds"] if any(each in test for each in (*own, *TABLES))}
    tests, total = [], 0.0

    def order(test: str) -> tuple[bool, bool, float]:
        """Put those of the module or its package first, then the quick ones."""
        is_table = at_loading and test.startswith(TABLES)
        return not is_table, not any(each in test for each in own), known["seconds"][test]

    for test in sorted(found, key=order):
        total += known["seconds"][test]
        if len(tests) == MOST_TESTS or (tests and total > MOST_SECONDS):
            break
        tests.append(test)
    if not tests:
        return "not executed"

    def run() -> int:
        loader = Loader(mutant)
        sys.meta_path.insert(0, loader)
        os.environ["PYTEST_DEBUG_TEMPROOT"] = str(folder)
        # Plain assertions: the loader of pytest that rewrites them would take modules of an installed package, too.
        options = ("-x", "-q", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:xdist")
        status = pytest.main([*options, f"--timeout={_TIMEOUT}", *tests])
        return status if loader.used else _NOT_LOADED

    started = time.monotonic()
    status = forked(run, _TIMEOUT + 10.0 * total)
    if status in (0, _NOT_LOADED):
        return "not loaded" if status else "survived"
    return "did not end" if time.monotonic() - started >= _TIMEOUT else "killed"


def killed(counts: Counter[str]) -> int:
    return counts["killed"] + counts["did not end"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=MODULES, help="files or folders below the root")
    parser.add_argument("--tests", nargs="*", default=TESTS, help="tests that may kill them")
    parser.add_argument("--sample", type=int, default=0, help="mutants to try, drawn at random; 0 for all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--known", type=Path, help="JSON of an earlier run: which test executes which line")
    parser.add_argument("--survivors", type=Path, help="file for the list of mutants that no test failed for")
    given = parser.parse_args()
    os.chdir(ROOT)
    # The folders of the tests have the names of the packages that they test.
    sys.path[0] = str(ROOT)
    files = sorted(
        str(path)
        for module in given.modules
        for path in ([Path(module)] if module.endswith(".py") else Path(module).rglob("*.py"))
        if "kernels" not in path.name
    )
    every = [mutant for file in files for mutant in mutants_of(file)]
    chosen = random.Random(given.seed).sample(every, given.sample) if given.sample else every
    print(f"{len(every)} mutants of {len(files)} modules, {len(chosen)} tried", flush=True)
    # What takes long to load is loaded once, before the forks.
    for library in ("numpy", "scipy.optimize", "numba", "pydantic", "typer", "rich.table", "pymodbus"):
        importlib.import_module(library)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        known_file = given.known or folder / "known.json"
        if not known_file.exists():
            if importlib.util.find_spec("coverage") is None:
                sys.exit("coverage is not installed; `make mutants` installs it, or give --known")
            print("which test executes which line ...", flush=True)
            forked(lambda: measure(files, list(given.tests), known_file) or 0, 3600.0)
            if not known_file.exists():
                sys.exit("the tests could not be run; try them alone first")
        known = json.loads(known_file.read_text())
        started, counts, listed = time.monotonic(), Counter(), []
        with ThreadPoolExecutor(given.workers) as pool:
            verdicts = pool.map(lambda mutant: (mutant, judge(mutant, known, folder)), chosen)
            for done, (mutant, verdict) in enumerate(verdicts, 1):
                counts[verdict] += 1
                if verdict != "killed":
                    listed.append(f"{mutant.file}:{mutant.line}: {mutant.what}: {verdict}")
                    print(listed[-1], flush=True)
                if done % 20 == 0:
                    left = (time.monotonic() - started) / done * (len(chosen) - done)
                    print(f"{done} of {len(chosen)}, {killed(counts)} killed, {left / 60:.0f} min left", flush=True)
    if given.survivors:
        given.survivors.write_text("\n".join(listed) + "\n")
    share = killed(counts) / len(chosen)
    print(f"killed {killed(counts)} of {len(chosen)} ({share:.1%}); {dict(counts)}")
    sys.exit(0 if share >= 0.9 else 1)


if __name__ == "__main__":
    main()
