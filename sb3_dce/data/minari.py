"""
Minari datasets on this machine: where they lie, and what their ``metadata.json`` says. Minari itself is not needed.

A dataset is a folder ``<root>/<id>/data``, its root is ``$MINARI_DATASETS_PATH`` or ``~/.minari/datasets``. The metadata come
from strangers: they are read as JSON, nothing in them is evaluated, imported or made.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from sb3_dce.data.file_checks import translated_errors
from sb3_dce.data.hashes import METADATA_FILE
from sb3_dce.data.records import Finding
from sb3_dce.errors import ConfigError, DatasetError, DatasetFormatError, DatasetIntegrityError, DatasetNotFoundError
from sb3_dce.files import expanded

PREFIX = "minari:"
ROOT_VARIABLE = "MINARI_DATASETS_PATH"
HDF5_FILE = "main_data.hdf5"
ARROW_FORMATS = ("arrow", "parquet")
# Bounds of spaces make most of it: 12,288 pixels with two bounds each take 150 kB.
_MAX_METADATA_BYTES = 2**25
_MAX_DEPTH = 16
_ID = re.compile(r"(?:[-\w]+/)*[-\w]+-v\d+", re.ASCII)
# Adroit sets replayed in a simulator whose reward may have the wrong sign (see sb3_dce.robotics).
_DOUBTFUL_REWARDS = re.compile(r"D4RL/(door|hammer|relocate)/")

Flatten = bool | str | Sequence[str]
Leaf = tuple["str | int", ...]


@dataclass(frozen=True)
class MinariDataset:
    """
    A dataset on this machine.

    :param name: ``minari:`` and the id
    :param folder: folder with ``metadata.json``
    :param metadata: content of this file
    """

    name: str
    folder: Path
    metadata: dict[str, Any]

    @property
    def data_format(self) -> str:
        """
        Format of the episodes on disk by ``metadata.json``, HDF5 if it names none.

        :return: ``hdf5``, ``arrow``, ``parquet``, or a format that is not known here
        """
        return str(self.metadata.get("data_format", "hdf5"))

    @property
    def file(self) -> Path:
        """
        The file that stands for the dataset where one path is wanted, such as in messages and for hashes.

        :return: ``main_data.hdf5``; of the formats with a file per episode it is ``metadata.json``
        """
        return self.folder / (METADATA_FILE if self.data_format in ARROW_FORMATS else HDF5_FILE)


def is_minari_name(name: Any) -> TypeGuard[str]:
    """
    Whether a dataset is named by an id of Minari; only the prefix is looked at, not the form of the id.

    :param name: whatever names a dataset
    :return: True for a text with ``minari:`` before it, such as ``minari:D4RL/door/human-v2``
    """
    return isinstance(name, str) and name.startswith(PREFIX)


def is_minari(name_or_path: str | PathLike[str]) -> bool:
    """
    Whether :func:`find_minari` is who finds a dataset.

    :param name_or_path: whatever names a dataset
    :return: True for a text with ``minari:`` before it, and for a path as for :func:`folder_of`
    """
    return is_minari_name(name_or_path) or folder_of(name_or_path) is not None


def minari_id(name: str) -> str:
    """
    Id without prefix, after checking its form: names, with ``/`` between them, that end in ``-v`` and a number.

    :param name: id, with or without ``minari:``
    :return: id, such as ``D4RL/door/human-v2``
    :raises DatasetError: if it is no id
    """
    found = name.removeprefix(PREFIX)
    if not _ID.fullmatch(found):
        raise DatasetError(
            f"{name!r} is no id of Minari", hint="An id ends in its version, as minari:D4RL/door/human-v2 does", key=name
        )
    return found


def dataset_folder(name: str) -> Path:
    """
    Where Minari keeps a dataset: ``<id>/data`` below ``$MINARI_DATASETS_PATH``, by default ``~/.minari/datasets``.

    :param name: id, with or without ``minari:``
    :return: folder in which its data are looked for, need not exist
    """
    root = os.environ.get(ROOT_VARIABLE) or "~/.minari/datasets"
    return expanded(root) / minari_id(name) / "data"


def find_minari(name_or_path: str | PathLike[str]) -> MinariDataset:
    """
    A dataset on this machine. Nothing is downloaded.

    :param name_or_path: id, with or without ``minari:``, or a path as for :func:`folder_of`
    :return: the dataset
    :raises DatasetNotFoundError: if it is not here
    :raises DatasetError: if it is neither an id nor such a path, or its metadata cannot be read
    """
    folder = None if is_minari_name(name_or_path) else folder_of(name_or_path)
    if folder is None:
        name = f"{PREFIX}{minari_id(os.fspath(name_or_path))}"
        folder = dataset_folder(name)
        again = f"Run: sb3-dce datasets download {name}"
    else:
        name, again = "", "Copy or download it again"
    if not folder.is_dir():
        raise DatasetNotFoundError(
            f"not on this machine; looked for {folder}",
            where=f"dataset {name}",
            hint=f"{again} - or put it there by hand, or name another root in ${ROOT_VARIABLE}.",
            path=folder,
            key=name,
        )
    metadata = _read_metadata(folder / METADATA_FILE, again)
    dataset = MinariDataset(name or _own_name(metadata, folder), folder, metadata)
    if not dataset.file.is_file():
        raise _incomplete(dataset.file, again)
    return dataset


def folder_of(path: str | PathLike[str]) -> Path | None:
    """
    The folder of a dataset that is named by a path.

    :param path: the folder with ``metadata.json``, the folder above it, ``metadata.json`` itself or ``main_data.hdf5``
    :return: folder with ``metadata.json``, None if the path is nothing of the kind
    """
    path = expanded(path)
    if path.name in (METADATA_FILE, HDF5_FILE):
        path = path.parent
    return next((folder for folder in (path, path / "data") if os.path.isfile(folder / METADATA_FILE)), None)


def observation_leaves(dataset: MinariDataset, flatten: Flatten) -> list[Leaf]:
    """
    Which arrays make the observation, side by side.

    :param dataset: the dataset
    :param flatten: of observations that consist of several arrays: True takes all, in the order of the space; names of keys
        take these, in this order (``"a/b"`` is key b in key a, ``"0"`` the first entry of a tuple)
    :return: keys on the way to each array; one empty way for observations that are one array
    :raises DatasetFormatError: if an observation is no vector, or consists of several arrays and ``flatten`` is False
    :raises ConfigError: if ``flatten`` does not fit the dataset
    """
    where = f"{dataset.name}, observations"
    space = _space(dataset, "observation_space")
    if space.get("type") not in ("Dict", "Tuple"):
        if not isinstance(flatten, bool):
            raise ConfigError(
                "the observation is one array without keys", where=where, key="flatten", hint="Leave flatten out"
            )
        _check_vector(space, where, "observations")
        return [()]
    leaves = dict(_leaves(space))
    labels = {leaf: label(leaf) for leaf in leaves}
    if flatten is False:
        shown = ", ".join(f"{labels[leaf]} {_describe(part)}" for leaf, part in leaves.items())
        example = json.dumps([labels[leaf] for leaf in leaves][:2])
        raise DatasetFormatError(
            f"the observation consists of several arrays: {shown}",
            where=where,
            hint="Say which of them the agent sees: Transitions.from_minari(name, flatten=True) joins all, "
            f"flatten={example} joins these in this order",
            key="observations",
        )
    keys = [flatten] if isinstance(flatten, str) else flatten
    chosen = list(leaves) if keys is True else _chosen(labels, list(keys), where)
    for leaf in chosen:
        _check_vector(leaves[leaf], f"{where}/{labels[leaf]}", "observations")
    return chosen


def action_bounds(dataset: MinariDataset) -> dict[str, np.ndarray]:
    """
    The bounds of the actions, as far as the dataset says.

    :param dataset: the dataset
    :return: ``action_low`` and ``action_high``, shape (act_dim,); empty if they are not given or not finite
    :raises DatasetFormatError: if actions are no vectors of real numbers
    """
    where = f"{dataset.name}, actions"
    space = _space(dataset, "action_space")
    _check_vector(space, where, "actions")
    try:
        low, high = (np.asarray(space[side], dtype=np.float64).reshape(-1) for side in ("low", "high"))
    except KeyError:
        return {}
    except (ValueError, TypeError) as exc:
        raise DatasetFormatError(f"bounds that are no numbers: {exc}", where=where, hint=_DAMAGED, key="actions") from exc
    return {"action_low": low, "action_high": high} if np.isfinite([*low, *high]).all() else {}


def environment_spec(dataset: MinariDataset) -> dict[str, Any]:
    """
    The environment for evaluation as the metadata describe it, else the one of the recording. It is data: nobody may import
    or call what it names.

    :param dataset: the dataset
    :return: content of a Gymnasium specification, with a text ``id``; empty if there is none
    """
    for key in ("eval_env_spec", "env_spec"):
        try:
            spec = json.loads(dataset.metadata.get(key) or "null")
        except (ValueError, TypeError, RecursionError):
            continue
        if isinstance(spec, dict) and isinstance(spec.get("id"), str):
            return spec
    return {}


def reward_findings(name: str) -> list[Finding]:
    """
    What has to be said of the Adroit replays door, hammer and relocate, whose rewards may have the wrong sign.

    :param name: ``minari:`` and the id
    :return: one note; empty for all other data
    """
    if not _DOUBTFUL_REWARDS.match(name.removeprefix(PREFIX)):
        return []
    text = (
        "rewards of this replay may pay for the distance to the object instead of charging it (Gymnasium-Robotics pull "
        "request 220): compare an episode; scores of D4RL do not apply"
    )
    return [Finding("other", "note", text)]


def label(leaf: Leaf) -> str:
    """
    Name of an array within an observation, its keys joined by ``/`` as ``flatten`` takes them.

    :param leaf: keys on the way to an array
    :return: for example ``"a/b"``; empty for an observation that is one array
    """
    return "/".join(map(str, leaf))


_DAMAGED = "Download or record the dataset again"


def _own_name(metadata: dict[str, Any], folder: Path) -> str:
    """Name of a dataset that was given by its path. The id in the metadata is shown only if it looks like one."""
    own = metadata.get("dataset_id")
    return PREFIX + (own if isinstance(own, str) and _ID.fullmatch(own) else folder.absolute().parent.name)


def _incomplete(missing: Path, again: str) -> DatasetNotFoundError:
    hint = f"{again} --force" if again.startswith("Run") else again
    return DatasetNotFoundError("incomplete: there is no such file", where=str(missing), hint=f"{hint}.", path=missing)


def _read_metadata(path: Path, again: str) -> dict[str, Any]:
    if not path.is_file():
        raise _incomplete(path, again)
    with translated_errors(path, hint=again):
        if (size := path.stat().st_size) > _MAX_METADATA_BYTES:
            raise DatasetFormatError(f"{size:,} bytes are no metadata", where=str(path), hint=again, path=path)
        content = path.read_bytes()
    try:
        metadata = json.loads(content)
    except (ValueError, RecursionError) as exc:
        raise DatasetIntegrityError(f"damaged: not JSON ({exc})", where=str(path), hint=again, path=path) from exc
    if not isinstance(metadata, dict):
        kind = type(metadata).__name__
        raise DatasetIntegrityError(f"damaged: a JSON object is wanted, not {kind}", where=str(path), hint=again, path=path)
    return metadata


def _space(dataset: MinariDataset, key: str) -> dict[str, Any]:
    """A space of the metadata, a JSON text in the JSON; a vector of unknown width if there is none."""
    given = dataset.metadata.get(key)
    try:
        space = json.loads(given) if isinstance(given, str) else given
    except (ValueError, RecursionError):
        space = False
    if space is None:
        return {"type": "Box"}
    if not isinstance(space, dict):
        raise DatasetFormatError(
            f"{key} is no description of a space: {str(given)[:60]!r}",
            where=str(dataset.folder / METADATA_FILE),
            hint=_DAMAGED,
            key=key,
        )
    return space


def _leaves(space: dict[str, Any], way: Leaf = ()) -> Iterator[tuple[Leaf, dict[str, Any]]]:
    """The spaces in a space that are not made of others, with the keys on the way to them."""
    inner = space.get("subspaces")
    parts: list[tuple[str | int, Any]] = []
    if len(way) < _MAX_DEPTH and space.get("type") == "Dict" and isinstance(inner, dict):
        parts = list(inner.items())
    elif len(way) < _MAX_DEPTH and space.get("type") == "Tuple" and isinstance(inner, list):
        parts = list(enumerate(inner))
    else:
        yield way, space
    for key, part in parts:
        yield from _leaves(part if isinstance(part, dict) else {}, (*way, key))


def _chosen(labels: dict[Leaf, str], keys: Sequence[str], where: str) -> list[Leaf]:
    """The arrays of these keys in the order of the keys; a key that leads to several stands for all of them."""
    groups = [[leaf for leaf, text in labels.items() if text == key or text.startswith(f"{key}/")] for key in keys]
    chosen = [leaf for group in groups for leaf in group]
    unknown = [key for key, group in zip(keys, groups, strict=True) if not group]
    if unknown or not chosen or len(set(chosen)) < len(chosen):
        what = f"no {', '.join(map(repr, unknown))}" if unknown else f"flatten={keys!r} names no key, or one twice"
        raise ConfigError(what, where=where, key="flatten", hint=f"Keys are {', '.join(labels.values())}")
    return chosen


def _check_vector(space: dict[str, Any], where: str, key: str) -> None:
    """Refuse what is no vector of real numbers: an image, a discrete value, a text."""
    shape = space.get("shape")
    if space.get("type") == "Box" and (shape is None or (isinstance(shape, list) and len(shape) <= 1)):
        return
    what = f"{_describe(space)}, wanted is a vector of real numbers"
    hint = "Make vectors of them, then use Transitions.from_arrays"
    if key == "actions":
        what, hint = f"{_describe(space)}; all agents here act in continuous spaces", "Use data with actions of type Box"
    elif "/" in where:
        hint = "Leave it out: name the other keys in flatten="
    raise DatasetFormatError(what, where=where, hint=hint, key=key)


def _describe(space: dict[str, Any]) -> str:
    shape = space.get("shape")
    if not isinstance(shape, list):
        return str(space.get("type", "unknown"))
    image = " (images)" if len(shape) > 1 and space.get("dtype") == "uint8" else ""
    return f"{space.get('type')} {tuple(shape)}{image}"
