"""One process at a time: a lock file that outlives neither its owner's work nor its owner's death."""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from sb3_dce.errors import DownloadError
from sb3_dce.files import process_lives

POLL_SECONDS = 0.1
# Between looking at a dead process's lock and removing it; who dies in between leaves this file behind.
_TAKEOVER_SECONDS = 10.0


@contextmanager
def exclusive(path: Path, *, limit: float = 3600.0, note: Callable[[str], None] | None = None) -> Iterator[None]:
    """
    Hold a lock file. A lock is waited for, unless its owner was a process of this machine that lives no more.

    :param path: lock file, in an existing folder
    :param limit: longest wait, seconds
    :param note: called once if there is something to wait for
    :raises DownloadError: if the lock is not free after this time
    :raises OSError: if the folder cannot be written
    """
    deadline = time.monotonic() + limit
    while not _create(path):
        if _is_abandoned(path):
            _remove_abandoned(path)
            continue
        if note is not None:
            note(f"waiting for {_owner(path)}, which holds {path}")
            note = None
        if time.monotonic() > deadline:
            raise DownloadError(
                f"{_owner(path)} has held this lock for more than {limit:,.0f} s",
                where=str(path),
                hint="Delete it if that process is gone.",
                path=path,
            )
        time.sleep(POLL_SECONDS)
    try:
        yield
    finally:
        if _read(path) == _own():  # not that of another one, if somebody has deleted ours
            path.unlink(missing_ok=True)


@contextmanager
def held(path: Path) -> Iterator[None]:
    """
    Hold a lock that the system frees when the process ends, however it ends; nobody waits for it.

    :param path: lock file, in an existing folder; it is removed at the end
    :raises BlockingIOError: if another process holds it; its text is the owner
    :raises OSError: if the folder cannot be written
    """
    while True:
        file = open(path, "a+", encoding="utf-8")
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
        file.truncate(0)
        _write_owner(file)
        file.flush()
        try:
            yield
        finally:
            with suppress(OSError):  # Windows removes no open file
                path.unlink(missing_ok=True)


def _lock(file: TextIO) -> bool:
    """Whether the lock is ours now; also where the file system has none, as some network disks."""
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
    except OSError:
        pass
    return True


def _same_file(file: TextIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _create(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    except FileExistsError:
        return False
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            _write_owner(file)
    except OSError:
        path.unlink(missing_ok=True)
        raise
    return True


def _write_owner(file: TextIO) -> None:
    pid, host, started = _own()
    json.dump({"pid": pid, "host": host, "started": started}, file)


def _own() -> tuple[int, str, str | None]:
    return os.getpid(), socket.gethostname(), _started(os.getpid())


def _started(pid: int) -> str | None:
    """
    When a process began, in the kernel's clock: a number may be in use again. None where the system does not tell; "dead" for
    one that has ended and was not asked for its result.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        return "dead" if fields[0] in ("Z", "X") else fields[19]
    except (OSError, IndexError):
        return None


def _read(path: Path) -> tuple[int, str, str | None] | None:
    """Process, machine and beginning of the owner; None if the lock is gone, or not yet or never written."""
    try:
        owner = json.loads(path.read_bytes())
        return int(owner["pid"]), str(owner["host"]), owner.get("started")
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None


def _owner(path: Path) -> str:
    owner = _read(path)
    return "another process" if owner is None else f"process {owner[0]} on {owner[1]}"


def _is_abandoned(path: Path) -> bool:
    owner = _read(path)
    if owner is None:  # a process that dies before it has written its name leaves an empty lock
        return _age(path) > _TAKEOVER_SECONDS
    pid, host, started = owner
    if host != socket.gethostname():
        return False
    if not process_lives(pid):
        return True
    now = _started(pid)
    other = started is not None and now is not None and started != now
    return other or pid <= 0  # no process has such a number


def _age(path: Path) -> float:
    """Seconds since a file was written, 0 if it is gone."""
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _remove_abandoned(path: Path) -> None:
    """Only the owner of a second lock may look again and remove: else the lock of a faster waiter could be removed."""
    guard = path.with_name(f"{path.name}.takeover")
    if not _create(guard):
        if _age(guard) > _TAKEOVER_SECONDS:
            guard.unlink(missing_ok=True)
        time.sleep(POLL_SECONDS)
        return
    try:
        if _is_abandoned(path):
            path.unlink(missing_ok=True)
    finally:
        guard.unlink(missing_ok=True)
