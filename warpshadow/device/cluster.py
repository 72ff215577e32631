"""Ray clusters: tasks as those of :mod:`warpshadow.device.workers`, shared out among the machines of a cluster."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Generator, Iterable
from typing import Any, TypeVar

from warpshadow import check
from warpshadow.device.workers import Ended, WorkerDied, set_up

Task = TypeVar("Task")
Result = TypeVar("Result")


def run_on_ray(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    address: str,
    *,
    workers: int | None = None,
    attempts: int = 2,
    is_on_gpu: bool = False,
) -> Generator[Ended[Task, Result], None, None]:
    """Do tasks on a Ray cluster, each on one core.

    Args:
        function: What does a task.
        tasks: Taken one by one as cores are free.
        address: Of the cluster: "HOST:PORT", or "auto" for that of which this machine is part.
        workers: How many tasks at a time, at most; by default one for each of the cluster's cores.
        attempts: How often a task is begun whose process or machine dies.
        is_on_gpu: Whether each task needs a GPU.

    Yields:
        The tasks that are over, as they end.

    Raises:
        ImportError: where Ray is not installed.
        ConnectionError: where there is no such cluster, or this machine's part of it dies.
    """
    try:
        import ray
    except ImportError as error:
        raise ImportError(check.missing("a Ray cluster", "ray", "ray")) from error
    is_ours = not ray.is_initialized()
    if is_ours:
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise ConnectionError(f"ray: got {address!r}, where no cluster is reached ({error})") from error
    remote: Any = ray.remote(num_cpus=1, num_gpus=int(is_on_gpu), max_retries=attempts - 1)(_alone)
    remaining, pending = iter(tasks), dict[Any, Task]()
    try:
        while True:
            # some more than there are cores for, so that none waits for us
            most = workers or 2 * max(1, int(ray.cluster_resources().get("CPU", 0)))
            for task in itertools.islice(remaining, max(0, most - len(pending))):
                pending[remote.remote(function, task)] = task
            if not pending:
                return
            for reference in ray.wait([*pending])[0]:
                task = pending.pop(reference)
                try:
                    ended = Ended(task, ray.get(reference), None)
                except ray.exceptions.LocalRayletDiedError as error:
                    raise ConnectionError("ray: this machine's node has died") from error
                except ray.exceptions.RayTaskError as error:
                    ended = Ended(task, None, error)
                except ray.exceptions.RayError as error:
                    ended = Ended(task, None, WorkerDied(f"{str(error).splitlines()[0]} ({attempts} times)"))
                yield ended
    finally:
        if is_ours:
            ray.shutdown()


def _alone(function: Callable[[Task], Result], task: Task) -> Result:
    """Do a task on one core."""
    set_up(1)
    return function(task)
