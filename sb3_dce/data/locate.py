"""
From a dataset name to a file on this machine. Nothing is downloaded here.

Searched in this order: files that come with the package, ``$SB3_DCE_DATASETS`` (several folders may be given, separated
as in ``$PATH``), the cache ``~/.cache/sb3_dce/datasets``, and D4RL's own folders ``$D4RL_DATASET_DIR`` and
``~/.d4rl/datasets``.
"""

from __future__ import annotations

import os
from contextlib import suppress
from importlib import resources
from os import PathLike
from pathlib import Path

from sb3_dce.data.catalog import DatasetSpec, all_specs, resolve, spec_of_file
from sb3_dce.data.minari import PREFIX, find_minari, folder_of, is_minari, is_minari_name
from sb3_dce.errors import ConfigError, DatasetError, DatasetFormatError, DatasetNotFoundError
from sb3_dce.files import exists, expanded

DATASETS_VARIABLE = "SB3_DCE_DATASETS"
SUFFIXES = (".hdf5", ".h5", ".npz", ".csv", ".parquet")


def find_file(name_or_path: str | PathLike[str]) -> tuple[Path, DatasetSpec | None]:
    """
    The file of a dataset.

    A path (see :func:`is_path`) wins over a name. A D4RL id is never answered with a ``-sb3`` file, nor with one of Minari.

    :param name_or_path: file, id or alias of the catalogue, ``minari:`` and an id of Minari, or the folder of such a dataset
    :return: existing file, and the entry of the catalogue if the name or the file name is known there
    :raises DatasetNotFoundError: if there is no such file; the message says where to put it and what is available
    :raises DatasetError: if it is neither a path nor a known name
    """
    if is_minari(name_or_path):
        return find_minari(name_or_path).file, None
    if is_path(name_or_path):
        path = expanded(name_or_path)
        if not exists(path):
            raise DatasetNotFoundError("no such file", where=str(path), hint=_available_hint(), path=path)
        return path, spec_of_file(path)
    spec = resolve(os.fspath(name_or_path))
    found = search(spec)
    if found is None:
        raise _not_found(spec)
    return found, spec


def known_dataset(name_or_path: str | PathLike[str]) -> DatasetSpec | None:
    """
    The entry of the catalogue that :func:`find_file` would give, whether the file is here or not.

    :param name_or_path: as for :func:`find_file`
    :return: entry of the catalogue, ``None`` if the name or the file name is not known there
    """
    if is_minari(name_or_path):
        return None
    if is_path(name_or_path):
        return spec_of_file(name_or_path)
    try:
        return resolve(os.fspath(name_or_path))
    except DatasetError:
        return None


def catalogue_id(dataset: str | None) -> str | None:
    """
    Id under which the hyperparameters and the reference scores of a dataset are looked up, whether its file is here or not.

    :param dataset: id or file name
    :return: id of the catalogue, ``None`` if it is not in there
    """
    spec = None if dataset is None else known_dataset(dataset)
    return None if spec is None else spec.id


def is_path(name_or_path: str | PathLike[str]) -> bool:
    """
    Whether a dataset is given by its file or folder rather than by its name.

    :param name_or_path: as for :func:`find_file`
    :return: True for a ``Path``, a text with a separator or with the suffix of a dataset (``SUFFIXES``), any existing file,
        and the folder of a dataset of Minari
    """
    if is_minari_name(name_or_path):
        return False
    if not isinstance(name_or_path, str) or name_or_path.endswith(SUFFIXES):
        return True
    has_separator = any(separator and separator in name_or_path for separator in (os.sep, os.altsep))
    return has_separator or os.path.isfile(expanded(name_or_path)) or folder_of(name_or_path) is not None


def search(spec: DatasetSpec) -> Path | None:
    """
    The file of a dataset, looked for by D4RL's file name and by ``<id>.hdf5``.

    :param spec: entry of the catalogue
    :return: existing file, None if there is none
    """
    folders = [embedded_folder()] if spec.embedded else []
    names = dict.fromkeys((spec.file_name, f"{spec.id}.hdf5"))
    candidates = (folder / name for folder in [*folders, *search_folders()] for name in names)
    return next((path for path in candidates if os.path.isfile(path)), None)  # a folder that may not be read has none


