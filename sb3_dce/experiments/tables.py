"""Tables made from rows: Markdown, LaTeX and CSV of the same cells, the paper's numbers in columns of their own."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_dce.data.catalog import resolve
from sb3_dce.execution import UPDATES_WORTH_COMPILING
from sb3_dce.experiments.evidence import Evidence, at_end, curve_of
from sb3_dce.experiments.grid import Variant, source_of, variant_hash
from sb3_dce.experiments.paper import paper_score, paper_scores
from sb3_dce.experiments.statistics import (
    N_RESAMPLES,
    Interval,
    bootstrap_interval,
    iqm,
    mean_interval,
    mean_of_tasks,
    probability_of_improvement,
    sample_std,
    total,
)
from sb3_dce.files import write_text
from sb3_dce.precision import PRECISIONS

BOLD_RULE = (
    "Bold: the 95 % interval over seeds (Student's t) overlaps that of the best mean of the row; none where that has one "
    "seed. ± is the sample standard deviation over seeds. 'After n' are runs of another length than those of the row."
)

# A probability from fewer comparisons of single runs says nothing.
FEWEST_PAIRS = 5
MIXED_PROTOCOLS = "The paper's baselines are copied from other papers, with other protocols."


@dataclass(frozen=True)
class TextTable:
    """
    Cells as text.

    :param header: headings
    :param rows: cells; ``**text**`` is bold
    :param caption: where the numbers come from
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str

    def markdown(self) -> str:
        """
        :return: table and caption
        """
        lines = [self.header, tuple("---" for _ in self.header), *self.rows]
        return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + f"\n\n{self.caption}\n"

    def latex(self) -> str:
        """
        :return: ``table`` environment; needs the package booktabs
        """
        lines = [r"\begin{table}", r"\centering", r"\begin{tabular}{l" + "r" * (len(self.header) - 1) + "}", r"\toprule"]
        body = [" & ".join(_latex(cell) for cell in cells) + r" \\" for cells in (self.header, *self.rows)]
        lines += [body[0], r"\midrule", *body[1:], r"\bottomrule", r"\end{tabular}"]
        return "\n".join([*lines, rf"\caption{{{_latex(self.caption)}}}", r"\end{table}", ""])

    def csv(self) -> str:
        """
        :return: cells without marks of bold
        """
        text = io.StringIO(newline="")
        csv.writer(text).writerows([self.header, *([c.replace("**", "") for c in row] for row in self.rows)])
        return text.getvalue()

    def write(self, folder: Path, name: str, endings: Sequence[str] = ("md", "tex", "csv")) -> list[Path]:
        """
        :param folder: of the tables
        :param name: of the files, without ending
        :param endings: which files
        :return: files
        """
        folder.mkdir(parents=True, exist_ok=True)
        written = []
        texts = {"md": self.markdown, "tex": self.latex, "csv": self.csv}
        for ending in endings:
            path, text = folder / f"{name}.{ending}", texts[ending]()
            write_text(path, text)
            written.append(path)
        return written


def score_table(evidence: Evidence) -> TextTable:
    """
    Scores of all agents on all data, and the paper's beside them.

    :param evidence: of an experiment with a table
    :return: one row per file; a dataset of the paper without results is a row "not run" or "no data"
    """
    variants = list(evidence.experiment.variants)
    methods = [v.paper for v in variants if v.paper is not None]
    header = ("data", *(f"ours: {v.name}" for v in variants), "D4RL set of the paper", *(f"paper: {m}" for m in methods))
    rows = []
    for dataset in evidence.experiment.datasets:
        paper = evidence.paper_id(dataset)
        printed = tuple(_paper_cell(paper, method) for method in methods)
        ids = evidence.ids(dataset)
        if not ids and evidence.scale.source != "embedded":
            rows.append((f"{dataset.twin or dataset.paper}: {dataset.absence}", *("" for _ in variants), paper, *printed))
        for name in ids:
            best = _best_interval([evidence.last(v, name) for v in variants])
            cells = tuple(score_cell(evidence, v, name, best) for v in variants)
            note = f" ({dataset.note})" if dataset.note and name == dataset.twin else ""
            rows.append((f"{name}{note}", *cells, paper, *printed))
    ids = [name for _, name in evidence.table_rows()]
    tuned = (
        "DCE has the paper's row of each dataset; the paper tuned these by evaluating online. 'One setting' has its commonest "
        "row everywhere."
    )
    return TextTable(header, tuple(rows), f"{evidence.caption(ids)} {BOLD_RULE} {tuned} {MIXED_PROTOCOLS}")


def score_cell(evidence: Evidence, variant: Variant, dataset_id: str, best: Interval | None) -> str:
    """
    :param evidence: rows
    :param variant: column
    :param dataset_id: row
    :param best: interval of the best mean of the row, ``None`` if that has one seed
    :return: mean, deviation, number of seeds if it is not the usual one, and how many diverged
    """
    scores, diverged = evidence.last(variant, dataset_id), evidence.n_diverged(variant, dataset_id)
    lost = f" ({diverged} diverged)" if diverged else ""
    if not len(scores):
        other = evidence.last_of_other_length(variant, dataset_id)
        if other is not None:
            return f"{_mean_and_spread(other[0])} (after {other[1]:,})"
        return lost.strip() or "-"
    text = _mean_and_spread(scores)
    if best is not None and len(scores) > 1 and mean_interval(scores).overlaps(best):
        text = f"**{text}**"
    return text + lost


