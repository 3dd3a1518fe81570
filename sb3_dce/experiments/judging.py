"""
From numbers to outcomes: what a claim is tested with, and when two scores are too close for one or few seeds to tell.

"held" and "did not hold" are about these data and these lengths, no more; "could not be tested" is for missing runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from sb3_dce.experiments.evidence import N_JUMPS, Evidence
from sb3_dce.experiments.grid import Variant
from sb3_dce.experiments.paper import PAPER_SEEDS, paper_score
from sb3_dce.experiments.statistics import sample_std
from sb3_dce.student import std_factors, student_quantile, welch_freedom

HELD, NOT_HELD, CLOSE, UNTESTED = "held", "did not hold", "too close to tell", "could not be tested"

TENTH = "means over the last tenth of the run"
# Standard deviation of the score over seeds where there are fewer than three: DCE after 50,000 steps on
# halfcheetah-medium-sb3, five seeds (docs/results/halfcheetah-medium-sb3.md).
SEED_STD = 4.2
SEED_STD_FREEDOM = 4
CLEARLY = (
    "outside of the 95 % interval of Welch's test over seeds, where an agent with fewer than three has the largest standard "
    f"deviation of these: {SEED_STD:g} (DCE on HalfCheetah, five seeds), that of the paper's DCE on such data (five seeds), "
    "those of the experiment's agents with two seeds or more on these data, after any number of steps, and that of its own "
    "last three evaluations, by which a curve that jumps, or still rises, tells little; deviations are those of last scores, "
    "also where means over the last tenth of the run are compared (of a run of 50,000 steps that is its last evaluation)"
)
# Seeds from which on an agent's own deviation is taken.
FEWEST_OWN = 3
# A mean of Q that is nearer to its target than this share of beta_eff bears out that the penalty shifts it by beta_eff.
GAP = 0.2
# Below this score a policy does not do its task, so that comparisons of it say nothing.
WORKING = 5.0


class Verdict(NamedTuple):
    """
    A claim of the paper with the rule by which it was judged, the outcome, and the numbers that decided.

    :param claim: of the paper
    :param rule: when it counts as borne out
    :param outcome: "held", "did not hold", "too close to tell" or "could not be tested"
    :param numbers: what the rule was applied to
    :param is_check: whether it is about formulas or files of ours, so that no run could refute it
    """

    claim: str
    rule: str
    outcome: str
    numbers: str
    is_check: bool = False


class Uncertainty(NamedTuple):
    """
    How far seeds alone can move the mean score of an agent, as Welch's test takes it.

    :param error: standard error of a mean over seeds
    :param freedom: degrees of freedom of its estimate
    :param borrowed: whether the deviation is that of other runs, so that it is no second estimate beside theirs
    """

    error: float
    freedom: float
    borrowed: bool = False


def judge(claim: str, rule: str, holds: bool | str | None, numbers: str) -> Verdict:
    """
    Verdict from the result of a rule: true is "held", false "did not hold", ``None`` "could not be tested".

    :param claim: of the paper
    :param rule: applied
    :param holds: outcome, ``CLOSE``, or ``None`` without the runs it needs
    :param numbers: shown; without any an untested claim has "runs are missing"
    :return: verdict
    """
    if isinstance(holds, str):
        return Verdict(claim, rule, holds, numbers)
    outcome = UNTESTED if holds is None else HELD if holds else NOT_HELD
    return Verdict(claim, rule, outcome, numbers if holds is not None else numbers or "runs are missing")


class Values(dict[str, float]):
    """
    Numbers by variant.

    :ivar scope: data, length and seeds they rest on
    :ivar other_kind: how the data differ in kind from those that the paper's claim is about; empty if they do not
    :ivar errors: uncertainty over seeds of each; only scores have one
    """

    scope = ""
    other_kind = ""

    def __init__(self, values: Iterable[tuple[str, float]] = ()) -> None:
        super().__init__(values)
        self.errors: dict[str, Uncertainty] = {}

    def text(self, digits: int = 1) -> str:
        """
        Numbers as a verdict shows them, such as "BC: 42.0, DCE: diverged (scope)"; what is not finite has diverged.

        :param digits: behind the point
        :return: names, numbers and, if there is one, the scope in brackets; empty without numbers
        """
        shown = {name: f"{value:.{digits}f}" if math.isfinite(value) else "diverged" for name, value in self.items()}
        numbers = ", ".join(f"{name}: {value}" for name, value in shown.items())
        return f"{numbers} ({self.scope})" if numbers and self.scope else numbers


def values_of(evidence: Evidence, names: list[str], metric: str, dataset: str | None = None) -> Values | None:
    """
    Numbers that a claim compares: what each variant has become by the end of its runs, all of one length on the same data.

    :param evidence: rows
    :param names: of variants
    :param metric: name
    :param dataset: D4RL id; ``None`` for the grid's first
    :return: value of each variant: mean of the last tenth, over seeds; of scores minus infinity if a run diverged, since then
        the agent has failed; ``None`` if one is missing
    """
    view = evidence.among(names)
    dataset_id = view.id_of(dataset)
    if dataset_id is None:
        return None
    values = Values()
    variants = [view.experiment.variant(name) for name in names]
    for variant in variants:
        value = view.tail(variant, dataset_id, metric)
        if metric == "score" and view.n_diverged(variant, dataset_id):
            value = -math.inf
        if value is None:
            return None
        values[variant.name] = value
        if metric == "score":
            values.errors[variant.name] = uncertainty(view, variant, dataset_id)
    values.scope = view.scope(dataset_id, variants)
    values.other_kind = view.other_kind(dataset)
    return values


def uncertainty(evidence: Evidence, variant: Variant, dataset_id: str) -> Uncertainty:
    """
    Standard error of an agent's mean score, from its own seeds if it has three or more, else from the largest known deviation.

    :param evidence: rows of the experiment, or the part of it that a claim is about
    :param variant: agent
    :param dataset_id: data
    :return: of their mean; one or two seeds say little on their spread, what is taken for it is said in ``CLEARLY``
    """
    own = evidence.last(variant, dataset_id)
    n = max(1, len(own))
    if n >= FEWEST_OWN:
        return Uncertainty(sample_std(own) / math.sqrt(n), n - 1)
    papers = {evidence.paper_id(dataset) for dataset, name in evidence.table_rows() if name == dataset_id}
    cells = [paper_score(paper, "DCE") for paper in papers]
    known = [cell.std for cell in cells if cell is not None and cell.std is not None]
    largest, jumps = max([SEED_STD, evidence.largest_spread(dataset_id), *known]), evidence.jumps(variant, dataset_id)
    if jumps > largest:
        return Uncertainty(jumps / math.sqrt(n), n * (N_JUMPS - 1))
    return Uncertainty(largest / math.sqrt(n), SEED_STD_FREEDOM, borrowed=True)


def above(values: Values | None, first: str, second: str) -> bool | str | None:
    """
    Whether a variant scores more than another, by more than seeds could do; without an answer if both diverged.

    :param values: scores
    :param first: name
    :param second: name
    :return: whether the first is above the second, ``CLOSE`` if seeds alone could have made the difference, ``None`` if both
        diverged or there are no scores
    """
    if values is None or values[first] == values[second] == -math.inf:
        return None
    return differs(values[first] - values[second], values.errors[first], values.errors[second])


def differs(difference: float, one: Uncertainty, other: Uncertainty, n_tests: int = 1) -> bool | str:
    """
    Sign of a difference of two means by Welch's two-sided test, with no more degrees of freedom than a borrowed deviation has.

    :param difference: of two scores
    :param one: uncertainty of the first
    :param other: uncertainty of the second
    :param n_tests: differences any of which would decide a claim: the 5 % are divided among them (Bonferroni)
    :return: whether it is positive, ``CLOSE`` within the 95 % interval of the test
    """
    error = math.hypot(one.error, other.error)
    if error == 0.0:
        return CLOSE if difference == 0 else difference > 0
    freedom = welch_freedom((one.error, other.error), (one.freedom, other.freedom))
    freedom = min([freedom, *(each.freedom for each in (one, other) if each.borrowed)])
    return CLOSE if abs(difference) <= student_quantile(freedom, 1.0 - 0.05 / n_tests) * error else difference > 0


def spreads_beyond(spreads: Mapping[str, np.ndarray], limit: float, *named: str) -> bool | str | None:
    """
    Whether scores spread over seeds by more than a limit, tested by the chi-square interval of their standard deviation.

    :param spreads: scores by data, one per seed
    :param limit: of their standard deviation
    :param named: beginnings of the ids of the data on which the paper has it; without any of these nothing is said against it
    :return: whether it is above on some data, false if it is below on all, by its 95 % interval, divided among the data;
        ``CLOSE`` if neither; ``None`` without the data that are needed, with as many seeds as the paper's
    """
    known = {name: scores for name, scores in spreads.items() if len(scores) >= PAPER_SEEDS}
    intervals = [sample_std(s) * np.array(std_factors(len(s), 1.0 - 0.05 / len(known))) for s in known.values()]
    if any(low > limit for low, _ in intervals):
        return True
    if not any(name.startswith(named) for name in known):
        return None
    return False if all(high < limit for _, high in intervals) else CLOSE


def all_of(parts: Iterable[bool | str | None]) -> bool | str | None:
    """
    Outcome of a claim with several parts: a part that is false refutes it, even if others could not be tested.

    :param parts: outcomes
    :return: false if one is; else ``None`` if one is; else ``CLOSE`` if one is; else true
    """
    found = list(parts)
    if any(part is False for part in found):
        return False
    if any(part is None for part in found):
        return None
    return CLOSE if CLOSE in found else True


def text_of(*parts: Values | None) -> str:
    """
    Numbers of a claim that compares more than once, without those for which runs are missing.

    :param parts: numbers, those that are there
    :return: their texts, with commas between them
    """
    return ", ".join(text for part in parts if part is not None and (text := part.text()))


def falling(values: Values | None) -> bool | None:
    """
    Whether numbers fall strictly, as Q with a larger beta; how far seeds move them is not asked.

    :param values: in the order of the claim
    :return: whether each is below the one before; ``None`` if runs are missing
    """
    return None if values is None else bool(np.all(np.diff(list(values.values())) < 0))


def rising(values: Values | None) -> bool | None:
    """
    Whether numbers rise strictly, as Q with a higher expectile; how far seeds move them is not asked.

    :param values: in the order of the claim
    :return: whether each is above the one before; ``None`` if runs are missing
    """
    return None if values is None else bool(np.all(np.diff(list(values.values())) > 0))


def scoped(evidence: Evidence) -> Values:
    """
    Values for a test to fill, with the scope of all variants of the evidence on the grid's first data.

    :param evidence: rows of the variants concerned
    :return: no numbers yet; no scope either if there are no rows
    """
    values, dataset_id = Values(), evidence.id_of(None)
    if dataset_id is not None:
        values.scope = evidence.scope(dataset_id, evidence.experiment.variants)
    return values


def lengths_and_seeds(evidence: Evidence, variant: Variant, dataset_ids: Iterable[str]) -> str:
    """
    Scope of a statement over several data sets, in which each length with its number of seeds is said once.

    :param evidence: rows
    :param variant: agent
    :param dataset_ids: data, each of which has its number under its name
    :return: such as "50,000 steps, 1 seed; 100,000 steps, 3 seeds"
    """
    scopes = [evidence.scope(name, [variant]).removeprefix(f"{name}, ") for name in dataset_ids]
    return "; ".join(dict.fromkeys(scopes))


def on_this_kind(
    claim: str, rule: str, holds: bool | str | None, values: Values | None, digits: int = 1, *, absence: str = ""
) -> Verdict:
    """
    What is claimed of a kind of data is not tested on another.

    :param claim: of the paper
    :param rule: applied
    :param holds: outcome if the data are of this kind
    :param values: numbers
    :param digits: behind the point
    :param absence: what is shown without numbers
    :return: verdict
    """
    text = absence if values is None else values.text(digits)
    if values is None or not values.other_kind:
        return judge(claim, rule, holds, text)
    return judge(claim, rule, None, f"{values.other_kind}: {text}")


def all_diverged(evidence: Evidence, variant: Variant, dataset_id: str | None) -> bool:
    """
    Whether an agent has runs on these data and every one of them diverged: it has failed, which is a result.

    :param evidence: rows
    :param variant: agent
    :param dataset_id: data, ``None`` without any
    :return: false without data or runs
    """
    if dataset_id is None:
        return False
    n_runs = evidence.rows_of(variant, dataset_id)["seed"].nunique()
    return 0 < n_runs == evidence.n_diverged(variant, dataset_id)
