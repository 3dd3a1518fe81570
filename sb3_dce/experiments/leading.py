"""The paper's statements on where DCE is first (C4 to C6), judged by its place among all agents on the table's data."""

from __future__ import annotations

import math

from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.grid import GridDataset, Variant, settings_in_force, source_of
from sb3_dce.experiments.judging import CLOSE, Verdict, all_diverged, differs, judge, uncertainty
from sb3_dce.experiments.paper import PAPER_SEEDS
from sb3_dce.schedules import StepSchedule

DIVIDED = "the 5 % of the test are divided among all comparisons of the claim"
BEGUN = "only runs count in which DCE's schedule of beta, where it has one, has begun"
# Over these the paper claims no advantage on medium-expert sets.
EXPERT_RIVALS = ("PBRL", "IQL", "TD3-BC", "CQL")


def leading(evidence: Evidence) -> list[Verdict]:
    """
    What DCE's place among the paper's agents says on three groups of the Gym sets.

    :param evidence: of the Gym table
    :return: verdicts on C4, C5 and C6
    """
    cheetah = [f"halfcheetah-{kind}-v2" for kind in ("random", "medium", "medium-replay", "medium-expert")]
    datasets = evidence.experiment.datasets
    return [
        _is_best("C4: DCE is best on every HalfCheetah set", Field(evidence, [d for d in datasets if d.paper in cheetah])),
        _is_best(
            "C5: DCE is better on random, medium and medium-replay sets",
            Field(evidence, [d for d in datasets if not d.paper.endswith("-medium-expert-v2")]),
        ),
        _has_no_advantage(
            "C6: DCE has no significant advantage on medium-expert sets",
            Field(evidence, [d for d in datasets if d.paper.endswith("-medium-expert-v2")], EXPERT_RIVALS),
        ),
    ]