def require_file(path: str | PathLike[str]) -> Path:
    """
    A file that can be opened, for the formats that :func:`~sb3_dce.data.file_checks.read_head` does not know.

    :param path: file
    :return: the same, as a ``Path``
    :raises DatasetNotFoundError: if there is no such file
    :raises DatasetFormatError: if it is a folder or a device
    :raises DatasetError: if it may not be read
    """
    path = Path(path)
    if not exists(path):
        raise DatasetNotFoundError("no such file", where=str(path), hint="Check the path", path=path)
    if not path.is_file():
        raise DatasetFormatError("not a file", where=str(path), hint="Name a file", path=path)
    if not os.access(path, os.R_OK):
        raise DatasetError("may not be read", where=str(path), hint="Change its mode", path=path)
    return path


def available() -> list[tuple[DatasetSpec, Path]]:
    """
    The datasets of the catalogue whose file is on this machine.

    :return: pairs of entry and file, in the order of the catalogue
    """
    return [(spec, path) for spec in all_specs() if (path := search(spec)) is not None]


def embedded_folder() -> Path:
    """
    Folder of the files that come with the package.

    :return: folder, inside the installed package
    """
    return Path(str(resources.files("sb3_dce.data"))) / "files"


def cache_folder() -> Path:
    """
    Folder in which this package keeps datasets, ``~/.cache/sb3_dce/datasets`` or its place below ``$XDG_CACHE_HOME``.

    :return: folder, need not exist
    :raises ConfigError: for a user without a home folder
    """
    base = expanded(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    if base.parts[:1] == ("~",):
        hint = f"Name a folder in $XDG_CACHE_HOME or ${DATASETS_VARIABLE}."
        raise ConfigError("this user has no home folder in which datasets could be kept", key="HOME", hint=hint)
    return base / "sb3_dce" / "datasets"


def search_folders() -> list[Path]:
    """
    The folders in which a dataset is looked for after the files of the package, in this order.

    :return: folders, need not exist
    """
    own = os.environ.get(DATASETS_VARIABLE, "").split(os.pathsep)
    d4rl = os.environ.get("D4RL_DATASET_DIR", "")
    folders = [expanded(folder) for folder in own if folder]
    with suppress(ConfigError):
        folders.append(cache_folder())
    folders += [expanded(folder) for folder in (d4rl, "~/.d4rl/datasets") if folder]
    return [folder for folder in folders if folder.parts[:1] != ("~",)]


def _not_found(spec: DatasetSpec) -> DatasetNotFoundError:
    target = next(iter(search_folders()), Path()) / spec.file_name
    here = available()
    stand_ins = [twin.id for twin, _ in here if twin.generated and twin.paper_row == spec.paper_row and twin != spec]
    hint = f"Put the file at {target}"
    if spec.url:
        hint = f"Run: sb3-dce datasets download {spec.id} - or by hand: Download {spec.url} to {target}"
    hint += f", or name another folder in ${DATASETS_VARIABLE}, or give the path of the file."
    if stand_ins:
        hint += f" Similar data made with this package, to be asked for by their own name: {', '.join(stand_ins)}."
    elif spec.url and (twin := _twin(spec)) is not None:
        hint += f" Similar data can be made by a policy, which is trained or given: sb3-dce datasets generate {twin.id}."
    return DatasetNotFoundError(
        f"{spec.file_name} not found; searched {', '.join(map(str, search_folders()))}",
        where=f"dataset {spec.id}",
        hint=f"{hint} {_available_hint()}",
        path=target,
        key=spec.id,
    )


def _twin(spec: DatasetSpec) -> DatasetSpec | None:
    """The set of this package with the name of an official one."""
    name = f"{spec.id.rpartition('-')[0]}-sb3"
    return next((twin for twin in all_specs() if twin.id == name and twin.generated), None)


def _available_hint() -> str:
    ids = [spec.id for spec, _ in available()]
    return f"Available now: {', '.join(ids)}" if ids else "No dataset of the catalogue is on this machine"


def short_name(dataset: str | PathLike[str]) -> str:
    """
    Name of a dataset for folders and headings, without the folder it lies in.

    :param dataset: as for :func:`find_file`, but need not be here: a run is known by it after its data have moved
    :return: the id, of Minari with ``-`` in place of ``/``, or the file's name without suffix
    :raises DatasetError: if it is a folder of Minari whose metadata cannot be read
    """
    if is_minari(dataset):  # all of Minari's files have the same name
        name = dataset if is_minari_name(dataset) else find_minari(dataset).name
        return name.removeprefix(PREFIX).replace("/", "-")
    spec = known_dataset(dataset)
    return Path(dataset).stem if spec is None else spec.id
