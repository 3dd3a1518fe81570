"""Many runs at once: one process per core, with a progress bar for each and the evaluations as they come."""

from __future__ import annotations

import multiprocessing as mp
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch as th
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_dce import runs
from sb3_dce.errors import DivergenceError, SB3DCEError
from sb3_dce.evaluation import Evaluation
from sb3_dce.messages import show_warnings_as_lines
from sb3_dce.processes import prepare_worker, termination_as_interrupt, threads_from_environment, usable_cores
from sb3_dce.runs import RunSpec

# With more runs than this the bars of those that are done make room for the others.
BARS_KEPT = 20
# How long runs may take to save when they are interrupted: the rest of an evaluation, or of compiling.
SAVING_SECONDS = 120.0


class RunFailedError(SB3DCEError):
    """A run ended with an unexpected error; its traceback is in ``error.txt`` of the run's folder."""


def launch(specs: Sequence[RunSpec], workers: int, console: Console) -> list[dict[str, Any]]:
    """
    Run all, in parallel processes.

    :param specs: what is to be run
    :param workers: processes at a time
    :param console: where progress and evaluations are shown
    :return: results in the order of ``specs``
    :raises SB3DCEError: the first error of a run; what the others have done is kept and resumed by the same call
    :raises KeyboardInterrupt: on Ctrl-C or SIGTERM, after each run that was under way has saved where it is
    """
    return [future.result() for future in _launch(specs, workers, console, keep_going=False)]


def launch_all(specs: Sequence[RunSpec], workers: int, console: Console) -> list[dict[str, Any] | BaseException]:
    """
    Run all, in parallel processes; one that fails, or whose process is killed, does not stop the others.

    :param specs: what is to be run
    :param workers: processes at a time
    :param console: where progress and evaluations are shown
    :return: results in the order of ``specs``, or the error of the run
    :raises KeyboardInterrupt: on Ctrl-C or SIGTERM, after each run that was under way has saved where it is
    """
    futures = _launch(specs, workers, console, keep_going=True)
    return [future.exception() or future.result() for future in futures]


class _Workers:
    """
    A process for each thread that asks for one; it trains one run after the other.

    Nothing is shared that a process could hold when the system kills it, as it does when memory is short: a pool of several
    would fail as a whole, and a lock of a common queue would stay closed for the others.

    :param threads: of PyTorch in each process
    """

    def __init__(self, threads: int) -> None:
        self._threads, self._context = threads, mp.get_context("spawn")
        self._own, self._lock = threading.local(), threading.Lock()
        self._pools: list[ProcessPoolExecutor] = []
        self._events: list[Connection] = []
        self._stop = self._context.RawValue("b", 0)
        self._ended = False

    def run(self, spec: RunSpec) -> dict[str, Any]:
        """
        :param spec: what is to be run
        :return: its result
        :raises RunFailedError: if its process is killed; the next run of this thread gets a new one
        """
        try:
            return self._submit(spec).result()
        except BrokenProcessPool as error:
            self._own.pool = None
            raise RunFailedError(
                f"the process of {spec.name} was ended from outside, as the system does when memory is short",
                hint="Use fewer --workers; the same command goes on from the last checkpoint. A script that starts processes "
                'must do so below if __name__ == "__main__":.',
            ) from error

    def _submit(self, spec: RunSpec) -> Future[dict[str, Any]]:
        with self._lock:
            if self._ended:
                raise CancelledError
            pool = getattr(self._own, "pool", None)
            if pool is not None:
                return pool.submit(_run, spec)
            events, end = self._context.Pipe(duplex=False)
            arguments = (self._threads, end, self._stop)
            self._own.pool = pool = ProcessPoolExecutor(1, mp_context=self._context, initializer=_prepare, initargs=arguments)
            self._pools.append(pool)
            self._events.append(events)
            future = pool.submit(_run, spec)
            end.close()  # the process has it now, and with the process it closes
            return future

    def next_events(self, seconds: float) -> list[runs.Progress]:
        """
        :param seconds: how long to wait for one
        :return: reports of runs, none if nothing has happened
        """
        with self._lock:
            open_ends = list(self._events)
        if not open_ends:
            time.sleep(seconds)
            return []
        events = []
        ready = connection.wait(open_ends, seconds)
        for end in (end for end in open_ends if end in ready):
            try:
                events.append(end.recv())
            except (EOFError, OSError):
                with self._lock:
                    self._events.remove(end)
        return events

    def save_and_end(self) -> None:
        """Tell all runs to save where they are, and to end."""
        self._stop.value = 1

    def terminate(self) -> None:
        """End the processes at once, whatever they are doing."""
        with self._lock:
            self._ended = True
        for pool in self._pools:
            for process in list((pool._processes or {}).values()):
                process.terminate()

    def close(self) -> None:
        """Let the processes go, which have nothing left to do."""
        for pool in self._pools:
            pool.shutdown()


