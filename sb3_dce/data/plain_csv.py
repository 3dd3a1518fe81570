"""
The numbers of a plain CSV file, read by pandas' parser, which is five times faster than Python's.

pandas is lenient where this package is not: it pads short lines, ends cells at a zero byte and skips lines of blanks. So the
bytes are looked at first, and whatever is not plain is left to the reader of :mod:`~sb3_dce.data.tables`, record by record,
which also finds the line and the column of an error.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sb3_dce.data.memory import require_memory

_SEPARATORS = ",;\t|"
_BLOCK_BYTES = 2**23
_FLAG_WORDS = {"false": "0", "true": "1"}


def numbers_of(cells: Sequence[str]) -> list[float] | None:
    """
    Convert cells to numbers as Python does, but without what only Python knows, such as ``1_000`` or digits of other scripts.

    :param cells: texts
    :return: their numbers; None if one is none, or is written in a way that only Python takes for a number
    """
    text = "".join(cells)
    if "_" in text or "\n" in text or "\r" in text or not text.isascii():
        return None
    try:
        return list(map(float, cells))
    except ValueError:
        return None


def without_word(flag: str) -> str:
    """
    Write a flag as a digit if it is a word, so that False/True and 0/1 are read alike.

    :param flag: text of a flag
    :return: 0 or 1 for False or True in any spelling, else the same text
    """
    return _FLAG_WORDS.get(flag.lower(), flag)


def read_plain(
    path: Path,
    sep: str,
    skip_lines: int,
    n_columns: int,
    cells: Sequence[int],
    flags: Sequence[int],
    ids: Sequence[int] = (),
) -> np.ndarray | None:
    """
    Numbers of a table without quotes in which each line has the same number of cells.

    :param path: file, UTF-8
    :param sep: separator, one character
    :param skip_lines: lines of the column names
    :param n_columns: cells of each line
    :param cells: positions of the wanted columns, in the order of the result
    :param flags: which of these are flags, as indices of ``cells``
    :param ids: which of these are ids, texts that are given numbers
    :return: shape (rows, len(cells)), float64; None if the file is not plain, or a cell is no number or no flag
    """
    flag_cells, id_cells = {cells[n] for n in flags}, {cells[n] for n in ids}
    others = {cell for n, cell in enumerate(cells) if n not in (*flags, *ids)}
    if len(flag_cells) + len(id_cells) + len(others) != len(set(cells)):
        return None  # one column is two of these, so it has two ways of reading
    if sep not in _SEPARATORS or n_columns < 2:
        return None
    with open(path, "rb") as file:
        head = b"".join(file.readline() for _ in range(skip_lines))
        if _has_single_returns(head):
            return None
        n_rows = _count_rows(file, sep, n_columns)
        if not n_rows:
            return None
        require_memory(8 * n_rows * len(cells), f"{n_rows:,} rows", str(path), "Use part of the data")
        file.seek(len(head))
        return _parse(file, sep, n_rows, cells, flag_cells, id_cells)


def _count_rows(file: BinaryIO, sep: str, n_columns: int) -> int | None:
    """Number of lines up to the end of the file; None if one of them is not plain."""
    others = bytes(set(range(256)) - set(f"{sep}\n".encode()))
    line_marks = f"{sep * (n_columns - 1)}\n".encode()
    n_rows = 0
    for block in _blocks(file):
        marks = block.translate(None, others)
        n_lines = len(marks) // n_columns
        if marks != line_marks * n_lines or not _is_plain(block, sep):
            return None
        n_rows += n_lines
    return n_rows


def _blocks(file: BinaryIO) -> Iterator[bytes]:
    """Whole lines, each with its end."""
    while block := file.read(_BLOCK_BYTES):
        block += file.readline(_BLOCK_BYTES)  # a line that is longer is not plain
        yield block if block.endswith(b"\n") else block + b"\n"


def _is_plain(block: bytes, sep: str) -> bool:
    """Whether pandas and :mod:`csv` cut these lines into the same cells."""
    blanks_before_cells = b"\t" in block and sep != "\t"  # skipped by pandas only
    if b'"' in block or b"\0" in block or blanks_before_cells or _has_single_returns(block):
        return False
    try:
        block.isascii() or block.decode()
    except UnicodeDecodeError:
        return False
    return not _has_line_longer_than(csv.field_size_limit(), block)


def _has_single_returns(block: bytes) -> bool:
    return b"\r" in block and block.count(b"\r") != block.count(b"\r\n")


def _has_line_longer_than(limit: int, block: bytes) -> bool:
    start = 0
    while start + limit < len(block):
        start = block.rfind(b"\n", start, start + limit) + 1
        if start == 0:
            return True
    return False


def _parse(
    file: BinaryIO, sep: str, n_rows: int, cells: Sequence[int], flag_cells: Collection[int], id_cells: Collection[int]
) -> np.ndarray | None:
    import pandas as pd

    texts = {*flag_cells, *id_cells}
    known: dict[int, dict[str, int]] = {cell: {} for cell in id_cells}
    options: dict[str, Any] = {
        "dtype": {cell: str if cell in texts else np.float64 for cell in cells},
        "keep_default_na": False,
        "na_values": ["nan", "NaN", "NAN"],
    }
    if tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1):
        options["float_precision"] = "round_trip"  # exact digits; the default of later versions, which deprecate the option
    matrix = np.empty((n_rows, len(cells)))
    end = 0
    try:
        for block in _blocks(file):
            frame = pd.read_csv(
                io.BytesIO(block),
                sep=sep,
                header=None,
                index_col=False,
                usecols=sorted(set(cells)),
                skipinitialspace=True,
                quoting=csv.QUOTE_NONE,
                engine="c",
                low_memory=False,
                **options,
            )
            # pandas makes 1.0 of True if a whole column consists of such words; then the first line has one, too.
            first = block[: block.index(b"\n")].decode().split(sep)
            if numbers_of([first[cell] for cell in cells if cell not in texts]) is None:
                return None
            start, end = end, end + len(frame)
            for n, cell in enumerate(cells):
                if cell in texts:
                    codes, found = pd.factorize(frame[cell])
                    matrix[start:end, n] = _flags(codes, found) if cell in flag_cells else _ids(codes, found, known[cell])
                else:
                    matrix[start:end, n] = frame[cell]
    except ValueError:  # a cell that is not a number, or not a flag; pandas' ParserError is one, too
        return None
    return matrix if end == n_rows else None


def _flags(codes: np.ndarray, texts: Iterable[str]) -> np.ndarray:
    """
    Numbers of the flags of a column, given as positions in its few texts; a missing one is at -1.

    :raises ValueError: if one of them is not 0 or 1
    """
    numbers = numbers_of([without_word(text) for text in texts])
    if numbers is None or not set(numbers) <= {0.0, 1.0} or (codes < 0).any():
        raise ValueError("not a flag")
    return np.array(numbers)[codes]


def _ids(codes: np.ndarray, texts: Iterable[str], known: dict[str, int]) -> np.ndarray:
    """
    Numbers of the ids of a column, the same for the same text in all blocks.

    :raises ValueError: if one is missing
    """
    names = [text.strip() for text in texts]
    if "" in names or (codes < 0).any():
        raise ValueError("no id")
    return np.array([known.setdefault(name, len(known)) for name in names])[codes]
