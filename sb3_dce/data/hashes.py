"""Hashes: of the numbers of a dataset, of its rows, and of the bytes of a file."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from functools import lru_cache
from os import PathLike

import numpy as np

from sb3_dce.data.layout import CORE_KEYS, ArraySource, row_blocks


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


def sha256_once(path: str | PathLike[str]) -> str:
    """
    SHA-256 of a file for callers that ask for it again and again, since :func:`file_sha256` takes a second for a large one.

    :param path: file
    :return: 64 hexadecimal digits, from memory as long as size, time of change and inode are what they were
    """
    state = os.stat(path)
    return _remembered(os.path.abspath(path), state.st_size, state.st_mtime_ns, state.st_ino)


@lru_cache(maxsize=64)
def _remembered(path: str, *_: int) -> str:
    return file_sha256(path)


@lru_cache(maxsize=8)
def _odd_weights(n: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 2**63, n, dtype=np.uint64) * np.uint64(2) + np.uint64(1)
