"""Minari's own download, with quick and clear failures. Only :func:`download_minari` uses the network."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request

from sb3_dce.data.minari import PREFIX, ROOT_VARIABLE, dataset_folder, find_minari, minari_id
from sb3_dce.data.network import Failed, Patience, make_opener, network_errors
from sb3_dce.errors import ConfigError, DatasetNotFoundError, DownloadError

REMOTE_VARIABLE = "MINARI_REMOTE"
DEFAULT_REMOTE = "hf://farama-minari"
_PATIENCE = Patience(connect=5.0, read=10.0)


def download_minari(name: str, *, force: bool = False, patience: Patience = _PATIENCE) -> Path:
    """
    A dataset of Minari, downloaded by minari if it is not on this machine.

    :param name: id, with or without ``minari:``
    :param force: download even if it is there; also what was made by a release of Minari that the installed one does not know
    :param patience: times to wait for the first answer of the server
    :return: the file that stands for the dataset
    :raises ConfigError: if minari is not installed
    :raises DownloadError: if it cannot be downloaded
    :raises DatasetError: if what is here or came is no dataset
    """
    dataset_id = minari_id(name)
    name = f"{PREFIX}{dataset_id}"
    if not force:
        with suppress(DatasetNotFoundError):
            return find_minari(name).file
    try:
        import minari
        from huggingface_hub.constants import ENDPOINT
    except ImportError as exc:
        raise ConfigError(
            f"{name} is downloaded with the package minari",
            where=f"package {exc.name}",
            hint='pip install "sb3_dce[minari]" (Python 3.11 or later)',
            key="minari",
        ) from exc
    remote = os.environ.get(REMOTE_VARIABLE) or DEFAULT_REMOTE
    if remote.startswith("hf://"):
        _require_answer(name, ENDPOINT, patience)
    folder = dataset_folder(name)
    try:
        # What is left of an interrupted download would be taken for the dataset.
        minari.download_dataset(dataset_id, force_download=force or folder.parent.exists())
    except Exception as exc:  # those of three packages for HTTP, of the hub, and of minari itself
        raise _failed(name, f"{remote}: {exc}") from exc
    return find_minari(name).file


def _require_answer(name: str, url: str, patience: Patience) -> None:
    """Without network the hub would try again and again for half a minute."""
    try:
        with network_errors():
            make_opener(patience).open(Request(url, method="HEAD"), timeout=patience.read).close()
    except Failed as failed:
        if not isinstance(failed.__cause__, HTTPError):  # which would be an answer
            raise _failed(name, f"{url}: {failed.what}") from failed


def _failed(name: str, what: str) -> DownloadError:
    folder = dataset_folder(name)
    return DownloadError(
        f"not downloaded. {what}",
        where=f"dataset {name}",
        hint=f"Try again later; or run `minari download {minari_id(name)}` on a machine with network and copy the folder it "
        f"makes to {folder.parent} (${ROOT_VARIABLE} names another root).",
        path=folder,
        key=name,
    )
