"""
NPZ files with the keys of D4RL. Like HDF5 they come from the internet and are treated as hostile.

NumPy's own loader believes the header of an array when it allocates, and unpickles if it is allowed to. Here nothing is ever
unpickled, and the size in the header has to agree with that of the archive before memory is allocated.
"""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import prod
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.lib import format as npy

from sb3_dce.data.file_checks import translated_errors
from sb3_dce.data.hdf5 import DEFAULT_MAX_BYTES, MAX_OBJECTS, MAX_RATIO, RATIO_APPLIES_ABOVE
from sb3_dce.data.layout import wanted_keys
from sb3_dce.data.locate import require_file
from sb3_dce.data.memory import require_memory
from sb3_dce.errors import DatasetError, DatasetFormatError, DatasetIntegrityError, DatasetSecurityError
from sb3_dce.files import write_atomically

_READ_BYTES = 2**20
_MAX_HEADER_BYTES = 10_000  # NumPy's own limit, which it looks at when it has read the header
_MAX_TEXT_BYTES = 2**16
_MAX_DIRECTORY_BYTES = 4 * 2**20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def arrays_from_npz(path: str | PathLike[str], *, max_bytes: int = DEFAULT_MAX_BYTES) -> dict[str, np.ndarray]:
    """
    The arrays of an NPZ file that training uses; other members are not read.

    :param path: file written with ``numpy.savez`` or ``numpy.savez_compressed``
    :param max_bytes: largest total size of these arrays, uncompressed
    :return: those of :func:`~sb3_dce.data.layout.wanted_keys` that are there
    :raises DatasetSecurityError: for pickled objects, odd or repeated member names, and sizes that are too large or contradict
        each other
    :raises DatasetFormatError: if it is no NPZ file, or a member is no array of numbers
    :raises DatasetIntegrityError: if it is damaged
    """
    path = require_file(path)
    with translated_errors(path), open(path, "rb") as file:
        _check_signature(file, path)
        _check_directory(file, path)
        with _zip_errors(path), zipfile.ZipFile(file) as archive:
            members = _select(archive.infolist(), path, max_bytes)
            for info in archive.infolist():  # a damaged name would pass for an array that is not there
                archive.open(info).close()
            return {key: _read_member(archive, member, key, path) for key, member in members.items()}


def text_from_npz(path: str | PathLike[str], key: str) -> str | None:
    """
    Read a text that stands beside the arrays, such as the bounds of the actions; nothing is unpickled.

    :param path: file that :func:`arrays_from_npz` has read
    :param key: name of a member without dimensions, as :func:`write_npz` stores a text
    :return: the text, empty if the member holds something else; ``None`` if it is not there
    """
    value = _small_member(path, key)
    if value is None:
        return None
    return str(value) if value.dtype.kind == "U" and value.shape == () else ""


def flag_from_npz(path: str | PathLike[str], key: str) -> bool:
    """
    Whether a file carries a mark such as ``generated``, which keeps it from passing for an official one.

    :param path: file that :func:`arrays_from_npz` has read
    :param key: name of a member without dimensions, as :func:`write_npz` stores a truth value
    :return: whether it is there and true
    """
    value = _small_member(path, key)
    return value is not None and value.dtype.kind in "biu" and value.shape == () and bool(value)


def _small_member(path: str | PathLike[str], key: str) -> np.ndarray | None:
    """A member as an array, empty if it is large or none; ``None`` if it is not there."""
    path = Path(path)
    with translated_errors(path), _zip_errors(path), zipfile.ZipFile(path) as archive:
        infos = {info.filename: info for info in archive.infolist()}
        info = infos.get(f"{key}.npy")
        if info is None:
            return None
        _check_method(info, path, key)
        with archive.open(info) as stream:
            head = io.BytesIO(stream.read(_MAX_TEXT_BYTES))
    try:
        return npy.read_array(head, allow_pickle=False, max_header_size=_MAX_HEADER_BYTES)
    except (ValueError, TypeError, SyntaxError, tokenize.TokenError, MemoryError, RecursionError):
        return np.empty(0)


