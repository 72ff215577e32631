"""Many fits: each in a folder of its own, on workers of this machine or of a Ray cluster.

A fit that is interrupted goes on from its checkpoint. One that has ended with a result leaves a record, the last file
that it writes, by which it is known and not done again. One that failed leaves none, and is tried again.
"""

import contextlib
import csv
import dataclasses
import glob
import hashlib
import itertools
import json
import math
import os
import pickle
import time
import traceback
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath

import torch

from warpshadow import check
from warpshadow.assets import files
from warpshadow.check import AnyPath
from warpshadow.device.cluster import run_on_ray
from warpshadow.device.parallel import thread_count
from warpshadow.device.progress import progress_bar
from warpshadow.device.workers import run_tasks
from warpshadow.inverse import checkpoint as checkpoints
from warpshadow.inverse.checkpoint import CHECKPOINT, check_folder, check_writable, has_checkpoint
from warpshadow.inverse.descent import GOOD_ENDINGS, FitWarning, default_optimizer
from warpshadow.inverse.fit_file import Fit, load_fit
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.report import Report
from warpshadow.inverse.schedule import Stage, stages_for
from warpshadow.scene import toml_tables

TABLE = "table.csv"  # the file, in the folder of all results, that says how each fit ended

_FIT_FILE = "fit.toml"  # pattern of fit files in a folder
_RECORD = "ending.json"
_ATTEMPTS = 4  # begins of a fit whose workers are killed
# how long a worker waits for another that is at the same fit, such as one that Ray believed dead [s]
_LOCK_TIMEOUT = 60.0