def _launch(specs: Sequence[RunSpec], n_workers: int, console: Console, keep_going: bool) -> list[Future[Any]]:
    n_workers = max(1, min(n_workers, len(specs)))
    # The user's own setting wins: more threads than free cores make PyTorch many times slower.
    workers = _Workers(threads_from_environment() or max(1, usable_cores() // n_workers))
    with progress_display(console) as display, ThreadPoolExecutor(n_workers) as threads:
        futures = [threads.submit(workers.run, spec) for spec in specs]
        try:
            with termination_as_interrupt():
                try:
                    _show_until_done(futures, workers, specs, display, keep_going)
                except KeyboardInterrupt:
                    _save_and_end(futures, workers, display.console)
                    raise
            return futures
        except BaseException:
            # Without this an error would wait for every other run to finish.
            for future in futures:
                future.cancel()
            workers.terminate()
            raise
        finally:
            workers.close()


def _save_and_end(futures: Sequence[Future[Any]], workers: _Workers, console: Console) -> None:
    """Let each run save where it is; a second Ctrl-C does not wait for that."""
    console.print("Interrupted: saving what is being trained. Ctrl-C again ends at once.", markup=False)
    for future in futures:
        future.cancel()
    workers.save_and_end()
    try:
        late = wait(futures, SAVING_SECONDS).not_done
    except KeyboardInterrupt:
        late = {future for future in futures if not future.done()}
    where = "the last checkpoints" if late else "there"
    console.print(f"The same command goes on from {where}.", markup=False)


def progress_display(console: Console) -> Progress:
    """
    :param console: where the bars are shown
    :return: bars with counts, elapsed and remaining time
    """
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("updates"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        # A log file gets the evaluations and the final state, not one line per repaint.
        refresh_per_second=4 if console.is_terminal else 0.02,
    )


def _show_until_done(
    futures: list[Future[Any]], workers: _Workers, specs: Sequence[RunSpec], display: Progress, keep_going: bool
) -> None:
    tasks: dict[str, TaskID] = {}
    totals = {spec.name: spec.n_updates for spec in specs}
    while True:
        events = workers.next_events(0.2)
        if not events:
            failed = [future for future in futures if future.done() and future.exception() is not None]
            if failed and not keep_going:
                failed[0].result()
            if all(future.done() for future in futures):
                return
        for event in events:
            if event.name not in tasks:
                tasks[event.name] = display.add_task(event.name, total=totals[event.name])
            display.update(tasks[event.name], completed=event.n_updates)
            if event.n_updates >= totals[event.name] and len(specs) > BARS_KEPT:
                display.remove_task(tasks.pop(event.name))
            if event.evaluation is not None:
                show_evaluation(display.console, event.name, event.evaluation)


def show_evaluation(console: Console, name: str, outcome: Evaluation) -> None:
    """
    :param console: where to print
    :param name: short name of the run
    :param outcome: of one evaluation
    """
    score = "" if outcome.score is None else f"   score {outcome.score:6.1f}"
    line = f"  {name:<18} @{outcome.n_updates:>8,}   return {outcome.mean:8.1f} ± {outcome.std:6.1f}{score}"
    console.print(line, highlight=False)


# Where a worker process reports to, and what tells it to save and end; set when it starts, since neither can be sent with
# each task.
_events: Any = None
_stop: Any = None


def _prepare(threads: int, events: Connection, stop: Any) -> None:
    global _events, _stop
    _events, _stop = events, stop
    prepare_worker()
    show_warnings_as_lines()
    th.set_num_threads(threads)


def _run(spec: RunSpec) -> dict[str, Any]:
    return train_one(spec, _events.send, lambda: bool(_stop.value))


def train_one(spec: RunSpec, report: runs.Report, stop: Callable[[], bool] = lambda: False) -> dict[str, Any]:
    """
    One of many runs of a process.

    :param spec: what is to be run
    :param report: called with the progress
    :param stop: asked after every update whether to save and end
    :return: its result
    :raises DivergenceError: if it diverges, which is also written down in its folder
    :raises SB3DCEError: for other errors; the report of an unexpected one is in ``error.txt`` of the folder
    """
    if "torch._dynamo" in sys.modules:
        # What was compiled for an earlier run would stay in memory, and be asked at each call whether it fits.
        th.compiler.reset()
    try:
        return runs.run(spec, report, stop)
    except DivergenceError as error:
        runs.write_divergence(Path(spec.folder), int(error.index or 0), error.what)
        raise
    except SB3DCEError:
        raise
    except Exception as error:
        folder = Path(spec.folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")
        raise RunFailedError(
            f"{spec.name} failed: {type(error).__name__}: {error}",
            where=str(folder),
            hint="The whole report is in error.txt there. Without its cause the same command goes on.",
        ) from None
