"""
Where DCE stays behind BC or IQL: what its own diagnostics say, and which single change of reading or setting closes the gap.

This looks for causes; nothing found here is put into a results table.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from sb3_dce.experiments.captions import caption_of
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.grid import Variant
from sb3_dce.experiments.judging import CLEARLY, CLOSE, GAP, Uncertainty, differs, uncertainty
from sb3_dce.experiments.readings import mean_over_seeds
from sb3_dce.experiments.text_table import TextTable

# A change counts as a cause if it closes this share of the distance to the better of BC and IQL.
SHARE = 0.5
RIVALS = ("BC", "IQL")


def score_of(evidence: Evidence, variant: Variant, dataset_id: str) -> float | None:
    """
    Mean over seeds of a variant's scores at the end of its runs; one diverged seed makes it count as failed.

    :param evidence: rows
    :param variant: column
    :param dataset_id: row
    :return: normalised score, ``None`` without runs, or if one diverged
    """
    if evidence.n_diverged(variant, dataset_id):
        return None
    scores = evidence.last(variant, dataset_id)
    return float(scores.mean()) if len(scores) else None


def variant_table(evidence: Evidence) -> TextTable:
    """
    What each single change of DCE's settings does to its score, with a finding for every data set.

    :param evidence: of the search for causes
    :return: score of DCE, its rivals and its changed forms on every data set
    """
    variants = evidence.experiment.variants
    rows = []
    for _, name in evidence.table_rows():
        scores = [score_of(evidence, v, name) for v in variants]
        cells = [_cell(evidence, v, name, score) for v, score in zip(variants, scores, strict=True)]
        rows.append((name, *cells, verdict_of(evidence, name)))
    header = ("data", *(v.name for v in variants), "finding")
    note = (
        "Each column after DCE changes one thing of the paper's row; 'scaled rewards' is one setting for all data, beta 4 "
        f"with returns that spread over 1000. A change is named as a cause if it closes at least {SHARE:.0%} of the distance "
        f"between DCE and the better of BC and IQL, and is clearly better ({CLEARLY}). '=' is a change that is none: the row "
        "has it already, or, as a constant beta, over the length of the runs. Numbers of seeds stand where there are several. "
        "Rising and falling are the same share between the middle and the end of the run; the survival condition is that the "
        "mean reward exceeds beta_eff."
    )
    return TextTable(header, tuple(rows), f"{_caption(evidence)} {note}")


def _cell(evidence: Evidence, variant: Variant, dataset_id: str, score: float | None) -> str:
    dce = evidence.experiment.variant("DCE")
    if variant.algo == dce.algo and variant is not dce and _is_same(evidence, variant, dce, dataset_id):
        return "="
    if score is None:
        return "diverged" if evidence.n_diverged(variant, dataset_id) else "-"
    n = len(evidence.last(variant, dataset_id))
    return f"{score:.1f}" + (f" ({n} seeds)" if n > 1 else "")


def diagnostics_table(evidence: Evidence) -> TextTable:
    """
    Diagnostics beside the course of the score: terminals, survival margin, ``gap_td``, Q, distance of actions, alpha.

    :param evidence: of the search for causes
    :return: what DCE logged on every data set that it has runs on
    """
    dce = evidence.experiment.variant("DCE")
    rows = []
    for _, name in evidence.table_rows():
        if not len(evidence.rows_of(dce, name)):
            continue
        terminals, reward = (evidence.start(dce, name, f"data_{what}") for what in ("n_terminals", "reward_mean"))
        middle, end = middle_and_end(evidence, dce, name)
        cells = [terminals, reward, lowest_margin(evidence, dce, name)]
        cells += [evidence.tail(dce, name, m) for m in ("beta_eff", "gap_td", "q_data", "action_dist", "ent_coef")]
        rows.append((name, *(_number(value) for value in (*cells, middle, end))))
    header = (
        *("data", "terminals", "mean reward", "smallest survival margin", "beta_eff", "gap_td", "Q on the data"),
        *("distance of actions", "alpha", "score at 40 to 60 %", "score at the end"),
    )
    note = (
        "Diagnostics of DCE with the paper's row; means over the last tenth of the run where nothing else is said. The "
        "survival margin is the mean reward less beta_eff: below 0, with terminals, ending an episode pays."
    )
    return TextTable(header, tuple(rows), f"{_caption(evidence, dce)} {note}")


def _caption(evidence: Evidence, *agents: Variant) -> str:
    """These tables show nothing of another length than the row's but what a finding names."""
    variants = list(agents or evidence.experiment.variants)
    runs = [evidence.rows_of(v, name) for _, name in evidence.table_rows() for v in variants]
    return caption_of(evidence, pd.concat(runs) if runs else pd.DataFrame(), variants)


