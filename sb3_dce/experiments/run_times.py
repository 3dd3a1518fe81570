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
    :param evidence: rows of whole agents
    :return: seconds per 1000 updates beside the paper's, one row per agent, device and precision
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
        runs = run_times(evidence, variant, ids)
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


def has_fewer_draws(evidence: Evidence, variant: Variant) -> bool:
    """
    :param evidence: rows at a scale
    :param variant: agent
    :return: whether the scale makes each of its updates cheaper than the authors'
    """
    return bool(evidence.scale.set_for.get(variant.algo, {}).keys() & {"n_mc_dropout", "n_ood_actions"})


class RunTime(NamedTuple):
    """
    :param seconds: per 1000 updates
    :param device: and precision
    :param hastened: whether rounded products or settings of the scale make it faster than the authors' agent in float32
    """

    seconds: float
    device: str
    hastened: bool

    @property
    def text(self) -> str:
        """
        :return: seconds and device
        """
        return f"{self.seconds:.1f} s ({self.device}{', fewer draws' if self.hastened and ' ' not in self.device else ''})"


def run_times(evidence: Evidence, variant: Variant, dataset_ids: list[str]) -> list[RunTime]:
    """
    :param evidence: rows
    :param variant: agent
    :param dataset_ids: data
    :return: of each complete run that is shown, of the row's length or else its longest, and that was trained alone: members
        of a population have its time together
    """
    # smoke scale has small networks
    fewer, runs = has_fewer_draws(evidence, variant) or evidence.scale.source == "embedded", []
    for name in dataset_ids:
        rows = pd.concat([evidence.rows_of(variant, name), evidence.of_other_length(variant, name)])
        alone = rows[(rows["metric"] == "seconds") & ~rows["device"].str.contains("population")]
        for value, n_updates, device in zip(alone["value"], alone["n_updates"], alone["device"], strict=True):
            runs.append(RunTime(1000.0 * value / n_updates, device, fewer or device.rpartition(" ")[2] in HASTENED))
    return runs


def fastest_runs(evidence: Evidence, names: Iterable[str]) -> dict[str, RunTime]:
    """
    :param evidence: rows
    :param names: of variants
    :return: of each variant the run that others disturbed least, of those with the authors' settings in float32; all on one
        file and one kind of device, the one with most of them
    """
    ids = [dataset_id] if (dataset_id := evidence.id_of(None)) is not None else []
    by_device: dict[str, dict[str, RunTime]] = {}
    for name in names:
        for run in run_times(evidence, evidence.experiment.variant(name), ids):
            known = by_device.setdefault(run.device, {})
            if not run.hastened and run.seconds <= known.get(name, run).seconds:
                known[name] = run
    return max(by_device.values(), key=len, default={})
