"""
Minari's episodes as the arrays that :mod:`sb3_dce.data.build` reads.

An episode of T steps has T + 1 observations o: s = o[:-1] and s' = o[1:], so that no row is lost at its end, whatever ended
it. A termination is a terminal; a truncation without one is a timeout.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_dce.data.file_checks import translated_errors
from sb3_dce.data.hdf5 import EpisodeFile
from sb3_dce.data.layout import ArraySource, read_flags
from sb3_dce.data.minari import ARROW_FORMATS, Flatten, Leaf, MinariDataset, label, observation_leaves
from sb3_dce.data.records import Finding
from sb3_dce.errors import ConfigError, DatasetFormatError, DatasetSecurityError

_KEYS = ("actions", "rewards", "terminations", "truncations")
_GROUP = re.compile(r"episode_(0|[1-9]\d*)", re.ASCII)
_AGAIN = "Download or record the dataset again"


class Episode(NamedTuple):
    """
    The arrays of one episode of T steps.

    :param observations: arrays of the observation, to be put side by side, each of shape (T + 1, ...)
    :param others: ``actions``, ``rewards``, ``terminations``, ``truncations``, each of shape (T, ...)
    """

    observations: Sequence[ArraySource]
    others: Mapping[str, ArraySource]


class Stacked:
    """
    Arrays of all episodes, one below the other, read block by block.

    :param episodes: per episode the arrays that are put side by side, of the same shapes in each
    :param starts: first row of each episode, and the number of all rows, shape (n_episodes + 1,)
    :param offset: rows left out at the beginning of each array
    """

    def __init__(self, episodes: Sequence[Sequence[ArraySource]], starts: np.ndarray, offset: int = 0) -> None:
        self._episodes, self._starts, self._offset = episodes, starts, offset
        first = episodes[0]
        self.dtype: np.dtype[Any] = np.result_type(*{array.dtype for arrays in episodes for array in arrays})
        rows = int(starts[-1])
        width = sum(1 if len(array.shape) == 1 else array.shape[1] for array in first)
        self._flat = len(first) == 1 and len(first[0].shape) == 1
        self.shape: tuple[int, ...] = (rows,) if self._flat else (rows, width)

    def __getitem__(self, rows: slice) -> np.ndarray:
        """
        Read a block of rows out of all episodes it reaches into, with the arrays of each put side by side.

        :param rows: rows to read
        :return: shape (len(rows), width), or (len(rows),) for scalars
        """
        episode = int(np.searchsorted(self._starts, rows.start, side="right")) - 1
        blocks = []
        while episode < len(self._episodes) and self._starts[episode] < rows.stop:
            start, stop = self._starts[episode : episode + 2]
            part = slice(int(max(rows.start, start) - start) + self._offset, int(min(rows.stop, stop) - start) + self._offset)
            columns = [array[part].reshape(part.stop - part.start, -1) for array in self._episodes[episode]]
            blocks.append(columns[0] if len(columns) == 1 else np.concatenate(columns, axis=1))
            episode += 1
        block = np.concatenate(blocks)
        return block[:, 0] if self._flat else block


@contextmanager
def open_episodes(
    dataset: MinariDataset, flatten: Flatten, max_bytes: int
) -> Iterator[tuple[dict[str, ArraySource], list[Finding]]]:
    """
    The arrays of a dataset, with the keys of D4RL's layout, while its file is open.

    :param dataset: the dataset
    :param flatten: see :func:`~sb3_dce.data.minari.observation_leaves`
    :param max_bytes: largest size of the arrays that are read
    :return: key to array, and what was found on the way
    :raises ConfigError: if ``flatten`` does not fit, or a package for this format is missing
    :raises DatasetError: if episodes are missing or broken, or the observation is no vector
    """
    leaves = observation_leaves(dataset, flatten)
    if dataset.data_format in ARROW_FORMATS:
        yield _sources(dataset, leaves, _arrow_episodes(dataset, leaves, max_bytes))
    elif dataset.data_format == "hdf5":
        with EpisodeFile(dataset.file, max_bytes=max_bytes) as file:
            yield _sources(dataset, leaves, _hdf5_episodes(dataset, leaves, file))
    else:
        raise DatasetFormatError(
            f"data_format {dataset.data_format!r} is not known",
            where=str(dataset.folder),
            hint="Known are hdf5, arrow and parquet; record the dataset again with data_format='hdf5'",
            key="data_format",
        )


def _sources(
    dataset: MinariDataset, leaves: Sequence[Leaf], episodes: Sequence[Episode]
) -> tuple[dict[str, ArraySource], list[Finding]]:
    where = str(dataset.file)
    lengths = _lengths(episodes, leaves, where)
    starts = np.concatenate(([0], np.cumsum(lengths)))
    observations = [episode.observations for episode in episodes]
    stacked = {key: Stacked([[episode.others[key]] for episode in episodes], starts) for key in _KEYS}
    terminals = read_flags(stacked["terminations"], "terminations", where)
    truncations = read_flags(stacked["truncations"], "truncations", where)
    timeouts, findings = _timeouts(terminals, truncations, starts[1:] - 1)
    sources: dict[str, ArraySource] = {
        "observations": Stacked(observations, starts),
        "actions": stacked["actions"],
        "rewards": stacked["rewards"],
        "terminals": terminals,
        "timeouts": timeouts,
        "next_observations": Stacked(observations, starts, offset=1),
    }
    if leaves != [()]:
        widths = [Stacked([[array]], starts[:2]).shape for array in observations[0]]
        parts = (f"{label(leaf)} ({shape[1] if len(shape) == 2 else 1})" for leaf, shape in zip(leaves, widths, strict=True))
        findings.insert(0, Finding("other", "note", f"the observation is {' | '.join(parts)}"))
    promised = dataset.metadata.get("total_steps")
    if isinstance(promised, int) and promised != starts[-1]:
        findings.append(Finding("other", "note", f"metadata.json says {promised:,} steps, there are {starts[-1]:,}"))
    return sources, findings


def _timeouts(terminals: np.ndarray, truncations: np.ndarray, last_rows: np.ndarray) -> tuple[np.ndarray, list[Finding]]:
    """
    Where episodes end without a terminal: at truncations, and at the end of each group but the last one, which may be open.

    :param terminals: shape (rows,), bool
    :param truncations: shape (rows,), bool
    :param last_rows: last row of each episode
    :return: timeouts, shape (rows,), bool, and what was found
    """
    timeouts = truncations & ~terminals
    findings: list[Finding] = []
    if n_both := int((truncations & terminals).sum()):
        text = f"{n_both} steps terminate and are truncated at once: the terminal wins"
        findings.append(Finding("flags", "note", text, n_both))
    ended = terminals | truncations
    unmarked = last_rows[:-1][~ended[last_rows[:-1]]]
    if len(unmarked):
        timeouts[unmarked] = True
        text = f"{len(unmarked)} episodes end without a flag: taken for time limits"
        findings.append(Finding("episode ends", "note", text, len(unmarked)))
    if n_inside := int(ended.sum() - ended[last_rows].sum()):
        text = f"{n_inside} steps within an episode of Minari carry a flag: an episode ends there"
        findings.append(Finding("episode ends", "note", text, n_inside))
    return timeouts, findings


def _lengths(episodes: Sequence[Episode], leaves: Sequence[Leaf], where: str) -> np.ndarray:
    """Steps of each episode, after checking that all its arrays have as many rows, and that all episodes are alike."""
    names = [*(f"observations/{label(leaf)}".rstrip("/") for leaf in leaves), *_KEYS]
    first: list[ArraySource] = []
    lengths = []
    for number, episode in enumerate(episodes):
        arrays = [*episode.observations, *episode.others.values()]
        first = first or arrays
        for name, array, model in zip(names, arrays, first, strict=True):
            is_table = array.dtype.kind in "fiub" and 1 <= len(array.shape) <= 2
            if not is_table or array.shape[1:] != model.shape[1:]:
                raise DatasetFormatError(
                    f"shape {array.shape} and type {array.dtype}; wanted are numbers, one row per step as in episode_0, which "
                    f"has shape {model.shape}",
                    where=f"{where}, episode_{number}/{name}",
                    hint=_AGAIN,
                    key=name,
                )
        rows = {name: array.shape[0] for name, array in zip(names, arrays, strict=True)}
        steps = rows["rewards"]
        wanted = {name: steps + (name.startswith("observations")) for name in names}
        if steps == 0 or rows != wanted:
            found = ", ".join(f"{name} {n}" for name, n in rows.items())
            what = "no step" if steps == 0 else "T steps have T + 1 observations and T of all else"
            raise DatasetFormatError(
                f"{what}; rows: {found}", where=f"{where}, episode_{number}", hint=_AGAIN, key="observations", index=number
            )
        lengths.append(steps)
    return np.array(lengths)


def _count(dataset: MinariDataset, numbers: set[int]) -> int:
    """Number of episodes, after checking that none of them is missing."""
    promised = dataset.metadata.get("total_episodes")
    count = max([*(number + 1 for number in numbers), promised if isinstance(promised, int) else 0])
    if count == 0 or len(numbers) < count:
        missing = next(number for number in range(count + 1) if number not in numbers)
        raise DatasetFormatError(
            f"episode_{missing} is missing ({len(numbers)} of {count} episodes are there)",
            where=str(dataset.file),
            hint="Download or copy the dataset again",
            path=dataset.file,
            key=f"episode_{missing}",
            count=count - len(numbers),
        )
    return count


def _require_keys(found: dict[str, Any], wanted: Sequence[str], episode: str) -> None:
    missing = [key for key in wanted if key not in found]
    if missing:
        raise DatasetFormatError(f"missing {', '.join(missing)}", where=episode, hint=_AGAIN, key=missing[0])


# -- HDF5 ----------------------------------------------------------------------------------------------------------


def _hdf5_episodes(dataset: MinariDataset, leaves: Sequence[Leaf], file: EpisodeFile) -> list[Episode]:
    """Episodes in the order of their numbers; the file lists ``episode_10`` before ``episode_2``."""
    numbers = {int(match[1]) for name in file.keys if (match := _GROUP.fullmatch(name))}
    ways = ["/".join(("observations", *(f"_index_{key}" if isinstance(key, int) else key for key in leaf))) for leaf in leaves]
    names = [*ways, *_KEYS]
    groups = [f"episode_{number}" for number in range(_count(dataset, numbers))]
    arrays = file.select(f"{group}/{name}" for group in groups for name in names)
    episodes = []
    for group in groups:
        found = {name: arrays[f"{group}/{name}"] for name in names if f"{group}/{name}" in arrays}
        _require_keys(found, names, f"{dataset.file}, {group}")
        episodes.append(Episode([found[way] for way in ways], {key: found[key] for key in _KEYS}))
    return episodes


# -- Arrow and Parquet: a folder per episode, columns of T + 1 rows, the last of which is padding but for observations --


def _arrow_episodes(dataset: MinariDataset, leaves: Sequence[Leaf], max_bytes: int) -> list[Episode]:
    try:
        import pyarrow
        import pyarrow.dataset
    except ImportError as exc:
        raise ConfigError(f"{dataset.data_format} data of Minari need pyarrow", hint='pip install "sb3_dce[parquet]"') from exc
    folders = {int(path.name): path for path in dataset.folder.iterdir() if path.is_dir() and path.name.isdecimal()}
    episodes, budget = [], max_bytes
    for number in range(_count(dataset, set(folders))):
        folder = folders[number]
        with translated_errors(folder, hint=_AGAIN):
            files = pyarrow.dataset.dataset(
                str(folder), format=dataset.data_format, ignore_prefixes=["_", ".", "metadata.json"]
            )
            _require_keys(dict.fromkeys(files.schema.names), ("observations", *_KEYS), str(folder))
            batches = []
            for batch in files.to_batches(columns=["observations", *_KEYS]):
                budget -= batch.nbytes
                if budget < 0:
                    raise DatasetSecurityError(
                        f"the episodes up to this one take more than {max_bytes:,} bytes",
                        where=str(folder),
                        hint="If the data are honest, pass a larger max_bytes=",
                        path=folder,
                    )
                batches.append(batch)
            table = pyarrow.Table.from_batches(batches, schema=batches[0].schema).combine_chunks()
            columns = {name: table.column(name).chunk(0) for name in table.column_names}
            observations = [_column(_inner(columns["observations"], leaf), folder) for leaf in leaves]
            others = {key: _column(columns[key], folder)[:-1] for key in _KEYS}
        episodes.append(Episode(observations, others))
    return episodes


def _inner(column: Any, leaf: Leaf) -> Any:
    for key in leaf:
        column = column.field(str(key))
    return column


def _column(column: Any, folder: Path) -> np.ndarray:
    """Numbers of a column of numbers, or of lists of one length; shape (rows,) or (rows, length)."""
    if column.null_count:
        raise DatasetFormatError("empty cells", where=str(folder), hint=_AGAIN, path=folder)
    width = getattr(column.type, "list_size", None)
    values: np.ndarray = (column if width is None else column.flatten()).to_numpy(zero_copy_only=False)
    return values if width is None else values.reshape(len(column), width)