@dataclass(frozen=True)
class Ending:
    """Outcome of one of many fits.

    Args:
        name: Of the fit, and of its folder.
        reason: "converged", "finished" (all iterations done), "diverged" (something became NaN or Inf; the folder has
            the best values before that) or "failed" (it left no result).
        error: The non-finite quantity, or the reason of the failure.
        iterations: Of all stages.
        loss_before, loss_after: With regularizers.
        seconds: From when its last worker began with it.
        doubt: The verdict of a result that does not explain its targets, "" of one that does.
        parameters: Fitted numbers by their keys in scene files, if they are few: "bunny.translation", …
        warnings: Warnings that the fit gave.
    """

    name: str
    reason: str
    error: str = ""
    iterations: int | None = None
    loss_before: float | None = None
    loss_after: float | None = None
    seconds: float | None = None
    doubt: str = ""
    parameters: dict[str, list[float]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def is_good(self) -> bool:
        """Whether it converged or finished."""
        return self.reason in GOOD_ENDINGS


def fit_many(
    fits: Iterable[AnyPath | Fit | Problem] | Mapping[str, AnyPath | Fit | Problem],
    folder: AnyPath,
    stages: str | Sequence[Stage] = (Stage(),),
    *,
    optimizer: Callable[..., torch.optim.Optimizer] = default_optimizer,
    tolerance: float = 1e-4,
    seed: int = 0,
    workers: int | None = None,
    ray: str | None = None,
    device: str = "cpu",
    checkpoint_seconds: float = 10.0,
    progress: bool = True,
) -> list[Ending]:
    """Run many fits, several at a time; called again, it resumes unfinished ones from their checkpoints.

    A script that calls it does so under ``if __name__ == "__main__":``, as workers import it.

    Args:
        fits: Problems, fits, or fit files, by name; unnamed ones are called 000000, 000001, …, so keep their order when
            you call it again. They are asked for as workers become free.
        folder: Made if it is not there. Each fit gets a subfolder of its name, with the files of
            :meth:`~warpshadow.inverse.report.Report.write`; table.csv says how each ended.
        stages, optimizer, tolerance, seed: As for :func:`warpshadow.inverse.fit`, of problems; fits and fit files have
            their own.
        workers: How many fits at a time; on this machine by default one for each of ``ws.thread_count()`` threads,
            which they share, or on a GPU one; with ``ray`` one for each core, or GPU, of the cluster.
        ray: Address of a Ray cluster, "HOST:PORT" or "auto", whose machines see the same files under the same paths.
        checkpoint_seconds: Time between checkpoints [s].
    Returns:
        How each ended, in the order of ``fits``. One that fails, diverges, or whose workers are killed four times costs
        only itself.
    Raises:
        CheckpointError: while other fits are written into the folder.
        FileExistsError: for the folder of a single fit.
        ConnectionError: where the Ray cluster cannot be reached.
    """
    if workers is not None:
        check.integer("workers", workers)
    is_on_gpu = check.device("device", device).is_cuda
    check.nonnegative("checkpoint_seconds", checkpoint_seconds)
    folder = Path(folder).absolute()
    check_writable(folder)
    if has_checkpoint(folder):
        raise FileExistsError(f"{folder}: got the folder of one fit, expected a new one or that of many")
    if isinstance(fits, Mapping):
        _check_names(fits)
    named_fits = fits.items() if isinstance(fits, Mapping) else ((f"{k:06}", item) for k, item in enumerate(fits))
    folder.mkdir(exist_ok=True)
    names: list[str] = []
    endings: dict[str, Ending] = {}
    total = len(fits) if isinstance(fits, Sized) else None

    with (
        checkpoints.exclusive(folder / TABLE),
        progress_bar(total, "fitting", "fit", shows=progress, stays=True) as bar,
    ):

        def note(ending: Ending) -> None:
            endings[ending.name] = ending
            others = sum(not item.is_good for item in endings.values())
            bar.describe("fitting", f"{others} failed or diverged" if others else "")
            bar.update()

        def jobs() -> Iterator[_FitJob]:
            for name, source in named_fits:
                names.append(name)
                item = source
                if isinstance(item, Problem):
                    item = Fit(item, stages_for(stages, item), optimizer, tolerance, seed)
                elif not isinstance(item, Fit):
                    item = Path(item).absolute()
                try:
                    job = _FitJob(name, folder, item, _digest(item), device, checkpoint_seconds)
                except Exception as error:  # such as that of an optimizer that cannot be pickled
                    note(_failed_ending(name, error))
                    continue
                ending = job.recorded()
                if ending is None:
                    yield job
                else:
                    note(ending)

        try:
            if ray is not None:
                ended_jobs = run_on_ray(_run_job, jobs(), ray, workers=workers, attempts=_ATTEMPTS, is_on_gpu=is_on_gpu)
            else:
                few = min(workers or (1 if is_on_gpu else thread_count()), total or math.inf)
                ended_jobs = run_tasks(_run_job, jobs(), workers=int(few), attempts=_ATTEMPTS)
            with contextlib.closing(ended_jobs):
                for job, ending, error in ended_jobs:
                    note(ending or Ending(job.name, "failed", str(error)))
        finally:
            ordered_endings = [endings[name] for name in names if name in endings]
            write_table(ordered_endings, folder / TABLE)
    return ordered_endings


@dataclass(frozen=True)
class _FitJob:
    """One of many fits, as it is sent to a worker."""

    name: str
    results: Path  # the folder of all
    fit: Fit | Path
    digest: str  # of all its inputs
    device: str
    checkpoint_seconds: float

    @property
    def folder(self) -> Path:
        return self.results / self.name

    def recorded(self) -> Ending | None:
        """Its previous outcome."""
        path = self.folder / _RECORD
        if not path.exists():
            return None
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            return Ending(**record["ending"]) if record["of"] == self.digest else None
        except (ValueError, KeyError, TypeError):  # damaged: the checkpoint knows how it ended
            return None

    def record(self, ending: Ending) -> None:
        """Note how it ended."""
        with files.atomic_write(self.folder / _RECORD) as temporary_path:
            record = {"of": self.digest, "ending": dataclasses.asdict(ending)}
            temporary_path.write_text(json.dumps(record, indent=1), encoding="utf-8")


def _digest(fit: Fit | Path) -> str:
    """A digest of a fit, or of a fit file's text and its files' modification times, empty if one is missing."""
    if isinstance(fit, Path):
        return hashlib.sha256("\n".join(_file_stamps(fit)).encode()).hexdigest() if fit.is_file() else ""
    decides = f"{fit.problem.fingerprint()} {fit.stages!r} {fit.tolerance!r} {fit.seed}".encode()
    return hashlib.sha256(decides + pickle.dumps(fit.optimizer)).hexdigest()


def _file_stamps(file: Path) -> Iterator[str]:
    """Yield a TOML file's text, and size and time of each file that it names; TOML files recursively."""
    text = file.read_text(encoding="utf-8", errors="replace")
    yield text
    try:
        table = toml_tables.read(file, "file")
    except ValueError:  # which the fit says, too
        return
    for name in sorted(set(_strings_in(table))):
        named_file = file.parent / name
        with contextlib.suppress(OSError, ValueError):  # a text that is no name of a file
            if named_file.is_file():
                status = named_file.stat()
                yield f"{name} {status.st_size} {status.st_mtime_ns}"
                if named_file.suffix == ".toml" and named_file != file:
                    yield from _file_stamps(named_file)


def _strings_in(value: object) -> Iterator[str]:
    """All strings in a parsed TOML file."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (dict, list)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _strings_in(item)


def _run_job(job: _FitJob) -> Ending:
    """Run a fit and record its ending, even if it fails."""
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        try:
            ending = _run_fit(job)
        except Exception as error:
            ending = _failed_ending(job.name, error)
    messages = dict.fromkeys(str(item.message) for item in caught if not issubclass(item.category, FitWarning))
    ending = replace(ending, seconds=round(time.perf_counter() - start, 3), warnings=[*messages])
    if ending.reason != "failed":
        job.record(ending)
    return ending


def _failed_ending(name: str, error: Exception) -> Ending:
    """An ending with the error, and with its place unless it is a mistake in the input."""
    message = str(error) if error.args else type(error).__name__
    if not isinstance(error, (ValueError, OSError, ImportError)):
        trace_entry = traceback.extract_tb(error.__traceback__)[-1]
        message = f"{type(error).__name__}: {error} ({trace_entry.filename}, line {trace_entry.lineno})"
    return Ending(name, "failed", message)


def _run_fit(job: _FitJob) -> Ending:
    """Do a fit, in its folder."""
    loaded_fit = load_fit(job.fit) if isinstance(job.fit, Path) else job.fit
    job.folder.parent.mkdir(parents=True, exist_ok=True)
    check_folder(job.folder)
    job.folder.mkdir(exist_ok=True)
    busy = checkpoints.CheckpointError(f"{job.folder}: another process is writing it")
    with files.file_lock(job.folder / _RECORD, timeout=_LOCK_TIMEOUT, busy=busy):
        result = loaded_fit.run(
            device=job.device,
            checkpoint=job.folder / CHECKPOINT,
            checkpoint_seconds=job.checkpoint_seconds,
            progress=False,
        )
        report = Report(result)
        report.write(job.folder)
    is_good = result.reason in GOOD_ENDINGS
    return Ending(
        job.name,
        result.reason if is_good else "diverged",
        "" if is_good else result.reason,
        sum(map(len, result.losses)),
        report.loss_before,
        report.loss_after,
        doubt="" if result.verdict.is_explained else str(result.verdict),
        parameters=result.figures,
    )


def write_table(endings: Sequence[Ending], path: AnyPath) -> None:
    """Write how fits ended as CSV, a row for each; parameters of several numbers have a column for each number."""
    rows = []
    for ending in endings:
        row = dataclasses.asdict(ending)
        messages, parameters = row.pop("warnings"), row.pop("parameters")
        for name, numbers in parameters.items():
            row |= {f"{name}[{k}]" if len(numbers) > 1 else name: number for k, number in enumerate(numbers)}
        rows.append(row | {"warnings": "; ".join(messages)})
    columns = [column for column in dict.fromkeys(itertools.chain.from_iterable(rows)) if column != "warnings"]
    with files.atomic_write(path) as temporary_path, temporary_path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*columns, "warnings"])
        writer.writeheader()
        writer.writerows(rows)


def is_of_many(where: AnyPath) -> bool:
    """Whether a path is a pattern, a folder or a list of fit files, rather than one of them."""
    path = Path(where)
    return path.is_dir() or path.suffix == ".txt" or (glob.has_magic(os.fspath(where)) and not path.is_file())


def find_fits(where: AnyPath | Sequence[AnyPath]) -> dict[str, Path]:
    """Find fit files and name them; ignore other files.

    A name is the file's path without its suffix: from the first folder of the pattern that has a wildcard; from the
    searched folder; from the list's folder; from the folder that all of several files are in. A last part that the
    pattern fixes, or that is fit.toml, is left out.

    Args:
        where: A pattern, such as "photos/*/fit.toml" or "fits/**/*.toml"; a folder, which is searched for files called
            fit.toml; a list, a .txt file with a path on each line, relative to it; or several files.
    Returns:
        Files by name, sorted by name; a list keeps its own order.
    Raises:
        FileNotFoundError: where there are none.
        ValueError: where the results of two would be in one folder.
    """
    if not isinstance(where, (str, os.PathLike)):
        fit_files = [check.file("file", item).absolute() for item in where]
        return _names_of_files(fit_files, Path(os.path.commonpath([file.parent for file in fit_files])), _FIT_FILE)
    path, text = Path(where), os.fspath(where)
    if path.is_dir():
        start, fit_files, last = path, sorted(path.rglob(_FIT_FILE)), _FIT_FILE
    elif path.suffix == ".txt":
        lines = (line.strip() for line in check.file("file", path).read_text(encoding="utf-8").splitlines())
        start, fit_files, last = path.parent, [path.parent / line for line in lines if line], _FIT_FILE
    else:
        start = Path(*itertools.takewhile(lambda part: not glob.has_magic(part), path.parts))
        fit_files = sorted(item for item in map(Path, glob.glob(text, recursive=True)) if item.is_file())
        last = path.name
    if not fit_files:
        raise FileNotFoundError(f"{where}: no fit file, expected some")
    return _names_of_files(fit_files, start, last)


def _names_of_files(files: Iterable[Path], start: Path, last: str) -> dict[str, Path]:
    """Name each file by its path relative to ``start``, without ``last``, the name of a file, or else its suffix."""
    file_of_names: dict[str, Path] = {}
    for file in files:
        relative = PurePath(os.path.relpath(file, start))
        inner = relative.parent if file.name == last else relative.with_suffix("")
        name = "/".join(part for part in inner.parts if part != "..") or start.resolve().name
        if name in file_of_names:
            raise ValueError(f"got {file_of_names[name]} and {file}, whose results would both be called {name!r}")
        file_of_names[name] = file
    _check_names(file_of_names)
    return file_of_names


def _check_names(names: Collection[str]) -> None:
    """Raise ValueError unless each name is that of a folder of its own."""
    name_of_paths: dict[PurePath, str] = {}
    for name in names:
        path = PurePath(name)
        if not path.parts or path.is_absolute() or ".." in path.parts or path == PurePath(TABLE):
            raise ValueError(f"fits: got the name {name!r}, expected that of a folder in the folder of results")
        if path in name_of_paths:
            raise ValueError(f"fits: got the names {name_of_paths[path]!r} and {name!r} of one folder")
        name_of_paths[path] = name
    for path, name in name_of_paths.items():
        for outer in path.parents:
            if outer in name_of_paths:
                raise ValueError(
                    f"fits: got the names {name_of_paths[outer]!r} and {name!r}, of which one is in the other"
                )
