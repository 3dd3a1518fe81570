"""Tables made from rows: scores, totals and a long one for programs, the paper's numbers in columns of their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from sb3_dce.data.catalog import resolve
from sb3_dce.experiments.captions import caption, caption_of
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.grid import Variant, source_of
from sb3_dce.experiments.paper import MIXED_PROTOCOLS, paper_score, paper_total
from sb3_dce.experiments.readings import N_LATE, at_end, devices_in, ended_scores, last_of_each, mean_over_seeds, n_diverged_in
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
from sb3_dce.experiments.text_table import TextTable
from sb3_dce.theory import Q_LIMIT

BOLD_RULE = (
    "Bold: the 95 % interval over seeds (Student's t) overlaps that of the best mean of the row; none where that has one "
    "seed. ± is the sample standard deviation over seeds, whose number stands where it differs from the row's commonest. "
    "'After n' are runs of another length than those of the row."
)
MARK = "†"

# A probability from fewer comparisons of single runs says nothing.
FEWEST_PAIRS = 5


def score_table(evidence: Evidence) -> TextTable:
    """
    Scores of all agents on all data, and the paper's beside them.

    :param evidence: of an experiment with a table
    :return: one row per file; a dataset of the paper without results is a row "not run" or "no data"; totals
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
            columns = [evidence.last(v, name) for v in variants]
            counts = [len(scores) for scores in columns if len(scores)]
            best = _best_interval([s for v, s in zip(variants, columns, strict=True) if not evidence.n_diverged(v, name)])
            usual = max(counts, key=lambda n: (counts.count(n), n), default=0)
            cells = tuple(score_cell(evidence, v, name, best, usual) for v in variants)
            note = f" ({dataset.note})" if dataset.note and name == dataset.twin else ""
            rows.append((f"{name}{note}", *cells, paper, *printed))
    ids = [name for _, name in evidence.table_rows()]
    rows += _total_rows(evidence, methods)
    tuned = (
        "DCE has the paper's row of each dataset; the paper tuned these by evaluating online. 'One setting' has its commonest "
        "row everywhere; up to the first change of beta, after 50,000 steps, both are one agent where the row begins alike."
    )
    return TextTable(header, tuple(rows), f"{caption(evidence, ids)} {BOLD_RULE}{mark_note(rows)} {tuned} {MIXED_PROTOCOLS}")


def mark(evidence: Evidence, variant: Variant, ids: list[str]) -> str:
    """
    Mark behind a number that a run whose critics diverged has a part in.

    :param evidence: rows
    :param variant: agent
    :param ids: data the number is made of
    :return: with a space before it; empty if no run of these did
    """
    return f" {MARK}" if any(evidence.overvalues(variant, name) for name in ids) else ""


def mark_note(rows: Sequence[Sequence[str]]) -> str:
    """
    What the mark says, if it is there.

    :param rows: cells of a table
    :return: a sentence with a space before it; empty if no cell ends with the mark
    """
    if not any(cell.endswith(MARK) for row in rows for cell in row):
        return ""
    return (
        f" {MARK}: the critics diverge on a seed, their mean Q on the data ends beyond {Q_LIMIT:g} times the largest return "
        "that the rewards allow, max |r| / (1 - gamma); totals and comparisons have these scores, too."
    )


