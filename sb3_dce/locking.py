"""One process at a time: a lock that the system frees when its owner ends, however it ends."""

from __future__ import annotations

import json
import os
import socket
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TextIO

from sb3_dce.errors import LockedError, SB3DCEWarning

POLL_SECONDS = 0.1


@contextmanager
def exclusive(path: Path, *, limit: float = 3600.0, note: Callable[[str], None] | None = None) -> Iterator[None]:
    """
    Hold a lock file as :func:`held` does, after waiting for whoever holds it.

    :param path: lock file, in an existing folder
    :param limit: longest wait, seconds
    :param note: called once if there is something to wait for
    :raises LockedError: if the lock is not free after this time
    :raises OSError: if the folder cannot be written
    """
    deadline = time.monotonic() + limit
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(held(path))
                break
            except BlockingIOError as error:
                if note is not None:
                    note(f"waiting for {error}, which holds {path}")
                    note = None
                if time.monotonic() > deadline:
                    what = f"{error} has held this lock for more than {limit:,.0f} s"
                    raise LockedError(what, where=str(path), hint="End that process, or wait for it.", path=path) from error
            time.sleep(POLL_SECONDS)
        yield


@contextmanager
def held(path: Path) -> Iterator[None]:
    """
    Hold a lock that the system frees when the process ends, however it ends; nobody waits for it.

    :param path: lock file, in an existing folder; it is removed at the end
    :raises BlockingIOError: if another process holds it; its text is the owner
    :raises OSError: if the folder cannot be written
    """
    while True:
        file = _opened(path)
        try:
            if not _lock(file):
                raise BlockingIOError(_owner(path))
            if _same_file(file, path):
                break
        except BaseException:
            file.close()
            raise
        file.close()  # its owner has just removed it
    with file:
        if file.writable():
            file.truncate(0)
            json.dump({"pid": os.getpid(), "host": socket.gethostname()}, file)
            file.flush()
        try:
            yield
        finally:
            with suppress(OSError):  # Windows removes no open file
                path.unlink(missing_ok=True)


def _opened(path: Path) -> TextIO:
    """The file of another user, left by a process that was killed, can still be locked."""
    try:
        return open(path, "a+", encoding="utf-8")
    except PermissionError:
        if not os.path.isfile(path):
            raise
        return open(path, encoding="utf-8")


def _lock(file: TextIO) -> bool:
    """Whether the lock is ours now; also, with a warning, where the file system has none, as some network disks."""
    if sys.platform == "win32":
        import msvcrt

        file.seek(2**20)  # beyond the text, which others may read
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        text = f"{file.name}: this file system has no locks ({error.strerror}); let one process at a time work there"
        warnings.warn(text, SB3DCEWarning)
    return True


def _same_file(file: TextIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _owner(path: Path) -> str:
    try:
        owner = json.loads(path.read_bytes())
        return f"process {int(owner['pid'])} on {owner['host']}"
    except (OSError, ValueError, LookupError, TypeError, RecursionError):  # not yet written, or removed meanwhile
        return "another process"
