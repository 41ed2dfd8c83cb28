"""Computation of cells in a pool of processes, with progress."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.reproduce.experiment import Cell, CellResult, Experiment, run_cell
from benchmarks.reproduce.results import Results
from service.runtime.process import ProcessOptions, start_process


class ReproductionError(RuntimeError):
    """The experiment could not be finished; finished cells are stored."""


def run(experiment: Experiment, cells: Sequence[Cell], results: Results, workers: int, console: Console) -> None:
    """Compute the cells without a result, `workers` at a time on one core each, and store each result.

    Raises:
        ReproductionError: A worker process died.
    """
    todo = results.missing(cells)
    clock = _Clock(len(cells), results.of(cells), todo, workers)
    others = set(multiprocessing.active_children())
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        Progress(*columns, TextColumn("{task.fields[left]}"), console=console, disable=not console.is_terminal) as bar,
        ProcessPoolExecutor(
            min(workers, max(len(todo), 1)),
            multiprocessing.get_context("spawn"),
            start_process,
            (ProcessOptions(threads=1),),
        ) as pool,
    ):
        task = bar.add_task("training", total=len(cells), completed=len(cells) - len(todo), left="")
        try:
            for result in _finished(pool, experiment, todo):
                results.add(result)
                left = clock.finished(result)
                bar.update(task, advance=1, description=str(result.cell), left=left)
                if result.error is not None or not console.is_terminal:
                    outcome = f"failed: {result.error}" if result.error is not None else f"{result.fit_s:.1f} s"
                    console.print(
                        f"  {clock.done}/{len(cells)}  {result.cell}: {outcome}  {left}", highlight=False, markup=False
                    )
        except BrokenProcessPool:
            raise ReproductionError(
                f"A worker process died, possibly out of memory; {clock.done} of {len(cells)} cells are stored. Run "
                "the command again, with fewer --workers."
            ) from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - others:
                process.terminate()
            raise


def _finished(pool: ProcessPoolExecutor, experiment: Experiment, cells: Sequence[Cell]) -> Iterator[CellResult]:
    waiting: set[Future[CellResult]] = {pool.submit(run_cell, experiment, cell) for cell in cells}
    while waiting:
        done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
        yield from (future.result() for future in done)


class _Clock:
    """An estimate of the remaining time from cells of the same estimator and size."""

    def __init__(self, total: int, known: Sequence[CellResult], todo: Sequence[Cell], workers: int) -> None:
        self.total, self.todo, self.workers, self.began = total, list(todo), workers, time.monotonic()
        self.spent: dict[tuple[str, int], list[float]] = {}
        for result in known:
            self._note(result)

    @property
    def done(self) -> int:
        """Cells with a result."""
        return self.total - len(self.todo)

    def finished(self, result: CellResult) -> str:
        """Record a result; describe the remaining time."""
        self.todo.remove(result.cell)
        self._note(result)
        if not self.spent:
            return ""
        everything = [seconds for some in self.spent.values() for seconds in some]
        seconds = 0.0
        for cell in self.todo:
            like = self.spent.get((cell.estimator, cell.samples), everything)
            seconds += sum(like) / len(like)
        return f"about {_duration(seconds / self.workers)} left" if self.todo else ""

    def _note(self, result: CellResult) -> None:
        if result.error is None:
            key = (result.cell.estimator, result.cell.samples)
            self.spent.setdefault(key, []).append(result.total_s)


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
