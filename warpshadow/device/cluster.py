"""Ray clusters: run the tasks of :mod:`warpshadow.device.workers` on the machines of a cluster."""

import itertools
import logging
import socket
import time
from collections.abc import Callable, Generator, Iterable
from typing import Any, TypeVar

from warpshadow import check
from warpshadow.device.workers import PackError, TaskResult, WorkerDied, answer, pack, set_up, unpack

Task = TypeVar("Task")
Result = TypeVar("Result")

_NO_TOKEN = "it asks for a token: set RAY_AUTH_MODE=token here, too, and have the same ~/.ray/auth_token as there"
_HEAD_TIMEOUT = 20.0  # how long the head of a cluster may be away [s]; after 60 Ray ends this process, at once


def run_on_ray(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    address: str,
    *,
    workers: int | None = None,
    attempts: int = 2,
    is_on_gpu: bool = False,
) -> Generator[TaskResult[Task, Result], None, None]:
    """Do tasks on a Ray cluster, each on one core, and one GPU if it needs it.

    Args:
        function, tasks, attempts: As for :func:`.workers.run_tasks`.
        address: Of the cluster: "HOST:PORT", or "auto" for that of which this machine is part.
        workers: How many tasks at a time, at most; by default one for each of the cluster's cores.
        is_on_gpu: Whether each task needs a GPU.
    Yields:
        The tasks that are over, as they end.
    Raises:
        ImportError: where Ray is not installed.
        ConnectionError: where there is no such cluster, where it wants a token that this process does not give, or once
            its head or this machine's part of it has died.
    """
    check.importable("ray", "a Ray cluster", "ray", "ray")
    import ray

    is_ours = not ray.is_initialized()
    if is_ours:
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
            reason = _NO_TOKEN if "InvalidAuthToken" in str(error.__cause__) else error
            raise ConnectionError(f"ray: got {address!r}, where no cluster is reached ({reason})") from error
    head = ray.get_runtime_context().gcs_address
    remote: Any = ray.remote(num_cpus=1, num_gpus=int(is_on_gpu), max_retries=attempts - 1)(_alone)
    remaining_tasks, pending_tasks = iter(tasks), dict[Any, Task]()
    try:
        while True:
            _await(head)
            # some more than there are cores for, so that none waits for us
            maximum = workers or 2 * max(1, int(ray.cluster_resources().get("CPU", 0)))
            for task in itertools.islice(remaining_tasks, max(0, maximum - len(pending_tasks))):
                try:
                    pending_tasks[remote.remote(function, pack(task, ray.cloudpickle.dumps))] = task
                except PackError as error:
                    yield TaskResult(task, None, error)
            if not pending_tasks:
                return
            for reference in ray.wait([*pending_tasks], timeout=_HEAD_TIMEOUT / 2)[0]:
                task = pending_tasks.pop(reference)
                try:
                    ended_task = TaskResult(task, *unpack(ray.get(reference)))
                except ray.exceptions.LocalRayletDiedError as error:
                    raise ConnectionError("ray: this machine's node has died") from error
                except ray.exceptions.RayTaskError as error:
                    ended_task = TaskResult(task, None, RuntimeError(str(error).splitlines()[-1]))
                except ray.exceptions.RayError as error:
                    ended_task = TaskResult(task, None, WorkerDied(f"{str(error).splitlines()[0]} ({attempts} times)"))
                yield ended_task
    finally:
        if is_ours:
            ray.shutdown()


def _await(head: str) -> None:
    """Return once a cluster's head, "HOST:PORT", can be reached."""
    host, _, port = head.rpartition(":")
    deadline = time.monotonic() + _HEAD_TIMEOUT
    while True:
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=_HEAD_TIMEOUT).close()
            return
        except OSError as error:
            if time.monotonic() > deadline:
                raise ConnectionError(f"ray: the head of the cluster at {head} has died") from error
            time.sleep(1)


def _alone(function: Callable[[Any], Any], packed_task: bytes) -> bytes:
    """Do a task on one core."""
    import ray

    set_up(1)
    return answer(function, packed_task, ray.cloudpickle.dumps, Exception)  # other exceptions end the task for Ray
