"""Writing files so that a good one is never replaced by half a new one."""

from __future__ import annotations

import os
import pathlib
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from sb3_dce.errors import CheckpointError


@contextmanager
def write_atomically(target: pathlib.Path) -> Iterator[BinaryIO]:
    """
    A binary stream whose content appears under its name at once and whole, or not at all.

    :param target: file to write; missing folders are created
    :raises CheckpointError: if it cannot be written; a file that was there is untouched
    """
    temporary: str | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent)
        with os.fdopen(descriptor, "w+b") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o666 & ~_umask())  # mkstemp makes private files
        os.replace(temporary, target)
        temporary = None
    except OSError as error:
        raise _cannot_write(target, error) from error
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)


def check_writable(target: pathlib.Path) -> None:
    """
    :param target: file to be written later; missing folders are created
    :raises CheckpointError: if its folder cannot be made or written
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise _cannot_write(target, error) from error


def _cannot_write(target: pathlib.Path, error: OSError) -> CheckpointError:
    return CheckpointError(
        f"cannot write: {error.strerror or error}",
        where=str(target),
        path=target,
        hint="Check the folder's permissions and the free space, or choose another path.",
    )


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
