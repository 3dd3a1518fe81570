"""Hashes: of the numbers of a dataset, of its rows, and of the bytes of a file."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from functools import lru_cache
from os import PathLike
from pathlib import Path

import numpy as np

from sb3_dce.data.layout import CORE_KEYS, ArraySource, row_blocks

# Stands for all files of its folder where Minari keeps a file per episode.
METADATA_FILE = "metadata.json"


def content_hash(arrays: Mapping[str, ArraySource]) -> str:
    """
    Hash of the numbers, independent of compression and of keys that training does not read.

    SHA-256 over the core keys in sorted order, each as name, type, shape and little-endian bytes in C order.

    :param arrays: key to array, of NumPy or of an open file
    :return: 64 hexadecimal digits
    """
    digest = hashlib.sha256()
    for key in sorted(set(CORE_KEYS) & set(arrays)):
        array = arrays[key]
        dtype = np.dtype(array.dtype).newbyteorder("<")
        digest.update(f"{key}|{dtype.str}|{tuple(array.shape)}|".encode())
        for rows in row_blocks(array.shape[0]):
            digest.update(np.ascontiguousarray(array[rows], dtype=dtype).data)
    return digest.hexdigest()


def row_hashes(rows: np.ndarray) -> np.ndarray:
    """
    A 64-bit hash of the bits of each row, to find equal ones: a sum of the entries with random odd weights. The upper half is
    the better one, since the last bits of whole numbers are zero. No protection against anybody.

    :param rows: float32, shape (n, width)
    :return: uint64, shape (n,)
    """
    return np.asarray(np.einsum("ij,j->i", rows.view(np.uint32).astype(np.uint64), _odd_weights(rows.shape[1])))


def file_sha256(path: str | PathLike[str]) -> str:
    """
    Hash of the bytes of a file.

    :param path: file
    :return: SHA-256, 64 hexadecimal digits
    """
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()


def data_sha256(path: str | PathLike[str]) -> str:
    """
    Hash of all that a dataset is read from, by which results name it.

    :param path: file of the dataset; ``metadata.json`` stands for all files of its folder, whose names count, too
    :return: SHA-256, 64 hexadecimal digits
    """
    path = Path(path)
    if path.name != METADATA_FILE:
        return file_sha256(path)
    lines = (f"{file_sha256(file)}  {file.relative_to(path.parent).as_posix()}\n" for file in _files_of(path))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def data_state(path: str | PathLike[str]) -> tuple[tuple[int, int], ...]:
    """
    What tells, without reading a dataset, that it was written again since: sizes and times of the last change.

    :param path: file of the dataset, as for :func:`data_sha256`
    :return: bytes, and nanoseconds, of each of its files
    """
    return tuple((status.st_size, status.st_mtime_ns) for status in map(os.stat, _files_of(Path(path))))


def sha256_once(path: str | PathLike[str]) -> str:
    """
    :func:`data_sha256` for callers that ask for it again and again, since it takes a second for a large file.

    :param path: file of the dataset
    :return: 64 hexadecimal digits, from memory as long as sizes, times of change and inodes are what they were
    """
    inodes = tuple(os.stat(file).st_ino for file in _files_of(Path(path)))
    return _remembered(os.path.abspath(path), data_state(path), inodes)


@lru_cache(maxsize=64)
def _remembered(path: str, *_: object) -> str:
    return data_sha256(path)


def _files_of(path: Path) -> list[Path]:
    """The files of a dataset in the order of their names; hidden ones belong to others, and Minari skips those with ``_``."""
    if path.name != METADATA_FILE:
        return [path]
    inside = ((file, file.relative_to(path.parent)) for file in path.parent.rglob("*"))
    files = (file for file, name in inside if file.is_file() and not any(part[0] in "._" for part in name.parts))
    return sorted(files, key=Path.as_posix)  # the same order on every system


@lru_cache(maxsize=8)
def _odd_weights(n: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 2**63, n, dtype=np.uint64) * np.uint64(2) + np.uint64(1)
