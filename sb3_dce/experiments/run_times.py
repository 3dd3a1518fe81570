"""What an update of each agent costs, from rows: a table beside the paper's, and the runs that were disturbed least."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_dce.execution import UPDATES_WORTH_COMPILING
from sb3_dce.experiments.captions import caption
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.grid import Variant
from sb3_dce.experiments.paper import MIXED_PROTOCOLS, paper_scores
from sb3_dce.experiments.text_table import TextTable
from sb3_dce.precision import PRECISIONS

HASTENED = tuple(name for name in PRECISIONS if name != "float32")


def runtime_table(evidence: Evidence) -> TextTable:
    """
    Seconds per 1000 updates beside the paper's; what hastens an agent stands with its device.

    :param evidence: rows of whole agents; those without a column in the paper's tables are left out
    :return: one row per agent, device and precision
    """
    rows = []
    ids = [name for _, name in evidence.table_rows()]
    listed = []
    for variant in evidence.experiment.variants:
        if variant.paper is None:  # DCE again, with other numbers
            continue
        listed.append(variant)
        cell = paper_scores().get(("gym", "runtime-s", variant.paper))
        printed = "-" if cell is None or cell.score is None else f"{cell.score:g}"
        runs = run_times(evidence, variant, evidence.shown(ids, [variant]))
        for device in sorted({run.device for run in runs}, key=lambda device: (" " in device, device)):
            rates = np.array([run.seconds for run in runs if run.device == device])
            spread = f"{rates.min():.1f} to {rates.max():.1f}"
            settings = "fewer draws" if has_fewer_draws(evidence, variant) else ""
            how = ", ".join(part for part in (device, settings) if part)
            rows.append((variant.name, how, f"{np.median(rates):.1f}", spread, str(len(rates)), printed))
    note = (
        "Wall time with evaluations, of runs beside others: an order; benchmarks/results/speed.md measures. On a CPU, runs of "
        f"up to {UPDATES_WORTH_COMPILING:,} steps are executed eagerly, longer ones compiled. Rounded products "
        f"(bf16-matmul) and fewer draws make an agent faster than the paper's. {MIXED_PROTOCOLS}"
    )
    header = ("agent", "device and precision", "s per 1000 updates (median)", "range", "runs", "paper: s per 1000, RTX 3070")
    return TextTable(header, tuple(rows), f"{caption(evidence, ids, listed)} {note}")


def is_hastened(device: str) -> bool:
    """
    Whether a run had rounded products.

    :param device: of rows, with the precision behind it where that is not float32
    :return: true for all other precisions
    """
    return device.rpartition(" ")[2] in HASTENED


def has_fewer_draws(evidence: Evidence, variant: Variant) -> bool:
    """
    Whether the scale sets the number of dropout passes or OOD actions, so that updates are cheaper than the authors'.

    :param evidence: rows at a scale
    :param variant: agent
    :return: whether one of these is in the scale's settings for the agent
    """
    return bool(evidence.scale.set_for.get(variant.algo, {}).keys() & {"n_mc_dropout", "n_ood_actions"})


class RunTime(NamedTuple):
    """
    What the updates of one run cost, with its evaluations.

    :param seconds: per 1000 updates
    :param device: and precision
    :param hastened: whether rounded products or settings of the scale make it faster than the authors' agent in float32
    """

    seconds: float
    device: str
    hastened: bool

    @property
    def text(self) -> str:
        """Seconds, and in brackets the device, as verdicts name the time of an agent."""
        return f"{self.seconds:.1f} s ({self.device})"


def run_times(evidence: Evidence, variant: Variant, rows: pd.DataFrame) -> list[RunTime]:
    """
    Times of an agent's runs that were trained alone: members of a population have its time together.

    :param evidence: at a scale, whose settings may hasten the agent
    :param variant: agent
    :param rows: of its runs
    :return: of each complete run
    """
    # smoke scale has small networks
    fewer = has_fewer_draws(evidence, variant) or evidence.scale.source == "embedded"
    alone = rows[(rows["metric"] == "seconds") & ~rows["device"].str.contains("population")]
    return [
        RunTime(1000.0 * value / n_updates, device, fewer or is_hastened(device))
        for value, n_updates, device in zip(alone["value"], alone["n_updates"], alone["device"], strict=True)
    ]


def fastest_runs(evidence: Evidence, names: Iterable[str]) -> dict[str, RunTime]:
    """
    The times by which agents are compared: of each the least, since other work on the machine can only add to it.

    :param evidence: rows
    :param names: of variants
    :return: by variant, of its runs with the authors' settings in float32; all of one length, since a CPU executes short runs
        otherwise than long ones, on one file and one kind of device, the one with most of the variants
    """
    names = list(names)
    view = evidence.among(names)
    if (dataset_id := view.id_of(None)) is None:
        return {}
    by_device: dict[str, dict[str, RunTime]] = {}
    for name in names:
        variant = view.experiment.variant(name)
        for run in run_times(view, variant, view.rows_of(variant, dataset_id)):
            known = by_device.setdefault(run.device, {})
            if not run.hastened and run.seconds <= known.get(name, run).seconds:
                known[name] = run
    return max(by_device.values(), key=len, default={})