def _mean_and_spread(scores: np.ndarray) -> str:
    return f"{scores.mean():.1f}" + (f" ± {sample_std(scores):.1f}" if len(scores) > 1 else "")


def _best_interval(columns: list[np.ndarray]) -> Interval | None:
    best = max((scores for scores in columns if len(scores)), key=lambda scores: scores.mean(), default=np.empty(0))
    return mean_interval(best) if len(best) > 1 else None


def _paper_cell(dataset: str, method: str) -> str:
    cell = paper_score(dataset, method)
    if cell is None or cell.score is None:
        return "-"
    text = f"{cell.score:g}" + (f" ± {cell.std:g}" if cell.std is not None else "")
    return f"**{text}**" if cell.bold else text


def parts_of(evidence: Evidence) -> list[str]:
    """
    :param evidence: of an experiment with a table
    :return: what totals are formed over, never over two of them: "D4RL" and "sb3", with a family behind if there are several
    """
    families = list(dict.fromkeys(resolve(dataset.paper).family for dataset in evidence.experiment.datasets))
    endings = [f"-{family}" for family in families] if len(families) > 1 else [""]
    return [f"{source}{ending}" for source in ("D4RL", "sb3") for ending in endings]


def common_rows(evidence: Evidence, part: str) -> list[str]:
    """
    :param evidence: rows
    :param part: one of :func:`parts_of`
    :return: data of this part on which every agent of the paper has a score, but for agents that have run on fewer than half
        of the data of the one with the most: a total over the little they have would say nothing about the others
    """
    ids = _rows_of_part(evidence, part)
    papers = [v for v in evidence.experiment.variants if v.paper is not None]
    counts = [sum(len(evidence.last(v, name)) > 0 for name in ids) for v in papers]
    variants = [v for v, count in zip(papers, counts, strict=True) if count and 2 * count >= max(counts)]
    return [name for name in ids if variants and all(len(evidence.last(v, name)) for v in variants)]


def compared(evidence: Evidence, ids: list[str]) -> list[Variant]:
    """
    :param evidence: rows
    :param ids: data
    :return: columns with a score on all of them that are not DCE once more ("one setting" where it is the row's everywhere)
    """
    hashes: list[list[str]] = []
    found = []
    for variant in evidence.experiment.variants:
        runs = [variant_hash(variant, name, evidence.scale) for name in ids]
        if variant.datasets is None and runs not in hashes and all(len(evidence.last(variant, name)) for name in ids):
            hashes.append(runs)
            found.append(variant)
    return found


def _rows_of_part(evidence: Evidence, part: str) -> list[str]:
    source, _, family = part.partition("-")
    rows = [name for _, name in evidence.table_rows() if source_of(name) == source]
    return [name for name in rows if not family or resolve(name).family == family]


def _counted(n: int) -> str:
    return "the one data set" if n == 1 else f"the {n} data sets"


def aggregate_tables(evidence: Evidence) -> dict[str, TextTable]:
    """
    :param evidence: of an experiment with a table
    :return: by part of :func:`parts_of` totals, interquartile means and probabilities of improvement
    """
    tables = {}
    for part in parts_of(evidence):
        ids = common_rows(evidence, part)
        if ids:
            tables[part] = _aggregate_table(evidence, ids)
    return tables


def _aggregate_table(evidence: Evidence, ids: list[str]) -> TextTable:
    variants = compared(evidence, ids)
    dce = next((v for v in variants if v.name == "DCE"), None)
    paper_rows = [evidence.paper_id(dataset) for dataset, name in evidence.table_rows() if name in ids]
    header = (
        *("agent", "total", "paper's style of ± (sum of stds)", "std of the total"),
        *("mean", "IQM", "95 % interval of the IQM", "P(DCE > agent)", "runs", "paper: total of its rows, D4RL"),
    )
    rows = []
    for variant in variants:
        scores = [evidence.last(variant, name) for name in ids]
        stds = [sample_std(task) for task in scores]
        sums = total([task.mean() for task in scores], stds)
        spreads = ("-", "-") if np.isnan(stds).any() else (f"{sums.paper_std:.1f}", f"{sums.std:.1f}")
        low, high = bootstrap_interval(scores, iqm)
        chance = "-"
        n_pairs = sum(len(evidence.last(dce, name)) * len(task) for name, task in zip(ids, scores, strict=True)) if dce else 0
        if dce is not None and variant is not dce and n_pairs >= FEWEST_PAIRS:
            chance = f"{probability_of_improvement([evidence.last(dce, name) for name in ids], scores):.2f}"
        printed = [None if variant.paper is None else paper_score(name, variant.paper) for name in paper_rows]
        known = [cell.score for cell in printed if cell is not None and cell.score is not None]
        rows.append(
            (
                variant.name,
                *(f"{sums.mean:.1f}", *spreads, f"{mean_of_tasks(scores):.1f}", f"{iqm(scores):.1f}"),
                f"{low:.1f} to {high:.1f}" if all(len(task) > 1 for task in scores) else "-",
                chance,
                str(sum(len(task) for task in scores)),
                f"{sum(known):.1f}" if len(known) == len(printed) else "-",
            )
        )
    note = (
        f"Over {_counted(len(ids))} on which the paper's agents have runs of one length; those that were run on fewer than "
        "half of the data are left out. IQM is the mean of the middle half of all scores, P(DCE > agent) the share of pairs "
        "of runs on the same data in which DCE scores more. Each data set has the same weight. The interval is a "
        f"stratified bootstrap over seeds within data sets ({N_RESAMPLES:,} resamples; none with one seed); the deviation of "
        f"the total takes the rows as independent. {MIXED_PROTOCOLS}"
    )
    return TextTable(header, tuple(rows), f"{evidence.caption(ids, variants)} {note}")