def _total_rows(evidence: Evidence, methods: list[str]) -> list[tuple[str, ...]]:
    """By family and source a sum over all its sets, ours where an agent has run on all of them; the paper's as printed."""
    found = []
    datasets = evidence.experiment.datasets if evidence.scale.source != "embedded" else ()
    for family in dict.fromkeys(resolve(dataset.paper).family for dataset in datasets):
        wanted = [dataset for dataset in datasets if resolve(dataset.paper).family == family]
        printed = {method: paper_total(method, [dataset.paper for dataset in wanted]) for method in methods}
        paper = tuple(
            "-" if t is None else f"{t.mean:.1f}" + (f" ± {t.paper_std:.1f}" if t.paper_std else "") for t in printed.values()
        )
        for source in ("D4RL", "sb3"):
            ids = [name for dataset in wanted for name in evidence.ids(dataset) if source_of(name) == source]
            if source == "sb3" and not ids:
                continue
            totals, lengths = [], {evidence.n_updates(name) for name in ids}
            for variant in evidence.experiment.variants:
                scores = [evidence.last(variant, name) for name in ids]
                whole = len(ids) == len(wanted) and all(map(len, scores)) and len(lengths) == 1
                whole = whole and not any(evidence.n_diverged(variant, name) for name in ids)
                totals.append(f"{sum(task.mean() for task in scores):.1f}{mark(evidence, variant, ids)}" if whole else "-")
            label = f"total of {len(wanted)} {family} sets, {'D4RL' if source == 'D4RL' else 'our own'}"
            found.append((label, *totals, "", *(paper if source == "D4RL" else ("",) * len(paper))))
    return found


def score_cell(evidence: Evidence, variant: Variant, dataset_id: str, best: Interval | None, usual: int) -> str:
    """
    One agent's scores on one data set, in bold where their interval overlaps that of the row's best.

    :param evidence: rows
    :param variant: column
    :param dataset_id: row
    :param best: interval of the best mean of the row, ``None`` if that has one seed
    :param usual: commonest number of seeds of the row
    :return: mean, deviation, number of seeds if it is not the usual one, and how many diverged; without runs of the row's
        length the same of its longest, marked as such, or "-"
    """
    sign = mark(evidence, variant, [dataset_id])
    longest = evidence.of_other_length(variant, dataset_id)
    if len(longest):
        return _cell_of_other_length(longest, usual) + sign
    scores, diverged = evidence.last(variant, dataset_id), evidence.n_diverged(variant, dataset_id)
    lost = f" ({diverged} diverged)" if diverged else ""
    if not len(scores):
        return lost.strip() or "-"
    text = mean_and_spread(scores)
    if best is not None and not diverged and len(scores) > 1 and mean_interval(scores).overlaps(best):
        text = f"**{text}**"
    if len(scores) != usual:
        text += f" ({_seeds(scores)})"
    return text + lost + sign


def _cell_of_other_length(rows: pd.DataFrame, usual: int) -> str:
    """Of runs that are compared with nobody."""
    scores, diverged, after = at_end(rows, "score"), n_diverged_in(rows), f"after {int(rows['n_updates'].iloc[0]):,}"
    lost = [f"{diverged} diverged"] if diverged else []
    if not len(scores):
        return f"({', '.join([*lost, after])})" if lost else "-"
    number = [] if len(scores) == usual else [_seeds(scores)]
    return f"{mean_and_spread(scores)} ({', '.join([after, *number, *lost])})"


def _seeds(scores: np.ndarray) -> str:
    return f"{len(scores)} seed{'s' if len(scores) > 1 else ''}"


