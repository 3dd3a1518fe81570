"""Is this an HDF5 file at all? Files that are something else, and errors of damaged ones, get a message that helps."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sb3_dce.errors import (
    DatasetError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetNotFoundError,
    DatasetSecurityError,
    SB3DCEError,
)
from sb3_dce.files import exists

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def read_head(path: Path) -> bytes:
    """
    The first bytes of a file, if it can be read and is not obviously something else than HDF5.

    :param path: file
    :return: at most 64 bytes
    :raises DatasetNotFoundError: if there is no such file
    :raises DatasetFormatError: if it is a folder, a zip archive or a pickle
    :raises DatasetError: if it may not be read
    """
    if not exists(path):
        raise DatasetNotFoundError("no such file", where=str(path), hint="Check the path", path=path)
    if path.is_dir():
        raise DatasetFormatError("a folder, not a file", where=str(path), hint="Name one .hdf5 file in it", path=path)
    if not path.is_file():  # a pipe would be waited for
        raise DatasetFormatError("a pipe or a device, not a file", where=str(path), hint="Name a file", path=path)
    try:
        with open(path, "rb") as file:
            head = file.read(64)
    except OSError as exc:
        mode = stat.filemode(os.stat(path).st_mode)
        what = f"cannot be read ({exc.strerror}; mode {mode})"
        raise DatasetError(what, where=str(path), hint="Change its mode", path=path) from exc
    if head.startswith(b"PK\x03\x04"):
        raise DatasetFormatError(
            "a zip archive, not HDF5",
            where=str(path),
            hint="A saved model is opened with its class's load(); arrays of NumPy belong into a file that ends in .npz",
            path=path,
        )
    if head[:1] == b"\x80" and head[1:2] <= b"\x05":  # protocols 2 to 5
        raise DatasetFormatError(
            "a pickle, not HDF5; opening a pickle runs code, so this is not done here",
            where=str(path),
            hint="Load it yourself if you trust it and give its arrays to Transitions.from_arrays",
            path=path,
        )
    return head


def not_hdf5(path: Path, head: bytes, hint: str) -> DatasetIntegrityError:
    """
    The error for a file that HDF5 cannot open.

    :param path: file
    :param head: its first bytes
    :param hint: where to get it again
    :return: exception to raise
    """
    if not head:
        what = "the file is empty (0 bytes)"
    elif not head.startswith(HDF5_SIGNATURE) and path.suffix.lower() not in (".hdf5", ".h5", ""):
        what = f"{path.suffix} is none of the formats that are read: HDF5 (.hdf5, .h5), .npz, .csv, .parquet"
        hint = "Give data frames and arrays to sb3_dce.load_dataset, or write one of these"
    elif not head.startswith(HDF5_SIGNATURE):
        what = f"not an HDF5 file: an error page? It begins with {head[:60]!r}"
    else:
        what = f"damaged or cut short: HDF5 cannot open its {path.stat().st_size:,} bytes"
    return DatasetIntegrityError(what, where=str(path), hint=hint, path=path)


@contextmanager
def translated_errors(path: Path, key: str | None = None, hint: str = "Download or copy the file again") -> Iterator[None]:
    """
    Turn whatever h5py raises on a damaged file into errors of this package.

    :param path: file, for messages
    :param key: array, for messages
    :param hint: what to do about it
    """
    where = str(path) if key is None else f"{path}, key {key}"
    try:
        yield
    except SB3DCEError:
        raise
    except TypeError as exc:
        what = f"a type that NumPy does not know ({exc})"
        raise DatasetFormatError(what, where=where, hint="Rewrite as float32 or bool", path=path, key=key) from exc
    except MemoryError as exc:
        what = "does not fit into the memory of this machine"
        raise DatasetSecurityError(what, where=where, hint="Use part of the data", path=path, key=key) from exc
    except (OSError, LookupError, ValueError, ArithmeticError, RuntimeError, AttributeError, SystemError) as exc:
        raise DatasetIntegrityError(f"damaged: {exc}", where=where, hint=hint, path=path, key=key) from exc
