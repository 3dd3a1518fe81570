"""Many runs at once: one process per core, with a progress bar for each and the evaluations as they come."""

from __future__ import annotations

import contextlib
import multiprocessing as mp
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch as th
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sb3_dce import runs
from sb3_dce.errors import DivergenceError, SB3DCEError
from sb3_dce.evaluation import Evaluation
from sb3_dce.files import DISK_FULL, cannot_write
from sb3_dce.messages import show_warnings_as_lines
from sb3_dce.processes import (
    prepare_worker,
    starting_workers,
    termination_as_interrupt,
    threads_from_environment,
    usable_cores,
)
from sb3_dce.run_files import RunSpec, write_divergence
from sb3_dce.runs import StoppedError

# With more runs than this the bars of those that are done make room for the others.
BARS_KEPT = 20
# How long runs may take to save when they are interrupted: the rest of an evaluation, or of compiling.
SAVING_SECONDS = 120.0
# What printing ends in when the reader of a pipe has gone, which rich turns into an exit, or the disk of a log file is full.
UNSEEN = (OSError, SystemExit)


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


def raise_first(errors: Sequence[BaseException], console: Console) -> None:
    """
    End a command whose runs have failed: all errors but the first are printed; without errors nothing happens.

    :param errors: of runs, after what is complete has been shown
    :param console: where they are printed
    :raises BaseException: the first
    """
    for error in errors[1:]:
        console.print(f"failed: {error}", markup=False, soft_wrap=True)
    if errors:
        raise errors[0]


class _Workers:
    """
    A process for each thread that asks for one; it trains one run after the other.

    Nothing is shared that a process could hold when the system kills it, as it does when memory is short: a pool of several
    would fail as a whole, and a lock of a common queue would stay closed for the others.

    :param threads: of PyTorch in each process
    :param report: called with the progress of the runs, by the thread that waits for the run
    """

    def __init__(self, threads: int, report: runs.Report) -> None:
        self._threads, self._report, self._context = threads, report, mp.get_context("spawn")
        self._own, self._lock = threading.local(), threading.Lock()
        self._processes: list[BaseProcess] = []
        self._ends: list[Connection] = []
        self._stop = self._context.RawValue("b", 0)
        self._ended = False

    def run(self, spec: RunSpec) -> dict[str, Any]:
        """
        Train in the process of the calling thread, and pass on its progress until the result is there.

        :param spec: what is to be run
        :return: its result
        :raises RunFailedError: if no process can be started, or it is killed
        :raises BaseException: what ``report`` raises; then, too, the next run of this thread gets a new process
        """
        try:
            end = self._end_of_own_process(spec.name)
            with _death_in_words(spec.name):
                end.send(spec)
                message = end.recv()
            while isinstance(message, runs.Progress):
                self._report(message)
                with _death_in_words(spec.name):
                    message = end.recv()
        except BaseException:
            self._kill_own_process()  # what it still sends would be taken for messages of the next run
            raise
        if isinstance(message, BaseException):
            raise message
        return message

    def _end_of_own_process(self, name: str) -> Connection:
        if getattr(self._own, "process", None) is None:
            with self._lock:
                if self._ended:
                    raise CancelledError
                try:
                    here, there = self._context.Pipe()
                    with there:  # the process has it then, and with the process it closes
                        process = self._context.Process(target=_serve, args=(there, self._threads, self._stop))
                        with starting_workers():
                            process.start()
                except OSError as error:
                    hint = "Use fewer --workers; the same command goes on."
                    raise RunFailedError(f"no process for {name}: {error.strerror or error}", hint=hint) from error
                self._processes.append(process)
                self._ends.append(here)
                self._own.process, self._own.end = process, here
        return self._own.end

    def _kill_own_process(self) -> None:
        process, self._own.process = getattr(self._own, "process", None), None
        if process is not None:
            process.kill()  # they do not listen to SIGTERM
            process.join()

    def save_and_end(self) -> None:
        """Tell all runs to save where they are, and to end."""
        self._stop.value = 1

    def close(self, at_once: bool) -> None:
        """
        Start no more processes, close the pipes, and wait until all processes have ended.

        :param at_once: end the processes whatever they are doing; else they have nothing left to do, and end by themselves
        """
        with self._lock:
            self._ended = True
        for process in self._processes if at_once else ():
            process.kill()
            process.join()  # before its pipe is closed, at which a thread may be waiting
        for end in self._ends:
            end.close()
        for process in self._processes:
            process.join()


@contextmanager
def _death_in_words(name: str) -> Iterator[None]:
    """The end of a process while it is sent a run or heard, also in the middle of a message."""
    try:
        yield
    except (EOFError, OSError) as error:
        raise RunFailedError(
            f"the process of {name} was ended from outside, as the system does when memory is short",
            hint="Use fewer --workers; the same command goes on from the last checkpoint. A script that starts processes "
            'must do so below if __name__ == "__main__":.',
        ) from error


