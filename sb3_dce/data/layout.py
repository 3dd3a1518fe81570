"""
What a dataset has to look like: keys, types, shapes, widths. Nothing is read here but the flags.

The rows of the matrix that training uses are laid out ``observation | action | reward | done | next observation``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sb3_dce.data.catalog import DatasetSpec
from sb3_dce.errors import DatasetFormatError, DatasetSecurityError, DatasetSemanticsError

REQUIRED_KEYS = ("observations", "actions", "rewards", "terminals")
CORE_KEYS = (*REQUIRED_KEYS, "timeouts", "next_observations")
# An id per row, whose changes end episodes; and rows of episodes that are not there as a whole, whose returns mean nothing.
EPISODES, INCOMPLETE = "episodes", "incomplete"
MATRIX_KEYS = ("observations", "actions", "next_observations")
# Rows handled at once: 16k rows of HalfCheetah observations (1.1 MB) stay in the second-level cache.
BLOCK_ROWS = 16_384
# For copies of all columns: 344 kB of HalfCheetah, so that they do not count beside the row matrix.
WIDE_BLOCK_ROWS = 2048
MAX_ROWS = 2**31 - 1

_NEAR_MISSES = {
    "observations": ("obs", "observation", "states", "state"),
    "actions": ("action", "acts"),
    "rewards": ("reward", "rews"),
    "terminals": ("terminal", "dones", "done", "terminations", "terminated"),
}


class ArraySource(Protocol):
    """What the reader needs of an array: a NumPy array, or an array of an open file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape (rows, ...), known before an entry is read."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the entries as they are stored; the row matrix is float32 whatever it is."""

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """
        Read a block of rows, the only way to the entries, so that an array need not fit into memory as a whole.

        :param rows: rows to read
        :return: shape (len(rows), ...)
        """


def as_array(value: Any, key: str, where: str = "") -> np.ndarray:
    """
    Array of what a user gives (a list, a tensor, a column), with an error that says what is wanted instead of NumPy's.

    :param value: what a user gives for an array
    :param key: its name
    :param where: what it is part of, for the message
    :return: the array
    :raises DatasetFormatError: if NumPy cannot make one of it
    """
    try:
        return np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        raise DatasetFormatError(
            f"{key} is no array ({str(error).splitlines()[0]})",
            where=where,
            hint="Give one row per step; a list of episodes is [{'observations': ..., ...}, ...], and a tensor of PyTorch "
            "becomes an array by .detach().cpu().numpy()",
            key=key,
        ) from error


@dataclass(frozen=True)
class RowLayout:
    """
    Columns of the row matrix.

    :param obs_dim: number of entries of an observation
    :param act_dim: number of entries of an action
    """

    obs_dim: int
    act_dim: int

    @property
    def observations(self) -> slice:
        """Columns of the observation s, the first of each row."""
        return slice(0, self.obs_dim)

    @property
    def actions(self) -> slice:
        """Columns of the action a, which follow the observation."""
        return slice(self.obs_dim, self.obs_dim + self.act_dim)

    @property
    def rewards(self) -> slice:
        """Column of the reward r, as a slice of width 1."""
        return slice(self.obs_dim + self.act_dim, self.obs_dim + self.act_dim + 1)

    @property
    def terminals(self) -> slice:
        """Column of d, 1 at true terminals and else 0, as a slice of width 1."""
        return slice(self.obs_dim + self.act_dim + 1, self.obs_dim + self.act_dim + 2)

    @property
    def next_observations(self) -> slice:
        """Columns of the next observation s', the last of each row."""
        return slice(self.obs_dim + self.act_dim + 2, self.width)

    @property
    def width(self) -> int:
        """Number of columns of a row, ``2 * obs_dim + act_dim + 2``."""
        return 2 * self.obs_dim + self.act_dim + 2


def wanted_keys(keys: Iterable[str]) -> tuple[str, ...]:
    """
    Keys of the arrays that are asked of an HDF5 or NPZ file, whether it has them or not.

    :param keys: of a file
    :return: those that are read if they are there; ids of episodes only where flags are missing that would say the same
    """
    has_flags = {"terminals", "timeouts"} <= set(keys)
    return (*CORE_KEYS, INCOMPLETE) if has_flags else (*CORE_KEYS, INCOMPLETE, EPISODES)