class Field:
    """
    DCE and all other agents of the paper on some of the table's data: on the paper's own files or on ours, never some of both.
    Those count on which DCE was run on more of the sets, of equally many the paper's.

    :param evidence: of a table
    :param wanted: rows of the table that the claim is about
    :param rivals: agents it names; ``None`` for all of the paper's
    """

    def __init__(self, evidence: Evidence, wanted: list[GridDataset], rivals: tuple[str, ...] | None = None) -> None:
        self.evidence = evidence
        self.dce = evidence.experiment.variant("DCE")
        papers = [v for v in evidence.experiment.variants if v.paper is not None and v is not self.dce]
        self.others = [v for v in papers if rivals is None or v.name in rivals]
        self.n_wanted = len(wanted)
        rows = [name for dataset, name in evidence.table_rows() if dataset in wanted]
        rows = [name for name in rows if len(evidence.last(self.dce, name)) or all_diverged(evidence, self.dce, name)]
        by_source = {source: [name for name in rows if source_of(name) == source] for source in ("D4RL", "sb3")}
        self.ids = max(by_source.values(), key=len)
        self.missing = [v.name for name in self.ids for v in self.agents if not evidence.has_ended(v, name)]
        lengths = {evidence.n_updates(name) for name in self.ids}
        self.too_short = [name for name in self.ids if not self._has_begun(name)]
        self.is_complete = 0 < len(wanted) == len(self.ids) and not self.missing and not self.too_short and len(lengths) == 1
        self.n_tests = max(1, sum(len(evidence.rows_of(v, name)) > 0 for v in self.others for name in self.ids))

    def _has_begun(self, dataset_id: str) -> bool:
        """Whether DCE's runs are long enough for beta to have changed where its row changes it at all."""
        schedule = StepSchedule.of(settings_in_force(self.dce, dataset_id, self.evidence.scale))
        is_constant = schedule.value(schedule.every) == schedule.initial
        return is_constant or (self.evidence.n_updates(dataset_id) or 0) > schedule.every

    @property
    def agents(self) -> list[Variant]:
        """DCE, then the other agents that have a column in the paper's tables; further forms of DCE have none."""
        return [self.dce, *self.others]

    def place(self, dataset_id: str) -> int:
        """
        DCE's place by the mean over seeds; agents that diverged on a seed, or have no scores, are behind all others.

        :param dataset_id: data
        :return: 1 for the first; agents with equal means share a place
        """
        means = {v.name: self._mean(v, dataset_id) for v in self.agents}
        return 1 + sum(means[v.name] > means["DCE"] for v in self.others)

    def _mean(self, agent: Variant, dataset_id: str) -> float:
        scores = self.evidence.last(agent, dataset_id)
        return float(scores.mean()) if len(scores) and not self.evidence.n_diverged(agent, dataset_id) else -math.inf

    def is_first(self, dataset_id: str) -> bool:
        """
        Whether DCE is above every other agent by more than seeds could do; one that diverged on a seed is below.

        :param dataset_id: data
        :return: false, too, where one of the others has neither scores nor diverged
        """
        return all(self._is_above(self.dce, v, dataset_id) for v in self.others)

    def ahead(self, dataset_id: str) -> list[str]:
        """
        Agents that are above DCE by more than seeds could do, whether the others have runs or not.

        :param dataset_id: data
        :return: names
        """
        return [v.name for v in self.others if self._is_above(v, self.dce, dataset_id)]

    @property
    def counted(self) -> list[str]:
        """The data on which DCE's schedule of beta, where it has one, has begun."""
        return [name for name in self.ids if name not in self.too_short]

    def has_failed(self, dataset_id: str) -> bool:
        """
        Whether DCE diverged on a seed.

        :param dataset_id: data
        :return: true, too, if no other agent has runs
        """
        return self.evidence.n_diverged(self.dce, dataset_id) > 0

    def _is_above(self, one: Variant, other: Variant, dataset_id: str) -> bool:
        lost = [self.evidence.n_diverged(v, dataset_id) > 0 for v in (one, other)]
        if any(lost):  # what diverges on a seed has failed
            return lost == [False, True] and len(self.evidence.last(one, dataset_id)) > 0
        scores = [self.evidence.last(v, dataset_id) for v in (one, other)]
        if not all(map(len, scores)):
            return False
        errors = [uncertainty(self.evidence, v, dataset_id) for v in (one, other)]
        return differs(float(scores[0].mean() - scores[1].mean()), errors[0], errors[1], self.n_tests) is True

    def numbers(self) -> str:
        """
        What stands beside a verdict; without runs of DCE it says that there are none.

        :return: DCE's places, those of one length and one number of seeds together, and which agents have no runs
        """
        if not self.ids:
            return "no runs of DCE as long as those of the others"
        by_scope: dict[str, list[str]] = {}
        for name in self.ids:
            scope = self.evidence.scope(name, self.agents).removeprefix(f"{name}, ")
            n_agents = sum(self.evidence.has_ended(v, name) for v in self.agents)
            by_scope.setdefault(scope, []).append(f"{name}: {self.place(name)} of {n_agents}")
        text = "place of DCE: " + "; ".join(f"{', '.join(places)} ({scope})" for scope, places in by_scope.items())
        clearly = {name: found for name in self.ids if (found := self.ahead(name))}
        text += "".join(f"; clearly ahead of it on {name}: {', '.join(found)}" for name, found in clearly.items())
        if self.too_short:
            text += f"; before the first change of beta: {len(self.too_short)} of {len(self.ids)} sets"
        absent = [f"{name} on {self.missing.count(name)} of {len(self.ids)} sets" for name in sorted(set(self.missing))]
        return text + (f"; without runs of this length: {', '.join(absent)}" if absent else "")


def _is_best(claim: str, field: Field) -> Verdict:
    rule = (
        "held: DCE is clearly above all the paper's agents on every such set, at one length; did not hold: on one of the sets "
        f"an agent is clearly above it, or it diverged; {BEGUN}; {DIVIDED}"
    )
    holds: bool | str | None = None
    # missing agents and data can only add to those that are ahead
    if any(field.ahead(name) or field.has_failed(name) for name in field.counted):
        holds = False
    elif field.is_complete:
        holds = True if all(map(field.is_first, field.ids)) else CLOSE
    return judge(claim, rule, holds, field.numbers())


def _has_no_advantage(claim: str, field: Field) -> Verdict:
    rule = (
        f"nowhere DCE is clearly above all of {', '.join(EXPERT_RIVALS)}; held if on every such set one of them is clearly "
        f"above it, or with {PAPER_SEEDS} seeds or more, since fewer show no advantage, whether there is one or not; {BEGUN}; "
        f"{DIVIDED}"
    )
    holds: bool | None = None
    if field.is_complete and any(map(field.is_first, field.ids)):
        holds = False
    elif field.n_wanted == sum(bool(field.ahead(name)) for name in field.counted):
        holds = True
    elif field.is_complete:
        seeds = [len(field.evidence.last(v, name)) for v in field.agents for name in field.ids]
        holds = True if min(seeds) >= PAPER_SEEDS else None
    return judge(claim, rule, holds, field.numbers())