def _launch(specs: Sequence[RunSpec], n_workers: int, console: Console, keep_going: bool) -> list[Future[Any]]:
    n_workers = max(1, min(n_workers, len(specs)))
    with progress_display(console) as display, ThreadPoolExecutor(n_workers) as threads:
        # The user's own setting wins: more threads than free cores make PyTorch many times slower.
        workers = _Workers(threads_from_environment() or max(1, usable_cores() // n_workers), _Bars(specs, display).show)
        futures = [threads.submit(workers.run, spec) for spec in specs]
        try:
            with termination_as_interrupt():
                try:
                    _wait(futures, keep_going)
                except KeyboardInterrupt:
                    _save_and_end(futures, workers, display.console)
                    raise
        except BaseException:
            # Without this an error would wait for every other run to finish.
            begun = [future for future in futures if not future.cancel()]
            workers.close(at_once=not all(future.done() for future in begun))
            raise
        workers.close(at_once=False)
        return futures


def _wait(futures: Sequence[Future[Any]], keep_going: bool) -> None:
    waiting = set(futures)
    while waiting:
        done, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)  # Windows hears no Ctrl-C while it waits
        for future in done:
            if not keep_going:
                future.result()


def _save_and_end(futures: Sequence[Future[Any]], workers: _Workers, console: Console) -> None:
    """Let each run save where it is; a second Ctrl-C does not wait for that."""
    begun = [future for future in futures if not future.cancel()]
    workers.save_and_end()
    say(console, "Interrupted: saving what is being trained. Ctrl-C again ends at once.")
    with contextlib.suppress(KeyboardInterrupt):
        wait(begun, SAVING_SECONDS)
    failed = [error for future in begun if future.done() and (error := future.exception()) is not None]
    failed = [error for error in failed if not isinstance(error, StoppedError)]
    for error in failed:
        say(console, f"failed: {error}")
    saved = not failed and all(future.done() for future in begun)
    say(console, f"The same command goes on from {'there' if saved else 'the last checkpoints'}.")


def say(console: Console, text: str) -> None:
    """
    Print a line about runs that are under way; that nobody can see it ends none of them.

    :param console: where to print
    :param text: the line
    """
    with contextlib.suppress(*UNSEEN):
        console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def progress_display(console: Console) -> Iterator[Progress]:
    """
    Bars for gradient steps, repainted four times a second in a terminal and hardly ever in a log file.

    :param console: where the bars are shown
    :return: bars with counts, elapsed and remaining time, shown while the block runs
    """
    display = Progress(
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
    display.start()
    try:
        yield display
    finally:
        with contextlib.suppress(*UNSEEN):
            display.stop()


class _Bars:
    """
    A bar for each run that has begun.

    :param specs: the runs
    :param display: where the bars are shown
    """

    def __init__(self, specs: Sequence[RunSpec], display: Progress) -> None:
        self._totals, self._display = {spec.name: spec.n_updates for spec in specs}, display
        self._tasks: dict[str, TaskID] = {}

    def show(self, event: runs.Progress) -> None:
        """
        Move a run's bar, made at its first report, and print the evaluation that the report may bring.

        :param event: of one of the runs
        """
        with contextlib.suppress(*UNSEEN):
            self._move(event)
        if event.evaluation is not None:
            show_evaluation(self._display.console, event.name, event.evaluation)

    def _move(self, event: runs.Progress) -> None:
        total, display = self._totals[event.name], self._display
        if event.name not in self._tasks:
            self._tasks[event.name] = display.add_task(event.name, total=total)
        display.update(self._tasks[event.name], completed=event.n_updates)
        if event.n_updates >= total and len(self._totals) > BARS_KEPT:
            display.remove_task(self._tasks.pop(event.name))


def show_evaluation(console: Console, name: str, outcome: Evaluation) -> None:
    """
    Print an evaluation as one line: run, gradient steps, mean and deviation of the returns, score if there is one.

    :param console: where to print
    :param name: short name of the run
    :param outcome: of one evaluation
    """
    score = "" if outcome.score is None else f"   score {outcome.score:6.1f}"
    say(console, f"  {name:<18} @{outcome.n_updates:>8,}   return {outcome.mean:8.1f} ± {outcome.std:6.1f}{score}")


def _serve(end: Connection, threads: int, stop: Any) -> None:
    """What a process does: train what it is sent, report, send back the result or the error."""
    # as Ctrl-C for the parent, which tells when to save; whoever ends a whole group of processes sends it to all of them
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    prepare_worker()
    show_warnings_as_lines()
    th.set_num_threads(threads)
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            spec = end.recv()
            try:
                if stop.value:  # while this process was starting: what there is to save is in the folder
                    hint = "The same command goes on from there."
                    raise StoppedError(f"{spec.name} was ended before it began", where=spec.folder, hint=hint)
                outcome: dict[str, Any] | Exception = train_one(spec, end.send, lambda: bool(stop.value))
            except Exception as error:
                outcome = error.with_traceback(None)
            end.send(outcome)


def train_one(spec: RunSpec, report: runs.Report, stop: Callable[[], bool] = lambda: False) -> dict[str, Any]:
    """
    One of many runs of a process.

    :param spec: what is to be run
    :param report: called with the progress
    :param stop: asked after every update whether to save and end
    :return: its result
    :raises DivergenceError: if it diverges, which is also written down in its folder
    :raises SB3DCEError: for other errors; the report of an unexpected one is in ``error.txt`` of the folder, if that can be
        written
    """
    if "torch._dynamo" in sys.modules:
        # What was compiled for an earlier run would stay in memory, and be asked at each call whether it fits.
        th.compiler.reset()
    try:
        return runs.run(spec, report, stop)
    except DivergenceError as error:
        write_divergence(Path(spec.folder), int(error.index or 0), error.what)
        raise
    except SB3DCEError:
        raise
    except Exception as error:
        folder = Path(spec.folder)
        if isinstance(error, OSError) and error.errno in DISK_FULL:  # of a logger: what this package writes says it itself
            raise cannot_write(Path(error.filename or folder), error) from error
        hint = "Without its cause the same command goes on."
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "error.txt").write_text(traceback.format_exc(), encoding="utf-8")
            hint = f"The whole report is in error.txt there. {hint}"
        raise RunFailedError(f"{spec.name} failed: {type(error).__name__}: {error}", where=str(folder), hint=hint) from None