def row_blocks(n_rows: int, block_rows: int = BLOCK_ROWS) -> Iterator[slice]:
    """
    Cut rows into blocks.

    :param n_rows: number of rows
    :param block_rows: rows of a block, the last one may be shorter
    :return: slices that cover all rows in order
    """
    for start in range(0, n_rows, block_rows):
        yield slice(start, min(start + block_rows, n_rows))


def check_layout(
    sources: Mapping[str, ArraySource],
    *,
    where: str,
    found_keys: Iterable[str],
    spec: DatasetSpec | None,
    obs_dim: int | None,
    act_dim: int | None,
) -> RowLayout:
    """
    Check keys, types, shapes and widths. Each error names all arrays it applies to.

    :param sources: core keys that are there
    :param where: file, for messages
    :param found_keys: all keys of the file, for messages
    :param spec: catalogue entry with the expected widths
    :param obs_dim: expected width of an observation, wins over ``spec``
    :param act_dim: expected width of an action, wins over ``spec``
    :return: columns of the row matrix
    :raises DatasetFormatError: if something does not fit
    :raises DatasetSemanticsError: if there are no rows
    """
    _check_keys(sources, where, list(found_keys))
    _check_types(sources, where)
    obs, act = _wanted_width("obs_dim", obs_dim, spec), _wanted_width("act_dim", act_dim, spec)
    wanted = {"observations": obs, "actions": act, "next_observations": obs}
    _check_shapes(sources, where, {key: width for key, (width, _) in wanted.items()})
    _check_widths(sources, where, wanted, spec)
    _check_rows(sources, where)
    return RowLayout(_width(sources["observations"]), _width(sources["actions"]))


def read_flags(source: ArraySource, key: str, where: str) -> np.ndarray:
    """
    Read an array of flags. Any numeric type is accepted (Kitchen has float32), but only the values 0 and 1.

    :param source: shape (rows,) or (rows, 1)
    :param key: name, for messages
    :param where: file, for messages
    :return: shape (rows,), bool
    :raises DatasetFormatError: if a value is neither 0 nor 1
    """
    flags = np.empty(source.shape[0], dtype=bool)
    first: tuple[int, Any] | None = None
    n_bad = 0
    for rows in row_blocks(len(flags), block_rows_of(source)):
        values = np.asarray(source[rows]).reshape(-1)
        flags[rows] = values
        bad = np.flatnonzero(values != flags[rows])  # NaN differs from everything
        n_bad += len(bad)
        if len(bad) and first is None:
            first = (rows.start + int(bad[0]), values[bad[0]])
    if first is not None:
        raise DatasetFormatError(
            f"flags must be 0/1, row {first[0]} has {first[1]!s} ({n_bad} bad rows of {len(flags):,})",
            where=f"{where}, key {key}",
            hint="Store True only where an episode ends",
            key=key,
            index=first[0],
            count=n_bad,
        )
    return flags


def block_rows_of(source: ArraySource) -> int:
    """
    Rows to read at once; arrays of a file say which number suits their chunks.

    :param source: array
    :return: number of rows
    """
    return int(getattr(source, "block_rows", BLOCK_ROWS))


def _check_keys(sources: Mapping[str, ArraySource], where: str, found: list[str]) -> None:
    missing = [key for key in REQUIRED_KEYS if key not in sources]
    if not missing or (missing == ["terminals"] and EPISODES in sources):
        return
    near = [f"{name} (for {key})" for key in missing for name in _NEAR_MISSES[key] if name in found]
    hint = f"Rename {', '.join(near)}" if near else "Rename or add them"
    if any(name in ("terminations", "truncations") or name.startswith("episode_") for name in found):
        hint += (
            ". This looks like Minari: Transitions.from_minari reads the folder of a dataset; a file alone needs its "
            "metadata.json beside it"
        )
    shown = ", ".join(found[:20]) or "none"
    raise DatasetFormatError(
        f"missing {', '.join(missing)}; keys found: {shown}", where=where, hint=hint, key=missing[0], count=len(missing)
    )


