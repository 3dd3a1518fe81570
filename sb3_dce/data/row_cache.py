"""
Finished rows kept on disk, so that a compressed or a text file is read once only. Asked for with ``cache=True`` or
``$SB3_DCE_ROW_CACHE=1``.

An entry is two files: the row matrix as ``.npy``, which is mapped into memory and not read, and everything else as ``.npz``.
It is found again only for the same bytes of the data (SHA-256: size and time of change would miss a file that was restored or
copied over), the same options and the same code of this package; a checksum guards the matrix. An entry that is wrong in any
way is made anew, with a warning.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import warnings
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dce.data.build import BuiltRows
from sb3_dce.data.catalog import DatasetSpec
from sb3_dce.data.hashes import data_state, file_sha256
from sb3_dce.data.layout import RowLayout
from sb3_dce.data.locate import cache_folder, embedded_folder, require_file
from sb3_dce.data.records import DatasetInfo, Finding, ReadOptions
from sb3_dce.errors import CheckpointError, ConfigError, DatasetWarning
from sb3_dce.files import write_atomically

CACHE_VARIABLE = "SB3_DCE_ROW_CACHE"
FOLDER_NAME = ".sb3_dce_rows"
_WORDS = {"": False, "0": False, "false": False, "off": False, "1": True, "true": True, "on": True}


def cached_rows(
    path: Path, spec: DatasetSpec | None, options: ReadOptions, reader: Mapping[str, Any], build: Callable[[], BuiltRows]
) -> BuiltRows:
    """
    The rows of a file: from the cache if they are there, else built and, if a cache is wanted, kept.

    :param path: file of the data
    :param spec: its entry of the catalogue
    :param options: how it is read
    :param reader: what else the rows depend on: name and arguments of the reader
    :param build: reads the file
    :return: rows; from the cache they are mapped copy-on-write, so nothing that is written to them reaches the disk
    :raises DatasetError: if there is no entry and something is wrong with the file
    """
    if not is_wanted(options):
        return build()
    try:
        before = data_state(path)
        key = _key_of(require_file(path), spec, options, reader)
    except (OSError, TypeError, ValueError):  # no file, or impossible options: the reader has the better message
        return build()
    name = f"{path.name}.{hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]}"
    for folder in _folders(path):
        built = _load(folder / name, key, path)
        if built is not None and data_state(path) == before:
            return built
    built = build()
    if data_state(path) == before:
        _store(built, path, name, key)
    return built


def is_wanted(options: ReadOptions) -> bool:
    """
    Whether finished rows are to be kept: as ``cache`` says or, if it is None, ``$SB3_DCE_ROW_CACHE``, by default not.

    :param options: ``cache`` wins over the environment variable
    :return: True to keep and to look for them
    :raises ConfigError: if the variable is neither on nor off
    """
    if options.cache is not None:
        return options.cache
    text = os.environ.get(CACHE_VARIABLE, "")
    if text.lower() not in _WORDS:
        raise ConfigError(f"must be 0 or 1, got {text!r}", where=f"${CACHE_VARIABLE}", hint="1 keeps rows, 0 does not")
    return _WORDS[text.lower()]


def _key_of(path: Path, spec: DatasetSpec | None, options: ReadOptions, reader: Mapping[str, Any]) -> dict[str, Any]:
    """Everything the rows and the facts depend on, as JSON reads it back."""
    key = {
        "file": file_sha256(path),
        "id": spec.id if spec else path.stem,
        "spec": asdict(spec) if spec else None,
        "options": {name: value for name, value in asdict(options).items() if name != "cache"},
        "reader": dict(reader),
        "code": _code_hash(),
    }
    result: dict[str, Any] = json.loads(json.dumps(key, default=_plain))
    return result


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else repr(value)


@lru_cache(maxsize=1)
def _code_hash() -> str:
    """Hash of the modules that make rows: a change of a rule must not be answered with rows of the old one."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _folders(path: Path) -> list[Path]:
    """Where an entry may be: beside the data and, of a user with a home folder, below the user's cache folder."""
    folders = [path.absolute().parent / FOLDER_NAME]
    with suppress(ConfigError):
        folders.append(cache_folder().with_name("rows"))
    return folders


def _folder_to_write(path: Path) -> Path:
    """
    Where an entry is kept: beside the data, if that folder may be written and is not the package's own.

    :raises ConfigError: if it is none of both, for a user without a home folder
    """
    folder = path.absolute().parent
    is_installed = folder == embedded_folder().absolute()
    return cache_folder().with_name("rows") if is_installed or not os.access(folder, os.W_OK) else folder / FOLDER_NAME


