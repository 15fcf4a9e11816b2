"""What the tests of several folders share."""

import gc
import json
import os
import select
import shlex
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from bisect import bisect_left
from collections import Counter
from contextlib import closing, contextmanager
from itertools import accumulate, chain, groupby
from pathlib import Path

import pytest
from hypothesis import settings

# Before the folder of the tests is on the path: it has folders of the same names.
import drivers  # noqa: F401
import protocols  # noqa: F401
import rigs  # noqa: F401
import sim_devices  # noqa: F401

sys.path.append(str(Path(__file__).parent / "support"))
from places import SUPPORT
from programs import PROGRAMS, how_to_install, missing
from regression_bands import RECORDED_SEED, beyond_the_bands, options_of
from warm_popen import WarmPopen

# Modules of asserts that tests share.
pytest.register_assert_rewrite("emulated_bench", "short_runs")

# Until all tests are collected: most of what importing their modules makes stays.
gc.disable()

# Before numpy is loaded, and for the processes of the tests too: two workers, each with a thread of BLAS a core,
# wait for one another, and a product of small matrices takes ten times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

# A journal is flushed to the disk at each step: in memory that takes no time. A container may have too little of it.
_MEMORY = Path("/dev/shm")
if _MEMORY.is_dir() and shutil.disk_usage(_MEMORY).free > 4e9:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(_MEMORY))

# A shell that starts the tests in the background has them ignore what some tests send; what is ignored stays so.
signal.signal(signal.SIGINT, signal.default_int_handler)
for _name in ("SIGHUP", "SIGQUIT"):
    if hasattr(signal, _name):
        signal.signal(getattr(signal, _name), signal.SIG_DFL)


# A machine may be busy.
settings.register_profile("whole", deadline=None)
settings.load_profile("whole")
# Chosen by `make test`; `make test-all` looks at all examples.
settings.register_profile("brief", deadline=None)
_BRIEF, _FEWEST = 4, 10
"""What examples are divided by then, and how few there are at least."""
_SETTINGS = "_hypothesis_internal_use_settings"


def _take_fewer_examples(items):
    """Divide the examples of each property: a profile would not reach those that say their number."""
    tests = (getattr(item, "obj", None) for item in items)
    for test in {getattr(test, "__func__", test) for test in tests if hasattr(test, "hypothesis")}:
        own = getattr(test, _SETTINGS, settings.default)
        fewer = max(own.max_examples // _BRIEF, min(own.max_examples, _FEWEST))
        setattr(test, _SETTINGS, settings(own, max_examples=fewer))


def pytest_make_parametrize_id(val):
    """Name long texts by their beginning: each worker sends all names, and one was of 600 kB."""
    return ascii(val[:60]) if isinstance(val, str | bytes) and len(val) > 200 else None


def pytest_collection_finish():
    """Leave what collecting the tests has made out of each further garbage collection: a million objects."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 20, 50)


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop():
    gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Let each worker begin with whole studies: one that came last would leave all workers but its own idle.

    At first, each worker has an equal part of the tests, in their order.
    """
    if config.getoption("hypothesis_profile") == "brief":
        _take_fewer_examples(items)
    studies = [item for item in items if getattr(item, "originalname", "") == "test_campaign"]
    for study in studies:
        # Two minutes on an idle machine; a busy one may take its time.
        study.add_marker(pytest.mark.timeout(1800))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    modules = [list(group) for _, group in groupby((i for i in items if i not in studies), lambda i: i.path)]
    ends = list(accumulate(map(len, modules)))
    # Between two modules, so that the fixtures of a module are made once.
    places = [bisect_left(ends, worker * len(items) / workers) for worker in range(workers)]
    for worker in reversed(range(workers)):
        modules.insert(places[worker] + (worker > 0), studies[worker::workers])
    items[:] = chain.from_iterable(modules)


def pytest_addoption(parser):
    parser.addoption("--no-skips", action="store_true", help="fail if a test is skipped")


class Skips:
    """What the tests that were skipped lack: the last line of a run, and its exit code with `--no-skips`."""

    def __init__(self):
        self.reasons = Counter()

    def pytest_runtest_logreport(self, report):
        if report.skipped and not hasattr(report, "wasxfail"):
            self.reasons[report.longrepr[2].removeprefix("Skipped: ")] += 1

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session):
        if self.reasons and session.config.getoption("no_skips") and not session.exitstatus:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    @pytest.hookimpl(trylast=True)
    def pytest_unconfigure(self):
        if self.reasons:
            lacking = {name: program for name, program in missing().items() if _reason(name) in self.reasons}
            skipped = ", ".join(f"{count} ({reason})" for reason, count in sorted(self.reasons.items()))
            print(f"skipped: {skipped}." + (f" To run them: {how_to_install(lacking)}" if lacking else ""))


