"""Worker processes that live no longer than they are wanted."""

from __future__ import annotations

import multiprocessing as mp
import multiprocessing.connection
import os
import signal
import threading


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