def verdict_of(evidence: Evidence, dataset_id: str) -> str:
    """
    How far DCE is behind the better of BC and IQL, and which changes, diagnostics or longer runs account for it.

    :param evidence: of the search for causes
    :param dataset_id: data
    :return: in words, what the rows say about DCE's place
    """
    experiment = evidence.experiment
    scores = {v.name: score_of(evidence, v, dataset_id) for v in experiment.variants}
    variant, dce = experiment.variant("DCE"), scores["DCE"]
    rivals = {name: score for name in RIVALS if (score := scores[name]) is not None}
    if n_lost := evidence.n_diverged(variant, dataset_id):
        return f"DCE diverged on {n_lost} of {evidence.rows_of(variant, dataset_id)['seed'].nunique()} seeds"
    if dce is None or not rivals:
        return "not tested"
    best = max(rivals, key=rivals.__getitem__)

    def uncertain(of: Variant) -> Uncertainty:
        return uncertainty(evidence, of, dataset_id)

    own = uncertain(variant)
    gap = rivals[best] - dce
    if gap <= 0:
        return f"not behind ({best} {rivals[best]:.1f})"
    close = differs(gap, uncertain(experiment.variant(best)), own) == CLOSE
    causes, excluded = [], []
    margin = lowest_margin(evidence, variant, dataset_id)
    if (evidence.start(variant, dataset_id, "data_n_terminals") or 0) > 0 and margin is not None:
        if margin < 0:
            causes.append(f"survival condition broken (margin {margin:.2f})")
        else:
            excluded.append(f"survival condition kept (margin {margin:.2f})")
    changes = [v for v in experiment.variants if v.algo == variant.algo and not _is_same(evidence, v, variant, dataset_id)]
    changed = {v.name: score for v in changes if (score := scores[v.name]) is not None}
    lost = [f"{v.name} diverged" for v in changes if evidence.n_diverged(v, dataset_id)]
    for v in changes:
        name, score = v.name, changed.get(v.name)
        if score is None or score - dce < SHARE * gap:
            continue
        if differs(score - dce, uncertain(v), own) is True:
            causes.append(f"{name} closes {(score - dce) / gap:.0%}")
    middle, end = middle_and_end(evidence, variant, dataset_id)
    if middle is not None and end is not None and abs(end - middle) >= SHARE * gap:
        causes.append(f"{'still rising' if end > middle else 'falling'} ({middle:.1f} in the middle of the run)")
    if (longer := evidence.last_of_longer(variant, dataset_id)) is not None:
        n, late = len(longer[0]), evidence.late_mean_of_longer(variant, dataset_id)
        also = "" if late is None else f"; mean of the last ten evaluations {late:.1f}"
        causes.append(f"{longer[0].mean():.1f} after {longer[1]:,} steps ({n} seed{'s' if n > 1 else ''}{also})")
    excluded += lost
    gap_td, unit = (evidence.tail(variant, dataset_id, metric) for metric in ("gap_td", "beta_eff"))
    if gap_td is not None and unit and abs(gap_td) > GAP * unit:
        excluded.append(f"gap_td is {abs(gap_td) / unit:.0%} of beta_eff, so that the shift is not checked there")
    if not causes or not (changed or lost):
        excluded.insert(0, "none of the changes explains it" if changed or lost else "no change was run")
    behind = f"behind {best} by {gap:.1f}" + (", which seeds can do" if close else "")
    return f"{behind}: {'; '.join([*causes, *excluded])}"


def _is_same(evidence: Evidence, one: Variant, other: Variant, dataset_id: str) -> bool:
    """Whether two variants of DCE are the same agent over the length of the runs, whatever their schedules do later."""
    return evidence.key_of(one, dataset_id) == evidence.key_of(other, dataset_id)


def lowest_margin(evidence: Evidence, variant: Variant, dataset_id: str) -> float | None:
    """
    Smallest ``survival_margin`` (mean reward less ``beta_eff``) logged at any step of any seed.

    :param evidence: rows
    :param variant: DCE
    :param dataset_id: data
    :return: reward units per step, ``None`` where it was not logged
    """
    curve = evidence.curve(variant, dataset_id, "survival_margin")
    return None if curve.empty else float(np.nanmin(curve.to_numpy()))


def middle_and_end(evidence: Evidence, variant: Variant, dataset_id: str) -> tuple[float | None, float | None]:
    """
    Mean scores in the middle and at the end of the runs, by which a finding says rising or falling.

    :param evidence: rows
    :param variant: agent
    :param dataset_id: data
    :return: mean score of the evaluations between 40 and 60 % of the run, and in its last tenth; ``None`` without any there
    """
    curve = evidence.curve(variant, dataset_id, "score")
    shares = curve.index / (evidence.n_updates(dataset_id) or 1)
    middle = curve[(shares >= 0.4) & (shares <= 0.6)]
    return mean_over_seeds(middle), evidence.tail_mean(curve, dataset_id)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
