"""Worker processes: tasks that do not depend on each other, shared out among processes of this machine.

Each process has a share of the threads of :mod:`warpshadow.device.parallel`, does one task after another, and keeps its
caches and compiled kernels. A process that dies, killed or out of memory, takes no other with it.
"""

import contextlib
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

from warpshadow.device.parallel import set_thread_count, thread_count
from warpshadow.device.progress import show_bars
from warpshadow.device.startup import start_quietly

Task = TypeVar("Task")
Result = TypeVar("Result")
Dumps: TypeAlias = Callable[[Any], bytes]


class WorkerDied(RuntimeError):
    """A process ended in the middle of a task, and did so again when others tried."""


class TaskResult(NamedTuple, Generic[Task, Result]):
    """A task that is over."""

    task: Task
    result: Result | None  # the function's result; None where it failed
    error: Exception | None  # the exception it raised, or :class:`WorkerDied`


class _Worker(Generic[Task, Result]):
    """A process, the task that it has, and how often that was begun."""

    def __init__(self, function: Callable[[Task], Result], threads: int):
        context = multiprocessing.get_context("spawn")  # a fork would have Warp's locks, but not its threads
        self.connection, other_end = context.Pipe()
        self.process = context.Process(target=_serve, args=(other_end, function, threads), daemon=True)
        self.process.start()
        other_end.close()  # so that its death is the end of the connection
        self.assignment: tuple[Task, int] | None = None
        self.has_started = False

    def begin(self, task: Task, packed_task: bytes, attempt: int) -> None:
        """Let it do a task; should it be dead, that is noticed as if it died of the task."""
        self.assignment = task, attempt
        with contextlib.suppress(OSError):
            self.connection.send_bytes(packed_task)

    def end(self) -> int | None:
        """End the process, and return its exit status."""
        self.process.kill()
        self.process.join()
        self.connection.close()
        return self.process.exitcode


def run_tasks(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    *,
    workers: int,
    threads: int | None = None,
    attempts: int = 2,
) -> Generator[TaskResult[Task, Result], None, None]:
    """Do tasks in worker processes, which end with this one, however it ends.

    Args:
        function: Called for each task; pickled and sent once to each process. A task fails where it or its
            result cannot be.
        tasks: Taken one by one as processes are free.
        workers: Number of processes.
        threads: Threads that kernels and NumPy have in each process; by default an even share of all.
        attempts: How often a task is begun whose process dies: it may have been killed because another process ran out
            of memory.
    Yields:
        The tasks that are over, as they end.
    Raises:
        ChildProcessError: where no process can start.
    """
    threads = threads or max(1, thread_count() // workers)
    new_tasks, repeated_tasks = ((task, 1) for task in tasks), deque[tuple[Task, int]]()
    idle: list[_Worker[Task, Result]] = []
    busy: dict[object, _Worker[Task, Result]] = {}  # by their connections
    try:
        while True:
            while len(busy) < workers and (
                next_task := repeated_tasks.popleft() if repeated_tasks else next(new_tasks, None)
            ):
                task, attempt = next_task
                try:
                    packed_task = pack(task)
                except PackError as failure:
                    yield TaskResult(task, None, failure)
                    continue
                worker = idle.pop() if idle else _Worker(function, threads)
                worker.begin(task, packed_task, attempt)
                busy[worker.connection] = worker
            if not busy:
                return
            for connection in wait([worker.connection for worker in busy.values()]):
                worker = busy.pop(connection)
                assert worker.assignment is not None
                task, attempt = worker.assignment
                try:
                    packed_result = worker.connection.recv_bytes()
                    if not worker.has_started:  # the first that it says
                        worker.has_started = True
                        busy[connection] = worker
                        continue
                    idle.append(worker)
                    result, error = unpack(packed_result)
                except (EOFError, OSError):
                    status = worker.end()
                    if not worker.has_started and status is not None and status >= 0:
                        raise ChildProcessError(
                            "a worker process cannot start, as it says above; a script that starts some puts its "
                            'work under if __name__ == "__main__":'
                        ) from None
                    if attempt < attempts:
                        repeated_tasks.append((task, attempt + 1))
                        continue
                    result, error = None, WorkerDied(f"its process ended {_in_words(status)}, {attempts} times")
                yield TaskResult(task, result, error)
    finally:
        for worker in (*busy.values(), *idle):
            worker.end()


def _in_words(status: int | None) -> str:
    if status is not None and status < 0:
        return f"by {signal.Signals(-status).name}"
    return f"with exit status {status}"


# ------------------------------------------------------------------------------------------------ to and fro


class PackError(RuntimeError):
    """Something cannot be sent from one process to another."""


def pack(task: object, dumps: Dumps = pickle.dumps) -> bytes:
    """Pickle a task, or raise PackError."""
    try:
        return dumps(task)
    except Exception as error:
        raise PackError(f"the task cannot be pickled ({_described(error)})") from error


def answer(
    function: Callable[[Any], Any],
    packed_task: bytes,
    dumps: Dumps = pickle.dumps,
    caught: type[BaseException] = BaseException,
) -> bytes:
    """Do a task that was packed, and pickle its result and its error; sys.exit(), too, ends only the task."""
    try:
        result = function(pickle.loads(packed_task))
    except caught as error:
        return pickle.dumps((None, _sendable(error)))
    try:
        return dumps((result, None))
    except caught as error:
        return pickle.dumps((None, PackError(f"the result cannot be pickled ({_described(error)})")))


def unpack(answer: bytes) -> tuple[Any, Exception | None]:
    """The result and the error of a task that was answered."""
    try:
        return pickle.loads(answer)
    except Exception as error:
        return None, PackError(f"the result cannot be unpickled ({_described(error)})")


def _sendable(error: BaseException) -> Exception:
    """An error, or its text, where it cannot be pickled or would end the process that gets it."""
    try:
        str(pickle.loads(pickle.dumps(error)))
    except Exception:
        return RuntimeError(_described(error))
    return error if isinstance(error, Exception) else RuntimeError(_described(error))


def _described(error: BaseException) -> str:
    """Type and message of an error, on a line."""
    return " ".join("".join(traceback.format_exception_only(error)).split())


# ---------------------------------------------------------------------------------------------- in the process


def _serve(connection: Connection, function: Callable[[Task], Result], threads: int) -> None:
    """Do the tasks that come, until the connection ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C is for the parent, which ends this process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    set_up(threads)
    connection.send_bytes(b"")
    while True:
        try:
            packed_task = connection.recv_bytes()
        except EOFError:
            return
        connection.send_bytes(answer(function, packed_task))


def set_up(threads: int) -> None:
    """Make this process one that does tasks, with so many threads, and says nothing."""
    from threadpoolctl import threadpool_limits
    from tqdm import tqdm

    tqdm.set_lock(threading.RLock())  # in place of a semaphore, which outlives a process that is killed
    start_quietly()
    show_bars(False)
    set_thread_count(threads)
    threadpool_limits(limits=threads)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
