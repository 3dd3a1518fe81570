"""From a name or a path to a dataset, whose file must be the one that was recorded."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from typing import Any

from sb3_dce.data.hash_record import verify_record
from sb3_dce.data.locate import find_file
from sb3_dce.data.transitions import Transitions

_READERS: dict[str, Callable[..., Transitions]] = {
    ".npz": Transitions.from_npz,
    ".csv": Transitions.from_csv,
    ".parquet": Transitions.from_parquet,
    ".pkl": Transitions.from_replay_buffer,  # which refuses it
}


def load_transitions(name_or_path: str | PathLike[str], **options: Any) -> Transitions:
    """
    Find a dataset on this machine and read it. Nothing is downloaded.

    :param name_or_path: id or alias of the catalogue, or a file: NPZ, CSV and Parquet by suffix, any other is taken
        for HDF5 in D4RL's layout
    :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`, e.g. ``d4rl_compat=True``, and of the reader
        of this suffix, e.g. ``sep=";"`` (see the class methods of :class:`~sb3_dce.data.transitions.Transitions`)
    :return: the dataset
    :raises DatasetNotFoundError: if the file is not on this machine
    :raises DatasetIntegrityError: if the file is not the one that was downloaded
    :raises DatasetError: if something is wrong with the dataset
    """
    path, spec = find_file(name_or_path)
    verify_record(path)
    read = _READERS.get(path.suffix.lower(), Transitions.from_hdf5)
    return read(path, spec=spec, **options)
