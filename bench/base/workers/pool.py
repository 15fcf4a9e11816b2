"""Tasks on several cores: worker processes, each with a thread of this process that serves it."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import partial
from types import FrameType, TracebackType
from typing import Any, ParamSpec, Self, TypeVar

from rich.console import Console

from bench.base.errors import AbortError, BenchError
from bench.base.interrupts import signal_name
from bench.base.printing import PlainConsole
from bench.base.workers.display import TasksDisplay
from bench.base.workers.messages import Progress, Result, Welcome, Words, receive, send
from bench.base.workers.task import COLLECTIONS, task_surroundings

P = ParamSpec("P")
T = TypeVar("T")

ATTEMPTS = 3
"""How often a task is begun whose worker process dies."""

_UNFINISHED = 40.0
"""Wall-clock time for the end of a worker process, s; a run ends in the safe state, or leaves within less."""

_LOOK = 0.5
"""Longest wait, s, during which Windows would not hear Ctrl-C."""

_ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")

_ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Pending(Future[T]):
    """The result of a task, sooner or later.

    Its `exception()` and its `result()`, which raises that, wait for the task. It is a BenchError if the task ended
    its worker process as often as it was begun.
    """

    def __init__(self, workers: Workers, name: str, call: partial[T]) -> None:
        super().__init__()
        self.name = name
        self._workers = workers
        self._call = call
        self._order = b""
        self._was_asked = False

    def hurry(self) -> None:
        """Have the task begun before all others that wait, as others depend on its result."""
        self._workers._put_first(self)

    def result(self, timeout: float | None = None) -> T:
        """Wait for the task; return what it returned, raise what it raised."""
        self._workers.wait_for([self])
        self._was_asked = True
        return super().result(timeout)

    def exception(self, timeout: float | None = None) -> BaseException | None:
        """Wait for the task; return what it raised, or None."""
        self._workers.wait_for([self])
        self._was_asked = True
        return super().exception(timeout)


class Workers:
    """Carries tasks out in worker processes, or one after another in this process if it is one worker.

    Use it as a context manager. Its end waits for all tasks, and raises what one raised whose result nobody has
    taken. If the block is left by an exception, tasks that are not finished are ended, runs in their safe state; no
    process is left behind. Ctrl-C and the signals that end a process raise AbortError in the block.

    A task is a function of a module with arguments and a result that can be pickled. What it prints on
    `bench.base.task_console()` appears on the console. Its results are the same bit for bit whatever the number
    of workers, as each has one thread of BLAS; the order in which they are taken is the caller's. A task whose worker
    process dies is done again; a task during which three die fails.

    Parameters
    ----------
    number : int, optional
        Number of workers; as many as there are cores if not given. With 1 a task is carried out in this process
        when its result, or the end, is waited for.
    console : Console, optional
        Where to print and to draw the progress; without it nothing is shown.
    title : str
        What the tasks are together, for the progress.
    kernels : tuple of str
        Packages whose kernels the tasks take, see `bench.base.compiled.kernels_of`. They are compiled in this process
        before a worker process is started, which would compile them once more.
    """

    def __init__(
        self,
        number: int | None = None,
        console: Console | None = None,
        title: str = "all",
        kernels: tuple[str, ...] = (),
    ) -> None:
        self.number = available_cores() if number is None else number
        self.in_process = self.number == 1
        self._console = PlainConsole(quiet=True) if console is None else console
        self._display = TasksDisplay(self._console, title)
        self._kernels = kernels
        self._changed = threading.Condition()
        self._tasks: list[Pending[Any]] = []
        self._waiting: deque[Pending[Any]] = deque()
        # A job carries out the task that is first in the queue when the job starts.
        self._threads = ThreadPoolExecutor(self.number, "worker")
        self._own = threading.local()
        self._processes: set[_Worker] = set()
        self._is_closing = False
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for name in _ENDING:
                # What is ignored stays so: `nohup bench …` outlives its terminal.
                if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:
                    former = signal.signal(getattr(signal, name), self._interrupt)
                    self._stack.callback(signal.signal, getattr(signal, name), former)
        self._stack.enter_context(_one_thread())
        if self.in_process:
            self._stack.callback(gc.set_threshold, *gc.get_threshold())
            gc.set_threshold(*COLLECTIONS)
            self._stack.enter_context(task_surroundings(self._console, None))
        else:
            self._compile()
            self._display.start()
            self._stack.callback(self._display.stop)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            try:
                if kind is None:
                    for task in self._tasks:
                        self.wait_for([task])
                        if not task._was_asked:
                            task.result()
            finally:
                self._close()

    def _compile(self) -> None:
        if self._kernels:
            # Here, as numba is slow to load.
            from bench.base.compilation_display import compile_kernels

            compile_kernels(self._kernels, self._console)

    def submit(self, name: str, function: Callable[P, T], *arguments: P.args, **keywords: P.kwargs) -> Pending[T]:
        """Have a function called.

        Parameters
        ----------
        name : str
            Name of the task, for the progress and for messages.
        function : callable
            A function of a module.
        arguments, keywords
            For the function; can be pickled.

        Raises
        ------
        TypeError, AttributeError, pickle.PicklingError
            If function or arguments cannot be sent to a worker process.
        """
        task = Pending(self, name, partial(function, *arguments, **keywords))
        if not self.in_process:
            if getattr(function, "__module__", "") == "__main__":
                raise TypeError(f"{name}: a worker process cannot import {function!r}; put it into a module")
            # Pickled apart from its message: a worker may be unable to read it.
            task._order = pickle.dumps(task._call)
        with self._changed:
            self._tasks.append(task)
            self._waiting.append(task)
        self._display.add()
        if not self.in_process:
            self._threads.submit(self._carry_out_first)
        return task

    def wait_for(self, tasks: Collection[Pending[T]]) -> Pending[T]:
        """Wait until one of some tasks is finished, and return it."""
        while True:
            with self._changed:
                while (done := next((task for task in tasks if task.done()), None)) is None and not self.in_process:
                    self._changed.wait(_LOOK)
            if done is not None:
                return done
            self._carry_out_here(self._waiting.popleft())

    def _put_first(self, task: Pending[Any]) -> None:
        with self._changed:
            if task in self._waiting:
                self._waiting.remove(task)
                self._waiting.appendleft(task)

    def _carry_out_here(self, task: Pending[Any]) -> None:
        try:
            task.set_result(task._call())
        except AbortError:
            raise
        except Exception as error:
            task.set_exception(error)

    def _carry_out_first(self) -> None:
        """Have the worker process of this thread carry out the first task that waits; another one if it dies."""
        with self._changed:
            task = self._waiting.popleft()
        line = self._display.begin(task.name)
        cause = ""
        for _ in range(ATTEMPTS):
            try:
                worker = self._own_worker()
                result = worker.carry_out(task._order, partial(self._display.advance, line), self._display.say)
                break
            except (EOFError, OSError) as death:
                if self._is_closing:
                    return
                cause = self._mourn() or str(death)
        else:
            error = BenchError(f"{task.name}: its worker process died {ATTEMPTS} times, the last time by {cause}")
            result = Result(pickle.dumps(error), is_error=True)
        try:
            content = pickle.loads(result.content)  # noqa: S301 - from our own process
        except Exception as error:
            result, content = Result(b"", is_error=True), error
        if result.is_error:
            task.set_exception(content)
        else:
            task.set_result(content)
        self._display.end(line)
        with self._changed:
            self._changed.notify_all()

    def _own_worker(self) -> _Worker:
        """Return the worker process of this thread."""
        with self._changed:
            # After the end has begun nobody would end it.
            if self._is_closing:
                raise EOFError
            if not hasattr(self._own, "worker"):
                self._own.worker = _Worker(Welcome(sys.argv, self._console.width))
                self._processes.add(self._own.worker)
        worker: _Worker = self._own.worker
        return worker

    def _mourn(self) -> str:
        """Forget the worker process of this thread; return what ended it, or nothing if it could not be started."""
        worker: _Worker | None = vars(self._own).pop("worker", None)
        if worker is None:
            return ""
        self._processes.discard(worker)
        return worker.cause_of_death()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 - signal's form
        if self._is_closing:
            for process in list(self._processes):
                process.kill()
            return
        reason = "Ctrl-C" if number == signal.SIGINT else signal_name(number)
        raise AbortError(f"ended by {reason}")

    def _close(self) -> None:
        """End all worker processes, and wait for their ends."""
        with self._changed:
            self._is_closing = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        processes = list(self._processes)
        for process in processes:
            process.hang_up()
        for process in processes:
            try:
                process.wait(_UNFINISHED)
            except subprocess.TimeoutExpired:
                process.kill()
        self._threads.shutdown()
        for process in processes:
            process.cause_of_death()
        self._processes.clear()


def _one_thread() -> AbstractContextManager[object]:
    """Return a context in which BLAS has one thread here too: sums differ in their last bits with their number."""
    # The limit is for the libraries that are loaded.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    limit: AbstractContextManager[object] = threadpool_limits(limits=1)
    return limit


class _Worker(subprocess.Popen[bytes]):
    """One worker process.

    Parameters
    ----------
    welcome : Welcome
        What it has to know.
    """

    def __init__(self, welcome: Welcome) -> None:
        # The modules of the tasks have to be found as here; -P keeps the working folder out of the way of ours.
        path = os.pathsep.join(entry for entry in sys.path if entry)
        # The terminal's signals are for this process, which ends the others.
        group: dict[str, Any] = {"process_group": 0}
        if sys.platform == "win32":
            group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        super().__init__(
            [sys.executable, "-P", "-m", "bench.base.workers"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD, "PYTHONPATH": path},
            **group,
        )
        assert self.stdin is not None
        assert self.stdout is not None
        self._orders, self._results = self.stdin, self.stdout
        with suppress(OSError):
            send(self._orders, welcome)

    def carry_out(
        self, order: bytes, advance: Callable[[int, int | None, str], None], say: Callable[[str], None]
    ) -> Result:
        """Return the result of a task; until then, hand on how far it is and what it says.

        Raises EOFError or OSError if the process is gone.
        """
        send(self._orders, order)
        while not isinstance(message := receive(self._results), Result):
            if isinstance(message, Progress):
                advance(message.completed, message.total, message.text)
            elif isinstance(message, Words):
                say(message.text)
        return message

    def hang_up(self) -> None:
        """Close its standard input, which asks it to end."""
        with suppress(OSError, ValueError):
            self._orders.close()

    def cause_of_death(self) -> str:
        """Wait for the end of the process, and close the pipes; return what ended it."""
        self.hang_up()
        code = self.wait()
        self._results.close()
        return f"exit code {code}" if code >= 0 else signal_name(-code)