def pytest_configure(config):
    # The process that reports, which with several workers runs no test itself.
    if "PYTEST_XDIST_WORKER" not in os.environ:
        config.pluginmanager.register(Skips())


def _reason(name):
    return f"needs the Debian package {PROGRAMS[name].packages.replace(' ', ' and ')}"


def _installed(name):
    """Return the path of a program; skip the test if it is not installed."""
    if (path := PROGRAMS[name].find()) is None:
        pytest.skip(_reason(name))
    return path


@pytest.fixture(scope="session")
def mbpoll():
    """Call mbpoll, an independent Modbus client; return the completed process."""
    program = _installed("mbpoll")

    def call(*arguments):
        command = [program, *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)

    return call


@pytest.fixture(scope="session")
def gcc():
    """A compiler of C, by its path."""
    return _installed("gcc")


@pytest.fixture(scope="session")
def clang():
    """Another compiler of C, by its path."""
    return _installed("clang")


@pytest.fixture(scope="session")
def arm_gcc():
    """A compiler for microcontrollers, by its path."""
    return _installed("arm-none-eabi-gcc")


@pytest.fixture(scope="session")
def valgrind():
    """A counter of instructions, by its path."""
    return _installed("valgrind")


@pytest.fixture(scope="session")
def vulkan():
    """A Vulkan driver, with which Rerun's viewer draws without a screen."""
    return _installed("vulkan")


# While playwright is open, the thread has an event loop, and other modules start their own.
@pytest.fixture(scope="module")
def browser():
    """Chromium, which draws by the processor."""
    program = _installed("chromium")
    from playwright.sync_api import sync_playwright

    options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with sync_playwright() as tools:
        opened = tools.chromium.launch(executable_path=program, args=options)
        yield opened
        opened.close()


@contextmanager
def _pseudo_terminal(server):
    import tty

    master, slave = os.openpty()
    wake, waker = os.pipe()
    # Raw at both ends before anybody opens it; and this slave stays open, as otherwise a client that closes its
    # own makes reads from the master fail.
    tty.setraw(master)
    tty.setraw(slave)

    def serve():
        while wake not in select.select([master, wake], [], [])[0]:
            # In two pieces, as a line may deliver them.
            reply = server.receive(os.read(master, 4096))
            os.write(master, reply[:4])
            os.write(master, reply[4:])

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        os.write(waker, b"x")
        thread.join()
        for end in (master, slave, wake, waker):
            os.close(end)


@pytest.fixture(scope="session")
def pseudo_terminal():
    """Serve an instrument at the path that this context manager gives; afterwards it is gone."""
    return _pseudo_terminal


@pytest.fixture(scope="session")
def finished_process():
    """Run a command in a folder and an environment to its end; return the completed process."""

    def run(command, folder, environment):
        return subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=240, check=False
        )

    return run


