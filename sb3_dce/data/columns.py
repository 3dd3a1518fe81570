"""Copying arrays into the row matrix block by block, and what can be learnt about them on the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_dce.data.layout import ArraySource, block_rows_of, row_blocks
from sb3_dce.errors import DatasetFormatError, DatasetSemanticsError

_FLOAT32_MAX = float(np.finfo(np.float32).max)
# Integers beyond this are not exact in float32.
_EXACT_INTEGERS = 2**24
FOLDED_ROWS = 64


@dataclass(eq=False)
class ColumnSummary:
    """
    Extremes of the columns of one array, and its values that are not finite.

    :param key: name of the array
    :param low: smallest finite value of each column, shape (width,)
    :param high: largest finite value of each column, shape (width,)
    :param n_bad: number of NaN and infinite values
    :param first_bad: row and column of the first one
    """

    key: str
    low: np.ndarray
    high: np.ndarray
    n_bad: int = 0
    first_bad: tuple[int, int] | None = None

    @property
    def largest(self) -> float:
        """Largest absolute value of the array among those that are finite; infinite if a column has no finite one."""
        return float(max(np.abs(self.low).max(), np.abs(self.high).max()))


def copy_columns(source: ArraySource, target: np.ndarray, key: str, where: str) -> ColumnSummary:
    """
    Copy an array into columns of the row matrix, as float32.

    :param source: shape (rows, width), or (rows,) for width 1
    :param target: columns of the row matrix, shape (rows, width)
    :param key: name, for messages
    :param where: file, for messages
    :return: extremes, and values that are not finite
    :raises DatasetSemanticsError: if a finite value does not fit into float32
    :raises DatasetFormatError: if an integer would be rounded
    """
    width = target.shape[1]
    summary = ColumnSummary(key, np.full(width, np.inf), np.full(width, -np.inf))
    for rows in row_blocks(len(target), block_rows_of(source)):
        block = np.asarray(source[rows]).reshape(-1, width)
        low, high = (_extreme(block, which).astype(np.float64) for which in (np.minimum, np.maximum))
        if not (np.isfinite(low) & np.isfinite(high)).all():
            low, high = _note_bad_values(block, rows.start, summary)
        np.minimum(summary.low, low, out=summary.low)
        np.maximum(summary.high, high, out=summary.high)
        if max(-low.min(), high.max()) > _FLOAT32_MAX:
            _raise_too_large(block, rows.start, key, where)
        target[rows] = block
    if source.dtype.kind in "iu" and summary.largest > _EXACT_INTEGERS:
        raise DatasetFormatError(
            f"integers up to {summary.largest:.0f} are not exact in float32, {_EXACT_INTEGERS} is the limit",
            where=f"{where}, key {key}",
            hint="Scale the values and store them as float32",
            key=key,
        )
    return summary


def _extreme(block: np.ndarray, which: np.ufunc) -> np.ndarray:
    """
    Smallest or largest value of each column, NaN if there is one. Columns are narrow: many rows taken as one long row are
    compared nine times faster than row by row.
    """
    width, n_folded = block.shape[1], len(block) // FOLDED_ROWS
    if n_folded == 0:
        return np.asarray(which.reduce(block, axis=0))
    cut = n_folded * FOLDED_ROWS
    folded = which.reduce(block[:cut].reshape(n_folded, FOLDED_ROWS * width), axis=0)
    return np.asarray(which.reduce(np.concatenate([folded.reshape(FOLDED_ROWS, width), block[cut:]]), axis=0))


def _note_bad_values(block: np.ndarray, start: int, summary: ColumnSummary) -> tuple[np.ndarray, np.ndarray]:
    """Count the values that are not finite; return the extremes of the others."""
    bad = ~np.isfinite(block)
    summary.n_bad += int(bad.sum())
    if summary.first_bad is None:
        row, column = np.argwhere(bad)[0]
        summary.first_bad = (start + int(row), int(column))
    low = np.where(bad, np.inf, block).min(axis=0)
    return low.astype(np.float64), np.where(bad, -np.inf, block).max(axis=0).astype(np.float64)


def _raise_too_large(block: np.ndarray, start: int, key: str, where: str) -> None:
    too_large = np.isfinite(block) & (np.abs(block) > _FLOAT32_MAX)
    row, column = (int(i) for i in np.argwhere(too_large)[0])
    raise DatasetSemanticsError(
        f"{block[row, column]:g} at row {start + row}, column {column} is beyond the range of float32 "
        f"({int(too_large.sum())} such values in this block)",
        where=f"{where}, key {key}",
        hint="Rescale the values",
        key=key,
        index=(start + row, column),
        count=int(too_large.sum()),
    )
