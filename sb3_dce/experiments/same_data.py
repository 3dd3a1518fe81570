"""
By which hash result rows name the data that are here.

A set that is generated again can be the same numbers in another file, since the file says with which processor and versions
it was made. Its runs belong to those that are known. So where a card beside the rows has these numbers, its hash counts.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from sb3_dce.data.catalog import resolve
from sb3_dce.data.comparison import DatasetCard
from sb3_dce.data.hashes import sha256_once
from sb3_dce.data.loading import load_transitions
from sb3_dce.data.locate import catalogue_id, search
from sb3_dce.experiments.results import merge


class DataHashes:
    """
    Hashes of the files on this machine, each replaced by that of a card whose numbers are identical.

    A file is read for it only if there is a card of its dataset with another hash, and only once.

    :param folders: of results, with cards in ``cards/`` (``sb3-dce datasets info <id> --card <file>`` writes them); of a
        folder ``rows`` those beside it; may have none
    :raises DatasetFormatError: if a file there is no card
    """

    def __init__(self, folders: Iterable[Path]) -> None:
        places = dict.fromkeys((folder.parent if folder.name == "rows" else folder) / "cards" for folder in folders)
        cards = [DatasetCard.read(path) for place in places for path in sorted(place.glob("*.json"))]
        self._cards = [card for card in cards if catalogue_id(card.id) == card.id]
        self._known_as: dict[tuple[str, str], str] = {}

    def here(self, dataset_id: str) -> str | None:
        """
        Which version of a dataset is here.

        :param dataset_id: id of the catalogue
        :return: SHA-256, ``None`` if there is no file of it on this machine
        """
        path = search(resolve(dataset_id))
        if path is None:
            return None
        own = sha256_once(path)
        if (dataset_id, own) not in self._known_as:
            cards = [card for card in self._cards if card.id == dataset_id]
            is_new = bool(cards) and all(card.sha256 != own for card in cards)
            content = _content_hash(path) if is_new else None
            same = (card.sha256 for card in cards if card.content_hash == content and card.sha256 is not None)
            self._known_as[dataset_id, own] = next(same, own)
        return self._known_as[dataset_id, own]

    def named(self, rows: pd.DataFrame) -> pd.DataFrame:
        """
        Rows of runs on a file that is here, under the hash that counts; others stay as they are.

        :param rows: rows
        :return: rows, each run once
        """
        known = {(card.id, card.sha256) for card in self._cards}
        with_card = {card.id for card in self._cards}
        pairs = rows[["dataset", "dataset_sha256"]].drop_duplicates().itertuples(index=False, name=None)
        for name, sha256 in (pair for pair in pairs if pair[0] in with_card and pair not in known):
            path = search(resolve(name))
            if path is not None and sha256_once(path) == sha256:
                is_own = (rows["dataset"] == name) & (rows["dataset_sha256"] == sha256)
                own = rows[is_own].assign(dataset_sha256=self.here(name))
                rows = merge([rows[~is_own], own])  # the same run may be there under both
        return rows


def _content_hash(path: Path) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # training says them
        return DatasetCard.of(load_transitions(path)).content_hash