@pytest.fixture(scope="session")
def warm_start(tmp_path_factory):
    """Return the socket of a process that starts Python programs as forks of it; None where it cannot watch them.

    All workers use the same process. It ends when the last of them has closed the pipe.
    """
    if not (hasattr(os, "fork") and hasattr(os, "pidfd_open")):
        yield None
        return
    import fcntl

    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    pipe, path = folder / "warm.pipe", folder / "warm.socket"
    with (folder / "warm.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not pipe.exists():
            os.mkfifo(pipe)
        try:
            held = os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:
            # Nobody reads it.
            end = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
            held = os.open(pipe, os.O_WRONLY)
            path.unlink(missing_ok=True)
            command = [sys.executable, "-P", str(SUPPORT / "warm_start.py"), str(path)]
            # Returns when the process is ready.
            subprocess.run(command, stdin=end, check=True)
            os.close(end)
    yield path
    os.close(held)


@pytest.fixture(scope="session")
def warmly(warm_start):
    """Start the Python programs of this process as forks, within a context."""

    @contextmanager
    def patched():
        derived = {}
        with pytest.MonkeyPatch.context() as patch:
            if warm_start is not None:
                patch.setattr(WarmPopen, "server", warm_start)
                # Such as the worker processes of a study.
                derived = {each: each.__bases__ for each in {*subprocess.Popen.__subclasses__()} - {WarmPopen}}
                patch.setattr(subprocess, "Popen", WarmPopen)
            try:
                for each in derived:
                    each.__bases__ = (WarmPopen,)
                yield
            finally:
                for each, bases in derived.items():
                    each.__bases__ = bases

    return patched


@pytest.fixture(scope="module")
def warm_popen(warmly):
    """Start the Python programs of this process as forks, where a cold start is not what is tested."""
    with warmly():
        yield


@pytest.fixture(scope="module")
def warm_process(finished_process, warm_popen):
    """Do as `finished_process`, warm."""
    return finished_process


@pytest.fixture(scope="session")
def warm_commands(warm_start, tmp_path_factory):
    """Return a folder with commands `bench` and `python`, to be found first: `warm_process` for a shell."""
    folder = tmp_path_factory.mktemp("commands")
    if warm_start is not None:
        for name in ("bench", "python"):
            command = [sys.executable, "-SE", str(SUPPORT / "warm_client.py"), str(warm_start), name]
            (folder / name).write_text(f'#!/bin/sh\nexec {shlex.join(command)} "$@"\n')
            (folder / name).chmod(0o755)
    return folder


@pytest.fixture
def terminal():
    """Start `bench` with arguments at a terminal of 40 lines; what is left is ended with the test."""
    pexpect = pytest.importorskip("pexpect")
    started = []

    def begin(*arguments, columns, env, **settings):
        # These overrule the size of the terminal, and some shells export them.
        env = {name: value for name, value in env.items() if name not in {"COLUMNS", "LINES"}}
        child = pexpect.spawn(
            sys.executable,
            ["-m", "bench", *map(str, arguments)],
            encoding="utf-8",
            timeout=90,
            dimensions=(40, columns),
            env=env,
            **settings,
        )
        started.append(child)
        return child

    yield begin
    for child in started:
        child.close(force=True)


@pytest.fixture
def bench(capsys):
    """Run a command in this process; return exit code, standard output and standard error.

    Without the line of a first use, which depends on what ran before on this machine.
    """
    from bench.base.compilation_display import MESSAGE
    from bench.cli import main

    def run(*arguments):
        with pytest.raises(SystemExit) as stopped:
            main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return stopped.value.code or 0, captured.out, captured.err.replace(f"{MESSAGE}\n", "")

    return run


@pytest.fixture
def reproduce(bench, tmp_path):
    """Run a study with a seed in `tmp_path`, without complaint; return its standard output and its result.

    The numbers of a short one are compared with what was recorded.
    """
    from kernels import OWN

    from bench.base import kernels_of
    from bench.base.registry import load
    from bench.identification import models_among
    from bench.record import Record

    def loaded():
        return {kernel.py_func for kernel in kernels_of(OWN) if kernel.overloads}

    def run(study, seed, *, is_short=False):
        result, before = tmp_path / "result.json", loaded()
        # One worker: the tests themselves go on beside each other.
        code, out, err = bench(
            "study", study, "--seed", seed, "--workers", 1, "--out", tmp_path, "--json", result,
            *(options_of(study) if is_short else ()),
        )  # fmt: skip
        assert code == 0
        assert err == ""
        *_, time, following = out.splitlines()
        assert (time[:6], following[:12]) == ("time: ", "next: `bench")
        assert [line for line in out.splitlines() if len(line) > 80 and "note: " not in line] in ([], [following])
        # They are compiled before worker processes start, which would compile any other one once more each.
        named = {kernel.py_func for kernel in kernels_of(load("studies", study).all_kernels)}
        assert {kernel.__module__ for kernel in loaded() - before - named} == set()
        campaign = json.loads(result.read_text())
        assert campaign["seed"] == seed
        assert all(Path(path).stat().st_size > 1000 for path in campaign["figures"] + campaign["recordings"])
        if is_short:
            assert seed == RECORDED_SEED
            assert not beyond_the_bands(study, campaign)
        for path in Path(campaign["folder"]).rglob("journal.sqlite"):
            with Record(path) as record:
                # A model that was given to a run is among its files; beside it are those identified from it.
                if (given := record.meta["parameters"].get("model")) is not None:
                    assert models_among(record.files(), str(path))["model"].name == Path(given).stem
                    assert not record.models()
        return out, campaign

    return run


@pytest.fixture
def edit_journal():
    """Change the journal of a run by SQL, as if it had been written so."""
    from bench.record.rows import checksum

    def edit(path, *statements):
        with closing(sqlite3.connect(path)) as db, db:
            for statement in statements:
                db.execute(statement)
            for table in ("meta", "signals", "steps", "telemetry", "events"):
                rows = db.execute(f"SELECT * FROM {table}").fetchall()
                key = db.execute(f"SELECT * FROM {table} LIMIT 0").description[0][0]
                renewed = [(checksum(row[:-1]), row[0]) for row in rows]
                db.executemany(f"UPDATE {table} SET checksum = ? WHERE {key} = ?", renewed)

    return edit


@pytest.fixture
def rig_file(tmp_path):
    """Write a rig file: the heater's, with replacements and an appendix."""

    # Rig files of these tests name their drivers as `heater_laboratory:HeaterTEC`.
    from heater_laboratory import RIG

    def write(*replacements, append="", text=RIG):
        for old, new in replacements:
            assert old in text, old
            text = text.replace(old, new)
        path = tmp_path / "heater.toml"
        path.write_text(text + append, encoding="utf-8")
        return str(path)

    return write
