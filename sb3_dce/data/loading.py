"""From a name or a path to a dataset."""

from __future__ import annotations

from os import PathLike
from typing import Any

from sb3_dce.data.locate import find_file
from sb3_dce.data.transitions import Transitions


def load_transitions(name_or_path: str | PathLike[str], **options: Any) -> Transitions:
    """
    Find a dataset on this machine and read it. Nothing is downloaded.

    :param name_or_path: id or alias of the catalogue, or an HDF5 file in D4RL's layout
    :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`, e.g. ``d4rl_compat=True``
    :return: the dataset
    :raises DatasetNotFoundError: if the file is not on this machine
    :raises DatasetError: if something is wrong with the dataset
    """
    path, spec = find_file(name_or_path)
    return Transitions.from_hdf5(path, spec=spec, **options)