def runtime_table(evidence: Evidence) -> TextTable:
    """
    :param evidence: rows of whole agents
    :return: seconds per 1000 updates beside the paper's, one row per agent, device and precision
    """
    rows = []
    ids = [name for _, name in evidence.table_rows()]
    for variant in evidence.experiment.variants:
        if variant.paper is None:  # DCE again, with other numbers
            continue
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
    return TextTable(header, tuple(rows), f"{evidence.caption(ids)} {note}")


def has_fewer_draws(evidence: Evidence, variant: Variant) -> bool:
    """
    :param evidence: rows at a scale
    :param variant: agent
    :return: whether the scale makes each of its updates cheaper than the authors'
    """
    return "n_mc_dropout" in evidence.scale.set_for.get(variant.algo, {})


HASTENED = tuple(name for name in PRECISIONS if name != "float32")


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
    :return: of each complete run, whatever its length, that was trained alone: members of a population have its time together
    """
    # smoke scale has small networks
    fewer, runs = has_fewer_draws(evidence, variant) or bool(evidence.scale.set), []
    for name in dataset_ids:
        rows = pd.concat([evidence.runs(variant, name), evidence.of_other_length(variant, name)])
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


def long_table(evidence: Evidence) -> TextTable:
    """
    :param evidence: rows
    :return: one line per data and agent, for programs: last score, mean of the last ten evaluations, best, per seed
    """
    header = (
        *("dataset", "source", "agent", "hyperparameters", "n_updates", "n_seeds", "n_diverged", "mean", "std", "ci_low"),
        *("ci_high", "mean_paper_episodes", "mean_last_10_evaluations", "mean_best_evaluation", "scores"),
        *("paper_dataset", "paper_score", "paper_std"),
    )
    rows = []
    for dataset, name in evidence.table_rows():
        for variant in evidence.variants(dataset):
            runs = evidence.runs(variant, name)
            runs = runs if len(runs) else evidence.of_other_length(variant, name)
            scores, lost = at_end(runs, "score"), int((runs["metric"] == "diverged").sum())
            if not len(scores) and not lost:
                continue
            numbers = ["", "", "", "", "", "", "", ""]
            if len(scores):
                low, high = mean_interval(scores) if len(scores) > 1 else (float("nan"), float("nan"))
                few = at_end(runs, "score_paper_episodes")
                curve = curve_of(runs, "score")
                paper_mode = float(few.mean()) if len(few) else float("nan")
                last_ten = float(curve.tail(10).mean().mean()) if len(curve) > 10 else float("nan")
                late = (last_ten, float(curve.max().mean()))
                values = (float(scores.mean()), sample_std(scores), low, high, paper_mode, *late)
                numbers = ["" if np.isnan(v) else f"{v:.4f}" for v in values] + [" ".join(f"{s:.4f}" for s in scores)]
            paper = evidence.paper_id(dataset)
            cell = None if variant.paper is None else paper_score(paper, variant.paper)
            printed = ["" if v is None else f"{v:g}" for v in ((None, None) if cell is None else (cell.score, cell.std))]
            settings, length = runs["hyperparameters"].iloc[0], str(runs["n_updates"].iloc[0])
            start = [name, source_of(name), variant.name, settings, length, str(len(scores)), str(lost)]
            rows.append((*start, *numbers, paper, *printed))
    return TextTable(header, tuple(rows), "")


def _latex(text: str) -> str:
    for sign in ("\\", "&", "%", "_", "#", "$", "{", "}"):
        text = text.replace(sign, r"\textbackslash " if sign == "\\" else f"\\{sign}")
    text = text.replace("±", r"$\pm$").replace("…", r"\dots{}").replace("`", "").replace(">", "$>$")
    parts = text.split("**")
    return "".join(rf"\textbf{{{part}}}" if i % 2 else part for i, part in enumerate(parts))