def _check_types(sources: Mapping[str, ArraySource], where: str) -> None:
    types = {key: source.dtype for key, source in sources.items()}
    bad = {key: dtype for key, dtype in types.items() if dtype.kind not in "fiub" or dtype.itemsize > 8}  # no float128
    if not bad:
        return
    described = [
        f"{key} has type {dtype}" + (f" with fields {dtype.names}" if dtype.names else "") for key, dtype in bad.items()
    ]
    raise DatasetFormatError(
        "; ".join(described), where=where, hint="Store float32 numbers and bool flags", key=next(iter(bad)), count=len(bad)
    )


def _check_shapes(sources: Mapping[str, ArraySource], where: str, expected: Mapping[str, int | None]) -> None:
    """Matrices are (rows, width); a vector is taken for width 1. Rewards and flags are (rows,) or (rows, 1)."""
    bad = []
    for key, source in sources.items():
        rank = len(source.shape)
        if key in MATRIX_KEYS:
            width = expected[key]
            if rank != 2 and not (rank == 1 and width in (None, 1)):
                bad.append((key, f"(N, {width or ('act_dim' if key == 'actions' else 'obs_dim')})"))
        elif rank != 1 and not (rank == 2 and source.shape[1] == 1):
            bad.append((key, "(N,)"))
    if bad:
        raise DatasetFormatError(
            "; ".join(f"{key} has shape {tuple(sources[key].shape)}, wanted {wanted}" for key, wanted in bad),
            where=where,
            hint="Reshape to one row per step; images and nested observations are not supported",
            key=bad[0][0],
            count=len(bad),
        )


def _wanted_width(option: str, given: int | None, spec: DatasetSpec | None) -> tuple[int | None, str]:
    """A width, ``None`` for any, and who wants it."""
    if given is not None:
        return given, f" by {option}="
    return (None, "") if spec is None else (getattr(spec, option), f" by {spec.env_id or spec.id}")


def _check_widths(
    sources: Mapping[str, ArraySource],
    where: str,
    wanted: Mapping[str, tuple[int | None, str]],
    spec: DatasetSpec | None,
) -> None:
    widths = {key: _width(sources[key]) for key in MATRIX_KEYS if key in sources}
    bad = {key: width for key, width in widths.items() if width == 0 or width != (wanted[key][0] or width)}
    if bad:
        owners = {key: wanted[key][1] for key in bad}
        hint = "Use the file of that environment, or pass obs_dim= and act_dim="
        if all(owner.endswith("=") for owner in owners.values()):
            hint = "Correct the width that you have passed, or leave it out"
        elif spec and spec.family == "kitchen" and bad.get("observations") == 59:
            hint = "59 entries are FrankaKitchen-v1's own: D4RL's 60 are [obs[0:9], obs[18:39], goal (30)]"
        raise DatasetFormatError(
            "; ".join(f"{key} has width {bad[key]}, {wanted[key][0] or 'at least 1'} is wanted{owners[key]}" for key in bad),
            where=where,
            hint=hint,
            key=next(iter(bad)),
            count=len(bad),
        )
    if widths.get("next_observations", widths["observations"]) != widths["observations"]:
        raise DatasetFormatError(
            f"next_observations has shape {tuple(sources['next_observations'].shape)}, "
            f"observations has shape {tuple(sources['observations'].shape)}",
            where=where,
            hint="Both need the same shape",
            key="next_observations",
        )


def _check_rows(sources: Mapping[str, ArraySource], where: str) -> None:
    n_rows = {key: source.shape[0] for key, source in sources.items()}
    if len(set(n_rows.values())) > 1:
        others = {rows for key, rows in n_rows.items() if key != "observations"}
        hint = "All arrays need one row per step"
        if others == {n_rows["observations"] - 1}:
            hint = "T+1 observations: a Minari episode? Give observations[:-1] and next_observations=observations[1:]"
        raise DatasetFormatError(
            f"different numbers of rows: {', '.join(f'{key} {rows}' for key, rows in n_rows.items())}", where=where, hint=hint
        )
    rows = n_rows["observations"]
    if rows == 0:
        raise DatasetSemanticsError("empty: 0 rows", where=where, hint="Record some steps first", count=0)
    if rows > MAX_ROWS:
        raise DatasetSecurityError(f"{rows:,} rows, the limit is {MAX_ROWS:,}", where=where, hint="Use part of the data")


def _width(source: ArraySource) -> int:
    return source.shape[1] if len(source.shape) == 2 else 1
