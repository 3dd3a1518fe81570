"""Writing files so that a good one is never replaced by half a new one."""

from __future__ import annotations

import contextlib
import errno
import glob
import os
import pathlib
import shlex
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import BinaryIO

from sb3_dce.errors import CheckpointError, DatasetError


@contextmanager
def write_atomically(target: pathlib.Path) -> Iterator[BinaryIO]:
    """
    A binary stream whose content appears under its name at once and whole, or not at all.

    :param target: file to write, or a link to it; missing folders are created
    :raises CheckpointError: if it cannot be written; a file that was there is untouched
    """
    temporary: str | None = None
    target = _followed(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(target)
        prefix = f".{target.name}.{os.getpid()}."
        descriptor, temporary = tempfile.mkstemp(prefix=prefix, suffix=".tmp", dir=target.parent)
        with os.fdopen(descriptor, "w+b") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o666 & ~_umask())  # mkstemp makes private files
        os.replace(temporary, target)
        temporary = None
        sync_folder(target.parent)
    except OSError as error:
        raise cannot_write(target, error) from error
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)


def _followed(target: pathlib.Path) -> pathlib.Path:
    """The file that a link leads to, there or not: replaced by a new file it would be a link no more."""
    return pathlib.Path(os.path.realpath(target)) if os.path.islink(target) else target


def exists(path: str | PathLike[str]) -> bool:
    """
    Whether there is something at a path; a folder that may not be entered is an error, not a "no".

    :param path: any
    :return: false, too, for what can be no path
    :raises DatasetError: if a folder on the way may not be entered, so that nobody can tell
    """
    try:
        os.stat(path)
    except PermissionError as error:
        what = "cannot be reached: a folder on the way may not be entered"
        hint = "Change the mode of that folder, or copy the file to another"
        raise DatasetError(what, where=str(path), hint=hint, path=pathlib.Path(path)) from error
    except (OSError, ValueError):
        return False
    return True


def write_text(target: pathlib.Path, text: str) -> None:
    """
    Write a text in UTF-8 by :func:`write_atomically`.

    :param target: file to write; missing folders are created
    :param text: its content
    :raises CheckpointError: if it cannot be written; a file that was there is untouched
    """
    with write_atomically(target) as stream:
        stream.write(text.encode())


# Younger files may be those of a process on another machine.
ABANDONED_SECONDS = 600.0


def _remove_abandoned(target: pathlib.Path) -> None:
    """What processes that were killed while they wrote this file have left."""
    for path in target.parent.glob(f".{glob.escape(target.name)}.*.tmp"):
        pid = path.name.removeprefix(f".{target.name}.").partition(".")[0]
        with contextlib.suppress(OSError):
            if pid.isdecimal() and not process_lives(int(pid)) and time.time() - path.stat().st_mtime > ABANDONED_SECONDS:
                path.unlink()


def process_lives(pid: int) -> bool:
    """
    Whether a process of this number runs; a half-written file of one that does is left alone.

    :param pid: number of a process of this machine
    :return: whether there is one, of whichever user; always true on Windows, where nothing can be asked without harm
    """
    if os.name == "nt":  # os.kill would end it
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        pass
    return True


def sync_folder(folder: pathlib.Path) -> None:
    """
    Make a new name in a folder survive a power cut, too; not every system can.

    :param folder: existing folder
    """
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def expanded(path: str | PathLike[str]) -> pathlib.Path:
    """
    A path as the user's shell would read its ``~``, for paths from arguments and the environment.

    :param path: may begin with ``~`` or ``~user``
    :return: with their home folder in its place, unless there is none
    """
    try:
        return pathlib.Path(path).expanduser()
    except RuntimeError:
        return pathlib.Path(path)


def quoted(path: str | PathLike[str]) -> str:
    """
    A path as one word on a command line of this system, for commands that are shown to be copied.

    :param path: file
    :return: with quotation marks where they are needed
    """
    return subprocess.list2cmdline([str(path)]) if os.name == "nt" else shlex.quote(str(path))


def check_writable(target: pathlib.Path) -> None:
    """
    Refuse a file that could not be written, before the work whose result it gets.

    :param target: file to be written later; missing folders are created
    :raises CheckpointError: if it is a folder, or its folder cannot be made or written
    """
    target = _followed(target)
    try:
        if target.is_dir():
            hint = "Name a file in it, or rename the folder."
            raise CheckpointError("a folder is no file to write", where=str(target), path=target, hint=hint)
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise cannot_write(target, error) from error


# Why a write fails that is nobody's mistake: no space, the user's share of it used up, a disk that became read-only.
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def cannot_write(target: pathlib.Path, error: OSError) -> CheckpointError:
    """
    The package's error for a failed write, with the system's reason and what to look at; the caller raises it.

    :param target: file that was to be written
    :param error: why it was not
    :return: the error in words
    """
    return CheckpointError(
        f"cannot write: {error.strerror or error}",
        where=str(target),
        path=target,
        hint="Check the folder's permissions and the free space, or choose another path.",
    )


def cannot_read(path: pathlib.Path, error: OSError) -> CheckpointError:
    """
    The package's error for a file of a run that the system does not give; nothing says that it is damaged.

    :param path: file
    :param error: why it was not read
    :return: the error in words, for the caller to raise
    """
    hint = "Check the permissions of the run's folder and its disk; the same command goes on then."
    return CheckpointError(f"the file cannot be read: {error.strerror or error}", where=str(path), path=path, hint=hint)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
