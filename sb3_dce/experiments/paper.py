"""
The paper's numbers: its tables as printed (``paper_facts/*.csv``), and what its own rows say about its claims.

``paper_scores.csv`` holds every cell of Table 1 ("gym") and of the Adroit and Kitchen table; an empty score is a dash, an
empty standard deviation was not printed. ``paper_config.csv`` and ``beta_schedules.csv`` hold the 23 configurations.
"""

from __future__ import annotations

import csv
from functools import cache
from importlib import resources
from typing import NamedTuple

from sb3_dce.experiments.statistics import Total, total

METHODS = ("BC", "UWAC", "PBRL", "IQL", "TD3-BC", "CQL", "DCE")
PAPER_SEEDS = 5
# Experiment to table of ``paper_scores.csv``.
TABLES = {"table1": "gym", "table-adroit-kitchen": "adroit_kitchen"}
MIXED_PROTOCOLS = "The paper's baselines are copied from other papers, with other protocols."


class PaperScore(NamedTuple):
    """
    A cell of the paper's tables.

    :param score: normalised score, ``None`` for a dash
    :param std: as printed, ``None`` where none is
    :param bold: whether it is printed bold
    """

    score: float | None
    std: float | None
    bold: bool


def read_csv(name: str) -> list[dict[str, str]]:
    """
    Facts typed from the paper, one dictionary per line of the file, with the words of its first line as keys.

    :param name: file in ``paper_facts``
    :return: its rows, as text
    """
    path = resources.files("sb3_dce.experiments") / "paper_facts" / name
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


@cache
def paper_scores() -> dict[tuple[str, str, str], PaperScore]:
    """
    All cells of both tables, read once; the printed totals and "runtime-s" are among them as datasets.

    :return: (table, dataset, method) to cell
    """
    return {
        (row["table"], row["dataset"], row["method"]): PaperScore(
            float(row["score"]) if row["score"] else None,
            float(row["std"]) if row["std"] else None,
            "bold" in row["note"],
        )
        for row in read_csv("paper_scores.csv")
    }


def paper_score(dataset: str, method: str) -> PaperScore | None:
    """
    What the paper prints for an agent on a dataset, whichever of its tables has that.

    :param dataset: D4RL id
    :param method: the paper's name of the agent
    :return: cell, without a score where it is a dash; ``None`` if there is none
    """
    for table in TABLES.values():
        found = paper_scores().get((table, dataset, method))
        if found is not None:
            return found
    return None


def gym_rows() -> list[str]:
    """The twelve datasets of Table 1, in its order, without its lines of totals and run times."""
    names = dict.fromkeys(dataset for table, dataset, _ in paper_scores() if table == "gym")
    return [name for name in names if name.endswith("-v2")]


def paper_total(method: str, datasets: list[str]) -> Total | None:
    """
    Sum over the printed rows, since not every printed total agrees with them; a deviation that is not printed adds nothing.

    :param method: the paper's name of the agent
    :param datasets: rows
    :return: sums, ``None`` if one of the rows is a dash or is not there
    """
    cells = [paper_score(dataset, method) for dataset in datasets]
    known = [cell for cell in cells if cell is not None and cell.score is not None]
    if len(known) != len(datasets):
        return None
    return total([c.score or 0.0 for c in known], [c.std or 0.0 for c in known])


def leaders(datasets: list[str]) -> dict[str, str]:
    """
    Who is first on each dataset by the printed scores, whatever is bold; of equal ones the first in ``METHODS``.

    :param datasets: rows
    :return: dataset to method
    """
    best = {}
    for dataset in datasets:
        cells = {method: paper_score(dataset, method) for method in METHODS}
        scores = {method: cell.score for method, cell in cells.items() if cell is not None and cell.score is not None}
        best[dataset] = max(scores, key=scores.__getitem__)
    return best
