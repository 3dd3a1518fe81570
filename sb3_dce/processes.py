"""Worker processes that live no longer than they are wanted."""

from __future__ import annotations

import multiprocessing as mp
import multiprocessing.connection
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any


class Terminated(KeyboardInterrupt):
    """SIGTERM, which is handled as Ctrl-C is."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Handler of SIGTERM: often sent more than once, only the first counts."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise Terminated


# What raises KeyboardInterrupt where nobody else handles the signal.
INTERRUPTING = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: _interrupt}


class UninterruptedBlock:
    """
    Ctrl-C, or SIGTERM where it means the same, waits for the end of the block, so that nothing is left half done; a second
    Ctrl-C does not wait.

    Only in the main thread, where Python delivers signals, and only if nobody has replaced the handler.
    """

    def __enter__(self) -> UninterruptedBlock:
        self._asked: signal.Signals | None = None
        here = threading.current_thread() is threading.main_thread()
        self._replaced = {n: handler for n, handler in INTERRUPTING.items() if here and signal.getsignal(n) is handler}
        for number in self._replaced:
            signal.signal(number, self._note)
        return self

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._asked is not None:
            if number == signal.SIGINT:
                signal.default_int_handler(number, frame)
            return
        self._asked = signal.Signals(number)
        print("Ending after this update; Ctrl-C again ends at once.", file=sys.stderr, flush=True)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for number, handler in self._replaced.items():
            signal.signal(number, signal.SIG_IGN if number == self._asked == signal.SIGTERM else handler)
        if self._asked is not None and kind is None:
            raise Terminated if self._asked == signal.SIGTERM else KeyboardInterrupt


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """
    While the block runs, SIGTERM, which batch systems send before they kill, raises ``KeyboardInterrupt`` as Ctrl-C does.

    Only in the main thread, where Python delivers signals, and only if nobody else handles this one.
    """
    here = threading.current_thread() is threading.main_thread()
    replaced = here and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if replaced:
        signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        if replaced:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def threads_from_environment() -> int:
    """Threads that ``OMP_NUM_THREADS`` asks for, the first number where it is a list; 0 if it says nothing."""
    first = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return int(first) if first.isdecimal() else 0


def usable_cores() -> int:
    """
    Cores this process may use, which a batch system or ``taskset`` may have limited.

    :return: at least 1
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def starting_workers() -> Iterator[None]:
    """
    Processes that are started in the block hear Ctrl-C and SIGTERM only from :func:`prepare_worker` on. A terminal sends them
    to all of the group, and until the imports are done, seconds later, a process would end with a traceback.

    Windows has no signals that wait.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # the first process starts it, and Python before 3.12 lets the signals through thereby
    before = signal.pthread_sigmask(signal.SIG_BLOCK, INTERRUPTING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def prepare_worker() -> None:
    """
    To be called first in a worker process: Ctrl-C is for the parent, which ends its workers, and a parent that was killed,
    which cannot do so, takes its workers with it. Left alone they would stay in memory, or write into what is begun again.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, INTERRUPTING)  # those of the parent's that waited until now
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = mp.parent_process()
    assert parent is not None
    mp.connection.wait([parent.sentinel])
    os._exit(1)


def worker_pool(n_workers: int, prepare: Callable[..., None], *arguments: Any) -> ProcessPoolExecutor:
    """
    A pool of new processes, which are started by the first tasks; give it these within :func:`starting_workers`.

    :param n_workers: processes, at least 1; Windows has at most 61 of them
    :param prepare: called first in each, begins with :func:`prepare_worker`
    :param arguments: of ``prepare``
    :return: the pool, to be closed by :func:`end_workers`
    """
    size = min(n_workers, 61) if os.name == "nt" else n_workers
    return ProcessPoolExecutor(size, mp.get_context("spawn"), prepare, arguments)


def end_workers(executor: ProcessPoolExecutor) -> None:
    """
    End a pool's processes at once; what they are at is lost.

    :param executor: pool, which takes no more work afterwards
    """
    for process in list((executor._processes or {}).values()):  # shutdown alone would wait for what they are at
        process.kill()  # SIGTERM may be ignored there
    executor.shutdown(wait=True, cancel_futures=True)