def npz_keys(path: str | PathLike[str]) -> list[str]:
    """
    Names of all members of an NPZ file, for messages.

    :param path: file that :func:`arrays_from_npz` has read
    :return: names without ``.npy``
    """
    with zipfile.ZipFile(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def write_npz(path: str | PathLike[str], arrays: Mapping[str, np.ndarray], attrs: Mapping[str, Any] | None = None) -> None:
    """
    Write arrays, uncompressed. An existing file is replaced only when the new one is complete.

    :param path: file to write
    :param arrays: key to array
    :param attrs: numbers and texts, stored as members without dimensions
    """
    with write_atomically(Path(path)) as stream:
        members: dict[str, Any] = {**(attrs or {}), **arrays}
        np.savez(stream, **members)


class _Header(NamedTuple):
    """Header of an array."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]


def _check_signature(file: BinaryIO, path: Path) -> None:
    head = file.read(8)
    file.seek(0)
    if head[:2] == b"PK":
        return
    if head[:1] == b"\x80" and head[1:2] <= b"\x05":
        what = "a pickle, not NPZ; opening a pickle runs code, so this is not done here"
        hint = "Load it yourself if you trust it and give its arrays to Transitions.from_arrays"
        raise DatasetSecurityError(what, where=str(path), hint=hint, path=path)
    if head.startswith(npy.MAGIC_PREFIX):
        hint = "Load it with numpy.load and give the arrays to Transitions.from_arrays"
        raise DatasetFormatError("a single .npy array, not NPZ", where=str(path), hint=hint, path=path)
    what = f"not an NPZ file, it begins with {head!r}" if head else "the file is empty (0 bytes)"
    raise DatasetIntegrityError(what, where=str(path), hint="Download or copy it again", path=path)


def _check_directory(file: BinaryIO, path: Path) -> None:
    """Refuse an archive with too many members, which ``zipfile`` would read all at once."""
    with translated_errors(path):
        end = zipfile._EndRecData(file)  # type: ignore[attr-defined]  # position 5 is the size of the directory
    file.seek(0)
    if end and end[5] > _MAX_DIRECTORY_BYTES:
        what = f"more than {MAX_OBJECTS:,} members, or very long names: their list has {end[5]:,} bytes"
        raise DatasetSecurityError(what, where=str(path), hint="Write the arrays again with numpy.savez", path=path)


@contextmanager
def _zip_errors(path: Path) -> Iterator[None]:
    """Errors of damaged archives that are not built-in ones."""
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, EOFError) as exc:
        raise DatasetIntegrityError(
            f"damaged: {exc or 'cut short'}", where=str(path), hint="Download or copy the file again", path=path
        ) from exc


def _select(infos: Iterable[zipfile.ZipInfo], path: Path, max_bytes: int) -> dict[str, zipfile.ZipInfo]:
    """Members with the keys of a dataset, after checking the names of all and the declared sizes of these."""
    infos = list(infos)
    names = [info.orig_filename.removesuffix(".npy") for info in infos]
    odd = next((name for name in names if _is_odd(name)), None)
    twice = [name for name, count in Counter(names).items() if count > 1]
    if odd is not None or twice or len(names) > MAX_OBJECTS:
        what = f"more than {MAX_OBJECTS:,} members"
        if odd is not None:
            what = f"a member is called {odd[:60]!r}, which leads out of the archive"
        elif twice:
            what = f"member {twice[0][:60]!r} is there more than once"
        raise DatasetSecurityError(what, where=str(path), hint="Write the arrays again with numpy.savez", path=path)
    wanted = wanted_keys(names)
    members = {name: info for name, info in zip(names, infos, strict=True) if name in wanted}
    total = sum(info.file_size for info in members.values())
    if total > max_bytes:
        raise DatasetSecurityError(
            f"the arrays declare {total:,} bytes, the limit is {max_bytes:,}",
            where=str(path),
            hint=f"If the file is honest, pass max_bytes={total}",
            path=path,
        )
    require_memory(total, "the arrays", str(path), "Use part of the data")
    for key, info in members.items():
        if info.file_size > RATIO_APPLIES_ABOVE and info.file_size > MAX_RATIO * info.compress_size:
            what = f"declares {info.file_size:,} bytes but stores {info.compress_size:,}; data do not compress so well"
            raise _error(DatasetSecurityError, what, path, key, "Rewrite the file with numpy.savez if it is honest")
        _check_method(info, path, key)
    return members


def _check_method(info: zipfile.ZipInfo, path: Path, key: str) -> None:
    if info.compress_type not in _METHODS or info.flag_bits & 1:
        what = "encrypted, or compressed in a way NumPy does not use"
        raise _error(DatasetFormatError, what, path, key, "Write the arrays again with numpy.savez")


def _is_odd(name: str) -> bool:
    return not name or name.startswith("/") or ".." in PurePosixPath(name).parts or any(mark in name for mark in "\\:\0")


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, key: str, path: Path) -> np.ndarray:
    with archive.open(info) as stream:
        header = _read_header(stream, key, path)
        declared, stored = prod(header.shape) * header.dtype.itemsize, info.file_size - stream.tell()
        if declared != stored or min(header.shape, default=0) < 0:
            what = f"its header declares {declared:,} bytes (shape {header.shape}), the archive {stored:,}"
            raise _error(DatasetSecurityError, what, path, key, "Write the arrays again with numpy.savez")
        data = bytearray(stored)
        view, end = memoryview(data), 0
        while block := stream.read(min(_READ_BYTES, stored - end)):
            view[end : end + len(block)] = block
            end += len(block)
    if end != stored:
        raise _error(DatasetIntegrityError, f"cut short after {end:,} of {stored:,} bytes", path, key, "Copy the file again")
    flat = np.frombuffer(data, dtype=header.dtype)
    flat = flat.astype(header.dtype.newbyteorder("="), copy=False)
    return flat.reshape(header.shape, order="F" if header.fortran_order else "C")


def _read_header(stream: Any, key: str, path: Path) -> _Header:
    """Header of an array of numbers; the stream then stands at its first byte."""
    try:
        version = npy.read_magic(stream)
        size = stream.read(2 if version == (1, 0) else 4)
        if int.from_bytes(size, "little") > _MAX_HEADER_BYTES:
            raise ValueError("too long")
        text = io.BytesIO(size + stream.read(int.from_bytes(size, "little")))
        header = _Header(*(npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(text))
    except (ValueError, TypeError, SyntaxError, tokenize.TokenError, MemoryError, RecursionError) as exc:
        what = "its header is not that of a NumPy array"
        raise _error(DatasetSecurityError, what, path, key, "Write the arrays again with numpy.savez") from exc
    if header.dtype.hasobject:
        what = "holds Python objects, which only a pickle can store; opening a pickle runs code"
        hint = "Load it yourself if you trust it and save arrays of numbers"
        raise _error(DatasetSecurityError, what, path, key, hint)
    if header.dtype.kind not in "fiub":
        what = f"has type {header.dtype}"
        raise _error(DatasetFormatError, what, path, key, "Store float32 numbers and bool flags, one array per key")
    return header


def _error(kind: type[DatasetError], what: str, path: Path, key: str, hint: str) -> DatasetError:
    return kind(what, where=f"{path}, key {key}", hint=hint, path=path, key=key)