# -- one entry -----------------------------------------------------------------------------------------------------


def _store(built: BuiltRows, path: Path, entry_name: str, key: Mapping[str, Any]) -> None:
    """Write an entry, its facts last, and remove those that it replaces."""
    arrays, scalars = {}, {}
    for name in _info_names():
        value = getattr(built.info, name)
        if isinstance(value, np.ndarray):
            arrays[f"info_{name}"] = value
        else:
            scalars[name] = [asdict(finding) for finding in value] if name == "findings" else value
    text = json.dumps(
        {
            "key": key,
            "obs_dim": built.layout.obs_dim,
            "act_dim": built.layout.act_dim,
            "crc32": zlib.crc32(built.rows.data),
            "info": scalars,
        },
        allow_nan=False,
    )
    arrays |= {"timeouts": built.timeouts, "episodes": built.episodes, "json": np.frombuffer(text.encode(), dtype=np.uint8)}
    try:
        entry = _folder_to_write(path) / entry_name
        matrix, facts = _files(entry)
        with write_atomically(matrix) as stream:
            np.save(stream, built.rows, allow_pickle=False)
        with write_atomically(facts) as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]
    except (CheckpointError, ConfigError) as exc:
        warnings.warn(f"rows not kept: {exc}", DatasetWarning)
        return
    _remove_outdated(entry, key)


def _load(entry: Path, key: Mapping[str, Any], path: Path) -> BuiltRows | None:
    """The rows of an entry, None if it is not there or wrong."""
    matrix, facts = _files(entry)
    if not os.path.exists(facts):
        return None
    try:
        arrays = _read_facts(facts)
        known = json.loads(arrays["json"].tobytes())
        if known["key"] != key:
            raise ValueError("it belongs to other data")
        layout = RowLayout(known["obs_dim"], known["act_dim"])
        timeouts, episodes = arrays["timeouts"], arrays["episodes"]
        rows = np.asarray(np.load(matrix, mmap_mode="c", allow_pickle=False))
        kinds = (rows.dtype, timeouts.dtype, episodes.dtype) == (np.float32, np.bool_, np.int32)
        shapes = rows.shape == (len(timeouts), layout.width) and timeouts.shape == episodes.shape
        if not (kinds and shapes and rows.flags.c_contiguous and zlib.crc32(rows.data) == known["crc32"]):
            raise ValueError("its rows are not those that were written")
        values = {**known["info"], **{name.removeprefix("info_"): arrays[name] for name in arrays if name.startswith("info_")}}
        values["findings"] = tuple(Finding(**finding) for finding in values["findings"])
        if values.keys() != set(_info_names()):
            raise ValueError("facts are missing")
        return BuiltRows(rows, layout, timeouts, episodes, DatasetInfo(id=key["id"], path=path, **values))
    except Exception as exc:  # whatever is wrong with an entry, the data themselves can still be read
        warnings.warn(f"{facts}: the kept rows cannot be used ({exc}); reading the data again", DatasetWarning)
        return None


def _read_facts(facts: Path) -> dict[str, np.ndarray]:
    with open(facts, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
        return dict(archive)


def _files(entry: Path) -> tuple[Path, Path]:
    """Row matrix and facts of an entry."""
    return Path(f"{entry}.npy"), Path(f"{entry}.npz")


def _info_names() -> list[str]:
    return [field.name for field in fields(DatasetInfo) if field.init and field.name not in ("id", "path")]


def _remove_outdated(entry: Path, key: Mapping[str, Any]) -> None:
    """
    Remove the entries of other code, which nothing reads again, and those of earlier contents of the file. The latter beside
    the data only: elsewhere the name does not say which file it was.
    """
    outdated = ["code", "file"] if entry.parent.name == FOLDER_NAME else ["code"]
    name = entry.name.rpartition(".")[0]
    for facts in entry.parent.glob(f"{glob.escape(name)}.{'[0-9a-f]' * 16}.npz"):
        try:
            known = json.loads(_read_facts(facts)["json"].tobytes())["key"]
            if any(known[part] != key[part] for part in outdated):
                for file in (facts, facts.with_suffix(".npy")):
                    file.unlink(missing_ok=True)
        except Exception:  # unreadable: it will be replaced when its data are read
            continue
