"""Many runs at once: one process per core, with a progress bar for each and the evaluations as they come."""

from __future__ import annotations

import multiprocessing as mp
import queue
import sys
import traceback
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import torch as th
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_dce import runs
from sb3_dce.errors import DivergenceError, SB3DCEError
from sb3_dce.evaluation import Evaluation
from sb3_dce.processes import prepare_worker, threads_from_environment, usable_cores
from sb3_dce.runs import RunSpec

# With more runs than this the bars of those that are done make room for the others.
BARS_KEPT = 20


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
    """
    try:
        return [future.result() for future in _launch(specs, workers, console, keep_going=False)]
    except BrokenProcessPool as error:
        raise _killed() from error


def launch_all(specs: Sequence[RunSpec], workers: int, console: Console) -> list[dict[str, Any] | BaseException]:
    """
    Run all, in parallel processes; one that fails does not stop the others.

    :param specs: what is to be run
    :param workers: processes at a time
    :param console: where progress and evaluations are shown
    :return: results in the order of ``specs``, or the error of the run
    """
    futures = _launch(specs, workers, console, keep_going=True)
    outcomes = [future.exception() or future.result() for future in futures]
    return [_killed() if isinstance(outcome, BrokenProcessPool) else outcome for outcome in outcomes]


def _killed() -> RunFailedError:
    return RunFailedError(
        "a training process was ended from outside, as the system does when memory is short",
        hint="Use fewer --workers; the same command goes on from the last checkpoints. A script that starts processes must do "
        'so below if __name__ == "__main__":.',
    )


def _launch(specs: Sequence[RunSpec], workers: int, console: Console, keep_going: bool) -> list[Future[Any]]:
    workers = max(1, min(workers, len(specs)))
    # The user's own setting wins: more threads than free cores make PyTorch many times slower.
    threads = threads_from_environment() or max(1, usable_cores() // workers)
    context = mp.get_context("spawn")
    events = context.Queue()
    with progress_display(console) as display:
        with ProcessPoolExecutor(workers, mp_context=context, initializer=_prepare, initargs=(threads, events)) as pool:
            futures = [pool.submit(_run, spec) for spec in specs]
            try:
                _show_until_done(futures, events, specs, display, keep_going)
                return futures
            except BaseException:
                # Without this an error or Ctrl-C would wait for every other run to finish.
                for future in futures:
                    future.cancel()
                for process in list(pool._processes.values()):
                    process.terminate()
                raise


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
    futures: list[Future[Any]], events: Any, specs: Sequence[RunSpec], display: Progress, keep_going: bool
) -> None:
    tasks: dict[str, TaskID] = {}
    totals = {spec.name: spec.n_updates for spec in specs}
    while True:
        try:
            event = events.get(timeout=0.2)
        except queue.Empty:
            failed = [future for future in futures if future.done() and future.exception() is not None]
            if failed and not keep_going:
                failed[0].result()
            if all(future.done() for future in futures):
                return
            continue
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


# Where a worker process reports to; set when it starts, since a queue cannot be sent with each task.
_events: Any = None


def _prepare(threads: int, events: Any) -> None:
    global _events
    _events = events
    prepare_worker()
    th.set_num_threads(threads)


def _run(spec: RunSpec) -> dict[str, Any]:
    return train_one(spec, _events.put)


def train_one(spec: RunSpec, report: runs.Report) -> dict[str, Any]:
    """
    One of many runs of a process.

    :param spec: what is to be run
    :param report: called with the progress
    :return: its result
    :raises DivergenceError: if it diverges, which is also written down in its folder
    :raises SB3DCEError: for other errors; the report of an unexpected one is in ``error.txt`` of the folder
    """
    if "torch._dynamo" in sys.modules:
        # What was compiled for an earlier run would stay in memory, and be asked at each call whether it fits.
        th.compiler.reset()
    try:
        return runs.run(spec, report)
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