def mean_and_spread(scores: np.ndarray) -> str:
    """
    A cell of scores.

    :param scores: one per seed
    :return: mean, and from two seeds on ± the sample standard deviation
    """
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
    Parts of the data by source and family; a total is formed over one of them, never over two.

    :param evidence: of an experiment with a table
    :return: "D4RL" and "sb3", with a family behind if there are several
    """
    families = list(dict.fromkeys(resolve(dataset.paper).family for dataset in evidence.experiment.datasets))
    endings = [f"-{family}" for family in families] if len(families) > 1 else [""]
    return [f"{source}{ending}" for source in ("D4RL", "sb3") for ending in endings]


def common_rows(evidence: Evidence, part: str) -> list[str]:
    """
    The data that totals and performance profiles are taken over.

    :param evidence: rows
    :param part: one of :func:`parts_of`
    :return: data of this part on which every agent of the paper has runs, all of the commonest length, but for agents that
        have run on fewer than half of the data of the one with the most: a total over the little they have would say nothing
        about the others
    """
    ids = rows_of_part(evidence, part)
    papers = [v for v in evidence.experiment.variants if v.paper is not None]
    counts = [sum(evidence.has_ended(v, name) for name in ids) for v in papers]
    variants = [v for v, count in zip(papers, counts, strict=True) if count and 2 * count >= max(counts)]
    ids = [name for name in ids if variants and all(evidence.has_ended(v, name) for v in variants)]
    lengths = [evidence.n_updates(name) or 0 for name in ids]
    usual = max(lengths, key=lambda n: (lengths.count(n), n), default=0)
    return [name for name, length in zip(ids, lengths, strict=True) if length == usual]


def compared(evidence: Evidence, ids: list[str]) -> list[Variant]:
    """
    Agents that aggregates may compare; those that the grid has on some data only are left out.

    :param evidence: rows
    :param ids: data
    :return: columns with runs on all of them that are not DCE once more ("one setting" where it is the row's everywhere)
    """
    hashes: list[list[str]] = []
    found = []
    for variant in evidence.experiment.variants:
        runs = [evidence.key_of(variant, name) for name in ids]
        if variant.datasets is None and runs not in hashes and all(evidence.has_ended(variant, name) for name in ids):
            hashes.append(runs)
            found.append(variant)
    return found


def n_diverged(evidence: Evidence, variant: Variant, ids: list[str]) -> int:
    """
    Diverged runs of an agent over several data sets; with a single one it has neither a total nor a profile.

    :param evidence: rows
    :param variant: column
    :param ids: data
    :return: their number; an agent with one has failed, and what is left of it is no total
    """
    return sum(evidence.n_diverged(variant, name) for name in ids)


def rows_of_part(evidence: Evidence, part: str) -> list[str]:
    """
    The data of a part that have runs.

    :param evidence: rows
    :param part: one of :func:`parts_of`
    :return: ids, in the order of the grid
    """
    source, _, family = part.partition("-")
    rows = [name for _, name in evidence.table_rows() if source_of(name) == source]
    return [name for name in rows if not family or resolve(name).family == family]


def _counted(n: int) -> str:
    return "the one data set" if n == 1 else f"the {n} data sets"


def aggregate_tables(evidence: Evidence) -> dict[str, TextTable]:
    """
    One table of aggregates for each part of the data that has common rows.

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
    dce = next((v for v in variants if v.name == "DCE" and not n_diverged(evidence, v, ids)), None)
    paper_rows = [evidence.paper_id(dataset) for dataset, name in evidence.table_rows() if name in ids]
    header = (
        *("agent", "total", "paper's style of ± (sum of stds)", "std of the total"),
        *("mean", "IQM", "95 % interval of the IQM", "P(DCE > agent)", "runs", "paper: total of its rows, D4RL"),
    )
    rows = []
    for variant in variants:
        if lost := n_diverged(evidence, variant, ids):
            rows.append((f"{variant.name} ({lost} diverged)", *("-" for _ in header[1:])))
            continue
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
                f"{variant.name}{mark(evidence, variant, ids)}",
                *(f"{sums.mean:.1f}", *spreads, f"{mean_of_tasks(scores):.1f}", f"{iqm(scores):.1f}"),
                f"{low:.1f} to {high:.1f}" if all(len(task) > 1 for task in scores) else "-",
                chance,
                str(sum(len(task) for task in scores)),
                f"{sum(known):.1f}" if len(known) == len(printed) else "-",
            )
        )
    note = (
        f"Over {_counted(len(ids))} on which the paper's agents have runs of one length; those that were run on fewer than "
        "half of the data are left out. An agent that diverged on a seed has no total. IQM is the mean of the middle half of "
        "all scores, P(DCE > agent) the share of pairs of runs on the same data in which DCE scores more. Each data set has "
        f"the same weight. The interval is a stratified bootstrap over seeds within data sets ({N_RESAMPLES:,} resamples; "
        f"none with one seed); the deviation of the total takes the rows as independent.{mark_note(rows)} {MIXED_PROTOCOLS}"
    )
    return TextTable(header, tuple(rows), f"{caption(evidence, ids, variants)} {note}")


