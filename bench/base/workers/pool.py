"""Tasks on several cores: worker processes, each with a thread of this process that serves it."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from functools import partial
from types import FrameType, TracebackType
from typing import Any, Generic, ParamSpec, Self, TypeVar

from rich.console import Console

from bench.base.errors import AbortError, BenchError
from bench.base.workers.display import TasksDisplay
from bench.base.workers.messages import Order, Progress, Result, Welcome, Words, receive, send
from bench.base.workers.task import collecting_seldom, task_surroundings

P = ParamSpec("P")
T = TypeVar("T")

ATTEMPTS = 3
"""How often a task is begun whose worker process dies."""

_UNFINISHED = 40.0
"""Wall-clock time for the end of a worker process, s; a run ends in the safe state, or leaves within less."""

_LOOK = 0.5
"""Longest wait, s, during which Windows would not hear Ctrl-C."""

_WORTH_LOADING = 8
"""Tasks aside from which on a worker loads what they take, although another one has."""

_AT_ONCE = 2
"""Worker processes that are started before there is a task: work for several cores has two tasks at least."""

_ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")

_ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Pending(Generic[T]):
    """The result of a task, sooner or later."""

    def __init__(
        self,
        workers: Workers,
        number: int,
        name: str,
        call: Callable[[], T],
        order: Order | None,
        queue: deque[Pending[Any]],
    ) -> None:
        self.name = name
        self._workers = workers
        self._number = number
        self._call = call
        self._order = order
        self._queue = queue
        self._deaths = 0
        self._is_done = False
        self._was_asked = False
        self._value: T | None = None
        self._error: Exception | None = None

    @property
    def done(self) -> bool:
        """Whether the task is finished."""
        return self._is_done

    @property
    def error(self) -> Exception | None:
        """What the task raised; None if it has not, or is not finished."""
        self._was_asked |= self._is_done
        return self._error

    def hurry(self) -> None:
        """Have the task begun before all others of its kind that wait, as others depend on its result."""
        self._workers._put_first(self)

    def result(self) -> T:
        """Wait for the task; return what it returned, raise what it raised.

        Raises BenchError if it ended its worker process as often as it was begun.
        """
        self._workers._wait_for(self)
        if self.error is not None:
            raise self.error
        return self._value  # type: ignore[return-value]  # what the task returned, which may be None


class Workers:
    """Carries tasks out in worker processes, or one after another in this process if it is one worker.

    Use it as a context manager. Its end waits for all tasks, and raises what one raised whose result nobody has
    taken. If the block is left by an exception, tasks that are not finished are ended, runs in their safe state; no
    process is left behind. Ctrl-C and the signals that end a process raise AbortError in the block.

    A task is a function of a module with arguments and a result that can be pickled. What it prints on
    `bench.base.task_console()` appears on the console. Its results are the same bit for bit whatever the number
    of workers, as each has one thread of BLAS; the order in which they are taken is the caller's. A task whose worker
    process dies is done again; a task during which three die fails.

    The first two worker processes are started at once, any other when a task finds none that is free. They live until
    the end.

    Parameters
    ----------
    number : int, optional
        Number of workers; as many as there are cores if not given. With 1 a task is carried out in this process
        when its result, or the end, is waited for.
    console : Console, optional
        Where to print and to draw the progress; without it nothing is shown.
    title : str
        What the tasks are together, for the progress.
    modules : tuple of str
        Modules that the tasks take. A worker process loads them before its first task, the first ones beside what
        this process loads.
    aside : tuple of str
        Modules that the tasks aside take. The worker that has these in front loads them when it has nothing else to
        do.
    kernels : tuple of str
        Packages whose kernels the tasks take, see `bench.base.compiled.kernels_of`. They are compiled in this process
        before a worker process is started, which would compile them once more.
    """

    def __init__(
        self,
        number: int | None = None,
        console: Console | None = None,
        title: str = "all",
        modules: tuple[str, ...] = (),
        aside: tuple[str, ...] = (),
        kernels: tuple[str, ...] = (),
    ) -> None:
        self.number = available_cores() if number is None else number
        self.in_process = self.number == 1
        self._console = Console(quiet=True) if console is None else console
        self._display = TasksDisplay(self._console, title)
        self._modules, self._modules_aside = modules, aside
        self._kernels = kernels
        self._ready: dict[int, _Worker] = {}
        self._changed = threading.Condition()
        self._tasks: list[Pending[Any]] = []
        self._queue: deque[Pending[Any]] = deque()
        self._aside: deque[Pending[Any]] = deque()
        self._threads: list[threading.Thread] = []
        self._processes: set[subprocess.Popen[bytes]] = set()
        self._free = 0
        self._is_held = False
        self._is_closing = False
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for name in _ENDING:
                # What is ignored stays so: `nohup bench …` outlives its terminal.
                if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:
                    former = signal.signal(getattr(signal, name), self._interrupt)
                    self._stack.callback(signal.signal, getattr(signal, name), former)
        if not self.in_process:
            self._compile()
            self._ready = {number: self._start_worker(number) for number in range(min(_AT_ONCE, self.number))}
        self._stack.enter_context(_one_thread())
        self._stack.enter_context(collecting_seldom())
        if self.in_process:
            self._stack.enter_context(task_surroundings(self._console, None))
        else:
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
                        self._wait_for(task)
                        if not task._was_asked:
                            task.result()
            finally:
                self._close()

    def _compile(self) -> None:
        if self._kernels:
            # Here, as numba is slow to load.
            from bench.base.compilation_display import compile_kernels

            compile_kernels(self._kernels, self._console)

    def submit(self, function: Callable[P, T], *arguments: P.args, **keywords: P.kwargs) -> Pending[T]:
        """Have a function called; its name is that of the task, see `submit_as`."""
        return self.submit_as(getattr(function, "__name__", "task"), function, *arguments, **keywords)

    def submit_as(self, name: str, function: Callable[P, T], *arguments: P.args, **keywords: P.kwargs) -> Pending[T]:
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
        return self._submit(self._queue, name, partial(function, *arguments, **keywords))

    def submit_aside(
        self, name: str, function: Callable[P, T], *arguments: P.args, **keywords: P.kwargs
    ) -> Pending[T]:
        """Have a function called that nobody waits for; parameters and errors are those of `submit_as`.

        One of the workers carries such tasks out before all others, and the rest only if nothing else is left and
        several of them wait: what they load takes as long as several of them.
        """
        return self._submit(self._aside, name, partial(function, *arguments, **keywords))

    def _submit(self, queue: deque[Pending[Any]], name: str, call: partial[T]) -> Pending[T]:
        order = None
        if not self.in_process:
            if getattr(call.func, "__module__", "") == "__main__":
                raise TypeError(f"{name}: a worker process cannot import {call.func!r}; put it into a module")
            order = Order.of(call.func, call.args, call.keywords)
        task = Pending(self, len(self._tasks), name, call, order, queue)
        with self._changed:
            self._tasks.append(task)
            queue.append(task)
            self._changed.notify_all()
            waiting = len(self._queue) + len(self._aside)
            if not self.in_process and waiting > self._free and len(self._threads) < self.number:
                self._free += 1
                number = len(self._threads)
                self._threads.append(threading.Thread(target=self._serve, args=(number,), name=f"worker-{number}"))
                self._threads[-1].start()
        self._display.add()
        return task

    @contextmanager
    def together(self) -> Iterator[None]:
        """Have no task begun within the block; then the one that was hurried is the first, whatever came before.

        Nothing in the block may wait for a task.
        """
        with self._changed:
            self._is_held = True
        try:
            yield
        finally:
            with self._changed:
                self._is_held = False
                self._changed.notify_all()

    def as_completed(self, tasks: Iterable[Pending[T]]) -> Iterator[Pending[T]]:
        """Yield tasks as they are finished, those that raised as well.

        Raises AbortError if a task did, as the operator ended it.
        """
        left = list(tasks)
        while left:
            if self.in_process:
                self._wait_for(left[0])
            with self._changed:
                while not (done := [task for task in left if task.done]):
                    self._changed.wait(_LOOK)
            for task in done:
                left.remove(task)
                if isinstance(task.error, AbortError):
                    raise task.error
                yield task

    def _put_first(self, task: Pending[Any]) -> None:
        with self._changed:
            if task in task._queue:
                task._queue.remove(task)
                task._queue.appendleft(task)

    def _wait_for(self, task: Pending[Any]) -> None:
        if self.in_process:
            while not task.done:
                self._carry_out_here((self._queue or self._aside).popleft())
        with self._changed:
            while not task.done:
                self._changed.wait(_LOOK)

    def _carry_out_here(self, task: Pending[Any]) -> None:
        try:
            task._value = task._call()
        except AbortError:
            raise
        except Exception as error:
            task._error = error
        task._is_done = True

    def _serve(self, number: int) -> None:
        """Have one worker process carry out task after task; another if it dies."""
        worker = self._ready.pop(number, None)
        while (task := self._take(number)) is not None:
            self._display.begin(task._number, task.name)
            try:
                worker = worker or self._start_worker(number)
                result = worker.carry_out(task, self._display)
            except (EOFError, OSError) as death:
                finished = self._mourn(task, death if worker is None else worker.cause_of_death())
                worker = None
            else:
                finished = True
                self._finish(task, *_unpacked(result))
            self._display.end(task._number, finished=finished)
        if worker is not None:
            worker.close()

    def _start_worker(self, number: int) -> _Worker:
        with self._changed:
            # After the end has begun nobody would end it.
            if self._is_closing:
                raise EOFError("the end of all workers")
            # Beside what they load, the loops of a run are some percent slower.
            aside = self._modules_aside if number == 0 else ()
            return _Worker(Welcome(sys.argv, self._console.width, self._modules, aside), self._processes)

    def _take(self, number: int) -> Pending[Any] | None:
        """Return the next task of a worker, when there is one; None at the end."""
        with self._changed:
            while (queue := self._next_queue(number)) is None and not self._is_closing:
                self._changed.wait()
            if queue is None or self._is_closing:
                return None
            self._free -= 1
            return queue.popleft()

    def _next_queue(self, number: int) -> deque[Pending[Any]] | None:
        """Return where the next task of a worker is; the first worker has those aside in front."""
        if self._is_held:
            return None
        if self._aside and number == 0:
            return self._aside
        if self._queue:
            return self._queue
        return self._aside if len(self._aside) >= _WORTH_LOADING else None

    def _mourn(self, task: Pending[Any], cause: object) -> bool:
        """Have the task of a dead worker process done again; return whether it has failed instead."""
        with self._changed:
            task._deaths += 1
            if task._deaths < ATTEMPTS and not self._is_closing:
                task._queue.appendleft(task)
                self._free += 1
                self._changed.notify_all()
                return False
        error = f"{task.name}: its worker process died {task._deaths} times, the last time by {cause}"
        self._finish(task, None, BenchError(error))
        return True

    def _finish(self, task: Pending[Any], value: object, error: Exception | None) -> None:
        with self._changed:
            task._value, task._error, task._is_done = value, error, True
            self._free += 1
            self._changed.notify_all()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 - signal's form
        if self._is_closing:
            for process in list(self._processes):
                process.kill()
            return
        reason = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        raise AbortError(f"ended by {reason}")

    def _close(self) -> None:
        """End all worker processes, and wait for their ends."""
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        for process in list(self._processes):
            _hang_up(process)
        for process in list(self._processes):
            try:
                process.wait(_UNFINISHED)
            except subprocess.TimeoutExpired:
                process.kill()
        for thread in self._threads:
            thread.join()
        for worker in self._ready.values():
            worker.close()


def _one_thread() -> AbstractContextManager[object]:
    """Return a context in which BLAS has one thread here too: sums differ in their last bits with their number."""
    # The limit is for the libraries that are loaded.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    limit: AbstractContextManager[object] = threadpool_limits(limits=1)
    return limit


class _Worker:
    """One worker process.

    Parameters
    ----------
    welcome : Welcome
        What it has to know.
    processes : set
        Where it is entered while it lives.
    """

    def __init__(self, welcome: Welcome, processes: set[subprocess.Popen[bytes]]) -> None:
        # The modules of the tasks have to be found as here; -P keeps the working folder out of the way of ours.
        path = os.pathsep.join(entry for entry in sys.path if entry)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "bench.base.workers"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD, "PYTHONPATH": path},
            # The terminal's signals are for this process, which ends the others.
            **_own_group(),
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._orders, self._results = self._process.stdin, self._process.stdout
        self._processes = processes
        processes.add(self._process)
        with suppress(OSError):
            send(self._orders, welcome)

    def carry_out(self, task: Pending[Any], display: TasksDisplay) -> Result:
        """Return the result of a task; show what comes before it.

        Raises EOFError or OSError if the process is gone.
        """
        assert task._order is not None
        send(self._orders, task._order)
        while not isinstance(message := receive(self._results), Result):
            if isinstance(message, Progress):
                display.advance(task._number, message.completed, message.total, message.text)
            elif isinstance(message, Words):
                display.say(message.text)
        return message

    def cause_of_death(self) -> str:
        """Wait for the end of the process; return what ended it."""
        self.close()
        code = self._process.returncode
        if code >= 0:
            return f"exit code {code}"
        try:
            return signal.Signals(-code).name
        except ValueError:
            return f"signal {-code}"

    def close(self) -> None:
        """Wait for the end of the process, and close the pipes."""
        _hang_up(self._process)
        self._process.wait()
        self._results.close()
        self._processes.discard(self._process)


def _hang_up(process: subprocess.Popen[bytes]) -> None:
    """Close a worker's standard input, which asks it to end."""
    assert process.stdin is not None
    with suppress(OSError, ValueError):
        process.stdin.close()


def _own_group() -> dict[str, Any]:
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"process_group": 0}


def _unpacked(result: Result) -> tuple[object, Exception | None]:
    """Return what a task returned and what it raised."""
    try:
        content = pickle.loads(result.content)  # noqa: S301 - from our own process
    except Exception as error:
        return None, error
    return (None, content) if result.is_error else (content, None)
