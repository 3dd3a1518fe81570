"""Worker processes that live no longer than they are wanted."""

from __future__ import annotations

import multiprocessing as mp
import multiprocessing.connection
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class UninterruptedBlock:
    """
    Ctrl-C waits for the end of the block, so that nothing is left half done; a second one does not wait.

    Only in the main thread, where Python delivers it, and only if nobody has replaced Python's own handler.
    """

    def __enter__(self) -> UninterruptedBlock:
        self._asked = False
        here = threading.current_thread() is threading.main_thread()
        self._replaced = here and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if self._replaced:
            signal.signal(signal.SIGINT, self._note)
        return self

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._asked:
            signal.default_int_handler(number, frame)
        self._asked = True
        print("Ending after this update; Ctrl-C again ends at once.", file=sys.stderr, flush=True)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._replaced:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        if self._asked and kind is None:
            raise KeyboardInterrupt


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """
    While the block runs, SIGTERM, which batch systems send before they kill, raises ``KeyboardInterrupt`` as Ctrl-C does.

    Only in the main thread, where Python delivers signals, and only if nobody else handles this one.
    """
    here = threading.current_thread() is threading.main_thread()
    replaced = here and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if replaced:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        if replaced:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def threads_from_environment() -> int:
    """
    :return: what ``OMP_NUM_THREADS`` says, the first number where it is a list; 0 if it says nothing
    """
    first = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return int(first) if first.isdecimal() else 0


def usable_cores() -> int:
    """
    :return: cores this process may use, which a batch system or ``taskset`` may have limited; at most 61 on Windows, where a
        pool takes no more
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
