"""From a name or a path to a dataset, whose file must be the one that was recorded."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from os import PathLike
from typing import Any, Protocol

import numpy as np

from sb3_dce.data.episode_list import arrays_from_episodes
from sb3_dce.data.hash_record import as_sha256, verify_hash, verify_record
from sb3_dce.data.layout import CORE_KEYS, EPISODES, REQUIRED_KEYS
from sb3_dce.data.locate import find_file
from sb3_dce.data.minari import is_minari
from sb3_dce.data.records import bounds_left_open
from sb3_dce.data.transitions import Transitions
from sb3_dce.errors import ConfigError


class FrameLike(Protocol):
    """What a pandas data frame has."""

    @property
    def columns(self) -> Any:
        """Names of the columns, by which the arrays of a dataset are found."""


class BufferLike(Protocol):
    """What a replay buffer of Stable-Baselines3 has."""

    buffer_size: int
    observations: Any


class EpisodeSource(Protocol):
    """What a loaded dataset of Minari has."""

    def iterate_episodes(self) -> Iterable[Any]:
        """Episodes one after the other, each with its observations, actions, rewards and flags."""


# Whatever holds logged steps; :func:`load_dataset` says what each must contain.
DatasetLike = (
    str
    | PathLike[str]
    | Transitions
    | Mapping[str, Any]
    | list[Any]
    | tuple[Any, ...]
    | FrameLike
    | BufferLike
    | EpisodeSource
)

_READERS: dict[str, Callable[..., Transitions]] = {
    ".npz": Transitions.from_npz,
    ".csv": Transitions.from_csv,
    ".parquet": Transitions.from_parquet,
    ".pkl": Transitions.from_replay_buffer,  # which refuses it without trust="pickle"
}


def load_transitions(name_or_path: str | PathLike[str], *, sha256: str | None = None, **options: Any) -> Transitions:
    """
    Find a dataset on this machine and read it. Nothing is downloaded.

    :param name_or_path: id or alias of the catalogue; ``minari:`` and an id of Minari, or the folder of such a dataset; or a
        file: NPZ, CSV and Parquet by suffix, any other is taken for HDF5 in D4RL's layout
    :param sha256: hash the file must have, 64 hexadecimal digits; not for Minari, whose datasets are folders
    :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`, e.g. ``d4rl_compat=True``, and of the reader
        of this suffix, e.g. ``sep=";"`` (see the class methods of :class:`~sb3_dce.data.transitions.Transitions`)
    :return: the dataset
    :raises DatasetNotFoundError: if the file is not on this machine
    :raises DatasetIntegrityError: if the file is not the one that was downloaded, or has another hash
    :raises ConfigError: if ``sha256`` is no hash
    :raises DatasetError: if something is wrong with the dataset
    """
    pin = as_sha256(sha256)
    if is_minari(name_or_path):
        if pin is not None:
            raise ConfigError(
                "a dataset of Minari is a folder", where=str(name_or_path), key="sha256", hint="Leave sha256 out."
            )
        return Transitions.from_minari(name_or_path, **options)
    path, spec = find_file(name_or_path)
    verify_record(path)
    if pin is not None:
        verify_hash(path, pin, "Get the file again, or correct sha256=")
    read = _READERS.get(path.suffix.lower(), Transitions.from_hdf5)
    return read(path, spec=spec, **options)


def load_dataset(source: DatasetLike, **options: Any) -> Transitions:
    """
    The front door: whatever holds logged steps becomes a dataset.

    :param source: id, alias or file as for :func:`load_transitions`; a pandas data frame; a dictionary of arrays with the
        keys of :meth:`Transitions.from_arrays`; a list of episodes, each a dictionary of arrays or an episode of Minari, or
        a loaded dataset of Minari; a replay buffer of Stable-Baselines3; or ``Transitions``
    :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`, and options of the reader
    :return: the dataset
    :raises ConfigError: for any other object, or options for data that are read already
    :raises DatasetError: if something is wrong with the dataset
    """
    if isinstance(source, str | os.PathLike):
        return load_transitions(source, **options)
    if isinstance(source, Transitions):
        if options:
            raise ConfigError(
                f"{', '.join(sorted(options))}: these Transitions have been read already",
                key=next(iter(options)),
                hint="Pass the options to the reader that made them.",
            )
        return source
    if isinstance(source, Mapping):
        known = (*CORE_KEYS, EPISODES)
        unknown = sorted(set(source) - set(known))
        needed = set(REQUIRED_KEYS) - ({"terminals"} if EPISODES in source else set())
        missing = sorted(needed - set(source))
        if unknown or missing:
            raise ConfigError(
                f"a dictionary of arrays has the keys {', '.join(known)}; missing {missing}, unknown {unknown}",
                key=str((missing + unknown)[0]),
                hint="Rename its keys; timeouts, next_observations and episodes (an id per row) may be left out.",
            )
        return Transitions.from_arrays(**source, **options)
    other: Any = source  # told apart by what they have: none of their packages is imported here
    if isinstance(other, list | tuple) or hasattr(other, "iterate_episodes"):
        episodes = other if isinstance(other, list | tuple) else other.iterate_episodes()
        arrays: dict[str, Any] = arrays_from_episodes(episodes)
        space: Any = getattr(other, "action_space", None)  # of a dataset of Minari
        if hasattr(space, "low") and np.isfinite((space.low, space.high)).all():
            options |= bounds_left_open(options, {"action_low": np.ravel(space.low), "action_high": np.ravel(space.high)})
        return Transitions.from_arrays(**arrays, **options)
    if type(other).__module__.partition(".")[0] == "pandas":
        return Transitions.from_dataframe(other, **options)
    if hasattr(other, "buffer_size"):
        return Transitions.from_replay_buffer(other, **options)
    raise ConfigError(
        f"a dataset cannot be made of {type(source).__name__}",
        key="source",
        hint="Give an id, a file, a data frame, a dictionary of arrays, a list of episodes, a replay buffer, or Transitions.",
    )