def seed_table(evidence: Evidence) -> TextTable | None:
    """
    Scores seed by seed, which the mean and deviation of a cell hide: one good seed among failures, or all alike.

    :param evidence: of an experiment with a table
    :return: one row per agent, data and length with two seeds or more; ``None`` without any
    """
    rows, shown = [], []
    for dataset, name in evidence.table_rows():
        known: set[tuple[str, int]] = set()
        for variant in evidence.variants(dataset):
            every = evidence.rows_of_any_length(variant, name)
            for length in sorted(every["n_updates"].unique()):
                runs = every[every["n_updates"] == length]
                agent = evidence.key_of(variant, name, int(length)), int(length)
                ends = runs[(runs["metric"] == "score") & (runs["step"] == length) | (runs["metric"] == "diverged")]
                if agent in known or ends["seed"].nunique() < 2:  # "one setting" is the same agent where it is the row's
                    continue
                known.add(agent)
                shown.append(runs)
                ends = ends.sort_values(["seed", "metric"]).drop_duplicates("seed")  # "diverged" before "score"
                each = ["diverged" if e.metric == "diverged" else f"{e.value:.1f}" for e in ends.itertuples()]
                whole = ends[ends["metric"] == "score"]["value"].to_numpy(dtype=float)
                spread = f"{sample_std(whole):.1f}" if len(whole) > 1 else "-"
                rows.append((name, variant.name, devices_in(runs), f"{length:,}", ", ".join(each), spread))
    if not rows:
        return None
    header = (
        *("data", "agent", "device and precision", "gradient steps", "last score of each seed, in their order"),
        "sample standard deviation",
    )
    agents = [v for v in evidence.experiment.variants if any(v.name == row[1] for row in rows)]
    return TextTable(header, tuple(rows), caption_of(evidence, pd.concat(shown), agents))


def long_table(evidence: Evidence) -> TextTable:
    """
    Results for programs, to four decimals, with runs of every length instead of the row's alone.

    :param evidence: rows
    :return: one line per data, agent and length: last score, mean of the last ten evaluations, best, per seed
    """
    header = (
        *("dataset", "source", "agent", "hyperparameters", "device", "n_updates", "n_seeds", "n_diverged"),
        *("mean", "std", "ci_low"),
        *("ci_high", "mean_paper_episodes", "mean_last_10_evaluations", "mean_best_evaluation", "scores"),
        *("paper_dataset", "paper_score", "paper_std"),
    )
    rows = []
    cells = [(d, name, v) for d, name in evidence.table_rows() for v in evidence.variants(d)]
    for dataset, name, variant in cells:
        for length, runs in evidence.rows_of_any_length(variant, name).groupby("n_updates"):
            scores, lost = at_end(runs, "score"), n_diverged_in(runs)
            if not len(scores) and not lost:
                continue
            numbers = ["", "", "", "", "", "", "", ""]
            if len(scores):
                low, high = mean_interval(scores) if len(scores) > 1 else (float("nan"), float("nan"))
                few = at_end(runs, "score_paper_episodes")
                curve = ended_scores(runs)
                paper_mode = float(few.mean()) if len(few) else float("nan")
                last_ten = mean_over_seeds(last_of_each(curve, N_LATE))
                late = (float("nan") if last_ten is None else last_ten, float(curve.max().mean()))
                values = (float(scores.mean()), sample_std(scores), low, high, paper_mode, *late)
                numbers = ["" if np.isnan(v) else f"{v:.4f}" for v in values] + [" ".join(f"{s:.4f}" for s in scores)]
            paper = evidence.paper_id(dataset)
            cell = None if variant.paper is None else paper_score(paper, variant.paper)
            printed = ["" if v is None else f"{v:g}" for v in ((None, None) if cell is None else (cell.score, cell.std))]
            settings = runs["hyperparameters"].iloc[0]
            start = [name, source_of(name), variant.name, settings, devices_in(runs), str(length), str(len(scores)), str(lost)]
            rows.append((*start, *numbers, paper, *printed))
    return TextTable(header, tuple(rows), "")
