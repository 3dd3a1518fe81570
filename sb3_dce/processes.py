"""Worker processes that live no longer than they are wanted."""

from __future__ import annotations

import multiprocessing as mp
import multiprocessing.connection
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from types import FrameType


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

    :return: at least 1; at most 61 on Windows, where a pool takes no more
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    cores = os.cpu_count() or 1
    return min(cores, 61) if os.name == "nt" else cores


def prepare_worker() -> None:
    """
    To be called first in a worker process: Ctrl-C is for the parent, which ends its workers, and a parent that was killed,
    which cannot do so, takes its workers with it. Left alone they would stay in memory, or write into what is begun again.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = mp.parent_process()
    assert parent is not None
    mp.connection.wait([parent.sentinel])
    os._exit(1)


def end_workers(executor: ProcessPoolExecutor) -> None:
    """
    End a pool's processes at once; what they are at is lost.

    :param executor: pool, which takes no more work afterwards
    """
    for process in list((executor._processes or {}).values()):  # shutdown alone would wait for what they are at
        process.terminate()
    executor.shutdown(wait=True, cancel_futures=True)
