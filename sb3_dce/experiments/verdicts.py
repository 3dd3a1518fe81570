"""
What the paper claims, and whether our rows bear it out: each claim by a rule that is stated, on numbers that are shown.

"held" and "did not hold" are about these data and these lengths, no more; "could not be tested" is for missing runs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_dce.dce_probe import PROBE_BETAS
from sb3_dce.experiments.configuration import row_of
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.figures import probe_difference
from sb3_dce.experiments.grid import source_of
from sb3_dce.experiments.statistics import bootstrap_interval, sample_std
from sb3_dce.experiments.tables import fastest_run

HELD, NOT_HELD, UNTESTED = "held", "did not hold", "could not be tested"


class Verdict(NamedTuple):
    """
    :param claim: of the paper
    :param rule: when it counts as borne out
    :param outcome: "held", "did not hold" or "could not be tested"
    :param numbers: what the rule was applied to
    """

    claim: str
    rule: str
    outcome: str
    numbers: str


def verdicts(evidence: Evidence) -> list[Verdict]:
    """
    :param evidence: rows of one experiment
    :return: one verdict per claim it tests
    """
    return [verdict for test in _TESTS.get(evidence.experiment.id, ()) for verdict in test(evidence)]


def judge(claim: str, rule: str, holds: bool | None, numbers: str) -> Verdict:
    """
    :param claim: of the paper
    :param rule: applied
    :param holds: outcome, ``None`` without the runs it needs
    :param numbers: shown
    :return: verdict
    """
    outcome = UNTESTED if holds is None else HELD if holds else NOT_HELD
    return Verdict(claim, rule, outcome, numbers if holds is not None else numbers or "runs are missing")


class Values(dict[str, float]):
    """
    Numbers by variant.

    :ivar scope: data, length and seeds they rest on
    :ivar other_kind: how the data differ in kind from those that the paper's claim is about; empty if they do not
    """

    scope = ""
    other_kind = ""


def _values(evidence: Evidence, names: list[str], metric: str, dataset: str | None = None) -> Values | None:
    """Value of each variant at the end of its runs: mean of the last tenth, over seeds. None if one is missing."""
    dataset_id = evidence.id_of(dataset)
    if dataset_id is None:
        return None
    values, entry = Values(), evidence.entry(dataset)
    variants = [evidence.experiment.variant(name) for name in names]
    for variant in variants:
        value = evidence.tail(variant, dataset_id, metric)
        if value is None:
            return None
        values[variant.name] = value
    values.scope = evidence.scope(dataset_id, variants)
    if entry.other_kind and dataset_id == entry.twin:
        values.other_kind = entry.note or "of another kind"
    return values


def _all_diverged(evidence: Evidence, name: str) -> bool:
    """Whether every run of a variant on the grid's first data was lost."""
    dataset_id, variant = evidence.id_of(None), evidence.experiment.variant(name)
    if dataset_id is None:
        return False
    n_runs = evidence.runs(variant, dataset_id)["seed"].nunique()
    return 0 < n_runs == evidence.n_diverged(variant, dataset_id)


def _text(values: dict[str, float] | None, digits: int = 1) -> str:
    if not values:
        return ""
    scope = getattr(values, "scope", "")
    numbers = ", ".join(f"{name}: {value:.{digits}f}" for name, value in values.items())
    return f"{numbers} ({scope})" if scope else numbers


def _falling(values: dict[str, float] | None) -> bool | None:
    return None if values is None else bool(np.all(np.diff(list(values.values())) < 0))


def _rising(values: dict[str, float] | None) -> bool | None:
    return None if values is None else bool(np.all(np.diff(list(values.values())) > 0))


def _second_halves(evidence: Evidence, names: list[str], measure: Callable[[np.ndarray], float]) -> Values:
    """A measure of the second half of each variant's curve of in-data Q (mean over seeds), where there is a curve."""
    dataset_id, values = evidence.id_of(None), _scoped(evidence, names)
    for name in names:
        curve = None if dataset_id is None else evidence.curve(evidence.experiment.variant(name), dataset_id, "q_data")
        if curve is not None and len(curve) > 3:
            values[name] = measure(curve.mean(axis=1).to_numpy()[len(curve) // 2 :])
    return values


def _waviness(curve: np.ndarray) -> float:
    """Standard deviation about the straight line through a curve: a steady rise or fall is no wave."""
    steps = np.arange(len(curve))
    return float(np.std(curve - np.polyval(np.polyfit(steps, curve, 1), steps), ddof=1))


TENTH = "means over the last tenth of the run"


def _beta(evidence: Evidence) -> list[Verdict]:
    betas = ["beta 0", "beta 2", "beta 4", "beta 8"]
    returns, q_values = _values(evidence, betas, "score"), _values(evidence, betas, "q_data")
    others = [_values(evidence, [name], "score") for name in ("BC", "SAC without V")]
    bc, sac = (None if other is None else next(iter(other.values())) for other in others)
    gaps = _values(evidence, betas[1:], "gap_td")
    data = evidence.id_of(None)
    units = {} if data is None else {n: evidence.beta_eff(evidence.experiment.variant(n), data) for n in betas[1:]}
    shown = Values(
        {**(returns or {}), **({} if bc is None else {"BC": bc}), **({} if sac is None else {"SAC without V": sac})}
    )
    shown.scope = returns.scope if returns else ""
    best = None if returns is None else max(returns, key=returns.__getitem__)
    waves = _second_halves(evidence, betas, _waviness)
    tests = [
        judge(
            "With beta 0 the agent does badly: below BC",
            f"score of beta 0 below that of BC ({TENTH})",
            None if returns is None or bc is None else returns["beta 0"] < bc,
            _text(shown),
        ),
        judge(
            "With beta 0 it is better than SAC without V",
            f"score of beta 0 above that of SAC without V ({TENTH})",
            None if returns is None or sac is None else returns["beta 0"] > sac,
            _text(shown),
        ),
        judge(
            "Beta 8 is too much, the best lies between",
            f"the best score is at beta 2 or 4, and beta 8 is below it ({TENTH})",
            None if best is None else best in ("beta 2", "beta 4"),
            _text(returns),
        ),
        judge("In-data Q falls as beta rises", f"Q of beta 0 > 2 > 4 > 8 ({TENTH})", _falling(q_values), _text(q_values)),
        judge(
            "In-data Q of beta 2 has a large wave",
            "the curve's second half deviates from a straight line by the largest standard deviation of all betas",
            None if len(waves) < len(betas) else max(waves, key=waves.__getitem__) == "beta 2",
            _text(waves, 2),
        ),
        judge(
            "Q on the data equals r + gamma V - beta_eff (gap_td near zero)",
            f"abs(gap_td) < 0.2 beta_eff for beta 2, 4, 8 ({TENTH})",
            None if gaps is None else all(abs(gaps[name]) < 0.2 * units[name] for name in gaps),
            _text(gaps, 3),
        ),
    ]
    return [*tests, *_shift(evidence)]


def _scoped(evidence: Evidence, names: list[str] | None = None) -> Values:
    """No numbers yet, of the grid's first data."""
    values, dataset_id = Values(), evidence.id_of(None)
    if dataset_id is not None:
        variants = evidence.experiment.variants
        values.scope = evidence.scope(dataset_id, [v for v in variants if names is None or v.name in names])
    return values


def _shift(evidence: Evidence) -> list[Verdict]:
    """Measured lowering of Q and V against theory."""
    dataset_id, experiment = evidence.id_of(None), evidence.experiment
    found = []
    for of, letter in (("q_data", "Q"), ("value", "V")):
        ratios = _scoped(evidence)
        for name in ("beta 2", "beta 4", "beta 8"):
            if dataset_id is None:
                continue
            lowered, theory = evidence.shift(experiment.variant(name), experiment.variant("beta 0"), dataset_id, of)
            late = lowered.index > 0.9 * (evidence.n_updates(dataset_id) or 0)
            if lowered.empty or not late.any():
                continue
            ratios[name] = float(lowered[late].mean().mean() / theory[late].mean())
        found.append(
            judge(
                f"{letter} on the data is lowered by (1 - gamma^(n+1)) / (1 - gamma) beta, in proportion to beta",
                f"measured shift against that of beta 0, divided by theory's with beta_eff, is in [0.8, 1.2] ({TENTH})",
                None if len(ratios) < 3 else all(0.8 <= ratio <= 1.2 for ratio in ratios.values()),
                _text(ratios, 2),
            )
        )
    return found


def _bounds(evidence: Evidence) -> list[Verdict]:
    dataset_id, experiment = evidence.id_of(None), evidence.experiment
    shares = _scoped(evidence)
    for name in ("beta 2", "beta 4", "beta 8"):
        if dataset_id is None:
            continue
        variant = experiment.variant(name)
        lowered, _ = evidence.shift(variant, experiment.variant("beta 0"), dataset_id)
        if not lowered.empty:
            shares[name] = float(lowered.mean(axis=1).max() / (100.0 * evidence.beta_eff(variant, dataset_id)))
    bound = judge(
        "The penalty lowers Q by at most the bound of Eq. 14",
        "largest measured shift, with the density ratio 1 and n infinite, divided by beta_eff / (1 - gamma), is at most 1.05",
        None if len(shares) < 3 else max(shares.values()) <= 1.05,
        _text(shares, 2),
    )
    return [bound, *_shift(evidence)]


def _ood(evidence: Evidence) -> list[Verdict]:
    dataset_id, probe = evidence.id_of(None), evidence.experiment.variant("probe")
    found = []
    for metric, text, betas in (
        ("probe_policy", "Q of the policy's actions, less that of beta 0, is lower with a larger beta", PROBE_BETAS),
        ("probe_max", "max OOD Q - in-data Q is lower with a larger beta", (0, *PROBE_BETAS)),
        ("probe_min", "min OOD Q - in-data Q is lower with a larger beta", (0, *PROBE_BETAS)),
    ):
        values: Values | None = _scoped(evidence, ["probe"])
        for beta in betas:
            value = None
            if dataset_id is not None:
                value = evidence.tail_mean(probe_difference(evidence, probe, dataset_id, metric, beta), dataset_id)
            if value is None or values is None:
                values = None
                continue
            values[f"beta {beta}"] = value
        found.append(judge(text, f"ordered by beta ({TENTH})", _falling(values), _text(values)))
    return found


def _alpha(evidence: Evidence) -> list[Verdict]:
    betas = [f"beta {b}" for b in (0, 1, 2, 4, 8)]
    first = evidence.experiment.datasets[0].paper
    values = _values(evidence, betas, "ent_coef", first)
    found = [
        judge(
            "The learned alpha rises with beta, within a range",
            f"alpha of beta 4 above that of beta 1, and beta 1 < 2 < 4 ({TENTH})",
            None if values is None else values["beta 1"] < values["beta 2"] < values["beta 4"],
            _text(values, 4),
        )
    ]
    for panel in evidence.experiment.panels:
        if panel.over:
            alphas = {}
            for paper in panel.over:
                name = evidence.id_of(paper)
                value = None if name is None else evidence.tail(evidence.experiment.variant("beta 4"), name, "ent_coef")
                if name is not None and value is not None:
                    alphas[name] = value
            spread = None if len(alphas) < 2 else max(alphas.values()) / min(alphas.values()) > 2.0
            claim = f"Alpha differs between data sets ({(panel.title or '').partition(',')[0]})"
            found.append(judge(claim, f"largest / smallest above 2 ({TENTH})", spread, _text(alphas, 4)))
    return found


def _tau(evidence: Evidence) -> list[Verdict]:
    names = [v.name for v in evidence.experiment.variants]
    found = []
    for dataset, little in (("halfcheetah-medium-v2", True), ("relocate-cloned-v0", False), ("kitchen-mixed-v0", False)):
        values = _values(evidence, names, "score", dataset)
        spread = None if values is None else max(values.values()) - min(values.values())
        word = "makes little difference" if little else "matters"
        rule = f"largest - smallest score {'below' if little else 'at least'} 10 ({TENTH})"
        holds = None if spread is None else (spread < 10.0) == little
        found.append(_on_this_kind(f"The expectile {word} on {dataset}'s kind of data", rule, holds, values))
    return found


def _on_this_kind(claim: str, rule: str, holds: bool | None, values: Values | None) -> Verdict:
    """What is claimed of a kind of data is not tested on another."""
    if values is None or not values.other_kind:
        return judge(claim, rule, holds, _text(values))
    return judge(claim, rule, None, f"{values.other_kind}: {_text(values)}")


def _cql_q(evidence: Evidence) -> list[Verdict]:
    levels = _values(evidence, ["expectile 0.5", "expectile 0.7", "expectile 0.9"], "q_data")
    rule = f"in-data Q of expectile 0.5 < 0.7 < 0.9 ({TENTH})"
    found = [judge("A higher expectile gives a higher Q (a slacker estimate)", rule, _rising(levels), _text(levels))]
    slopes = _second_halves(evidence, ["expectile 0.7", "without policy"], lambda curve: float(np.std(curve, ddof=1)))
    holds = None if len(slopes) < 2 else slopes["without policy"] < slopes["expectile 0.7"]
    rule = "standard deviation of the curve over its second half is smaller"
    return [*found, judge("Without a policy in the penalty Q is flatter", rule, holds, _text(slopes, 2))]


def _cql_return(evidence: Evidence) -> list[Verdict]:
    found = []
    for dataset, better in (("halfcheetah-medium-v2", "Eq. 18"), ("relocate-cloned-v0", "DCE"), ("kitchen-mixed-v0", "DCE")):
        values = _values(evidence, ["DCE", "Eq. 18"], "score", dataset)
        other = "DCE" if better == "Eq. 18" else "Eq. 18"
        holds = None if values is None else values[better] > values[other]
        claim = f"{better} is better on {dataset}'s kind of data"
        found.append(_on_this_kind(claim, f"higher score ({TENTH})", holds, values))
    return found


def _sac(evidence: Evidence) -> list[Verdict]:
    found = []
    for alpha in ("alpha 1", "alpha auto"):
        names = [f"SAC, {alpha}", f"SAC with V, {alpha}"]
        q_values, scores = (_values(evidence, names, metric) for metric in ("q_data", "score"))
        bc = _values(evidence, ["BC"], "score")
        lower = None
        if q_values is not None and q_values[names[0]] > 0:
            lower = q_values[names[1]] < 0.5 * q_values[names[0]]
        elif _all_diverged(evidence, names[0]):
            lower = not _all_diverged(evidence, names[1])
        better = None if scores is None else scores[names[1]] > scores[names[0]]
        below = None if scores is None or bc is None else scores[names[1]] < bc["BC"]
        rule = f"Q of SAC with V below half of that of SAC, or SAC diverges and this does not ({TENTH})"
        found += [
            judge(f"V alone makes Q far lower (paper: 4000 and 400), {alpha}", rule, lower, _text(q_values)),
            judge(f"SAC with V returns more than SAC, {alpha}", f"higher score ({TENTH})", better, _text(scores)),
            judge(
                f"V alone is not enough, {alpha}",
                f"score of SAC with V below that of BC ({TENTH})",
                below,
                _merged(scores, bc),
            ),
        ]
    return found


def _merged(*parts: Values | None) -> str:
    return ", ".join(text for part in parts if (text := _text(part)))


# Below this score a policy does not do its task, so that half of it says nothing.
WORKING = 5.0


def _alpha_return(evidence: Evidence) -> list[Verdict]:
    def of(*names: str) -> Values | None:
        return _values(evidence, list(names), "score")

    dce = of("DCE, alpha 1", "DCE, alpha 3")
    eq18 = of("Eq. 18, alpha 1", "Eq. 18, alpha 3")
    both = of("DCE, alpha 3", "Eq. 18, alpha 3")
    lower = None
    if dce is not None and eq18 is not None:
        lower = dce["DCE, alpha 3"] < dce["DCE, alpha 1"] and eq18["Eq. 18, alpha 3"] < eq18["Eq. 18, alpha 1"]
    works, fails = of("DCE, alpha 1", "DCE, alpha 5"), of("Eq. 18, alpha 1", "Eq. 18, alpha 5")
    outcome: bool | None = None
    if works is not None and works["DCE, alpha 1"] > WORKING:
        dce_works = works["DCE, alpha 5"] >= max(WORKING, 0.5 * works["DCE, alpha 1"])
        if _all_diverged(evidence, "Eq. 18, alpha 5"):
            outcome = dce_works
        elif fails is not None and fails["Eq. 18, alpha 1"] > WORKING:
            outcome = dce_works and fails["Eq. 18, alpha 5"] < 0.5 * fails["Eq. 18, alpha 1"]
    rule = f"score of Eq. 18 below half of its score at alpha 1, or it diverges; that of DCE not, nor below {WORKING:g}"
    return [
        judge("At alpha 3 both are below alpha 1", f"scores ({TENTH})", lower, _merged(dce, eq18)),
        judge(
            "At alpha 3 DCE is above Eq. 18",
            f"scores ({TENTH})",
            None if both is None else both["DCE, alpha 3"] > both["Eq. 18, alpha 3"],
            _text(both),
        ),
        judge("At alpha 5 Eq. 18 fails and DCE works", f"{rule} ({TENTH})", outcome, _merged(works, fails)),
    ]


# "<<" of the order of run times.
FAR_SLOWER = 3.0


def _table(evidence: Evidence) -> list[Verdict]:
    ids = [name for _, name in evidence.table_rows()]
    times = {name: fastest_run(evidence, evidence.experiment.variant(name), ids) for name in RUN_TIME_ORDER}
    known = {name: time for name, time in times.items() if time is not None}
    claim = "Run times are in the order BC < IQL < DCE < CQL << UWAC"
    rule = (
        f"least seconds per 1000 updates, evaluations included, of runs with others beside them; << is {FAR_SLOWER:g} times. "
        "Rounded products and fewer dropout passes only make an agent faster"
    )
    seconds = [time.seconds for time in known.values()]
    holds: bool | None = None
    if len(known) == len(RUN_TIME_ORDER):
        ordered = bool(np.all(np.diff(seconds) > 0)) and seconds[-1] > FAR_SLOWER * seconds[-2]
        holds = ordered if ordered or not any(time.hastened for time in known.values()) else None
    return [judge(claim, rule, holds, ", ".join(f"{name} {time.text}" for name, time in known.items())), *_leading(evidence)]


RUN_TIME_ORDER = ("BC", "IQL", "DCE", "CQL", "UWAC")


def _leading(evidence: Evidence) -> list[Verdict]:
    """The paper's statements on where DCE is first, on our rows."""
    kinds: dict[str, tuple[str, tuple[str, ...]]] = {
        "C4: DCE is best on every HalfCheetah set": ("halfcheetah", ("random", "medium", "medium-replay", "medium-expert")),
        "C5: DCE is better on random, medium and medium-replay sets": ("", ("random", "medium", "medium-replay")),
        "C6: DCE has no significant advantage on medium-expert sets": ("", ("medium-expert",)),
    }
    agents = [v for v in evidence.experiment.variants if v.paper is not None]
    dce = evidence.experiment.variant("DCE")
    found = []
    for claim, (task, endings) in kinds.items():
        wanted = [d for d in evidence.experiment.datasets if _is_of_kind(d.paper, task, endings)]
        by_source: dict[str, list[str]] = {"D4RL": [], "sb3": []}
        for dataset, name in evidence.table_rows():
            if dataset in wanted and len(evidence.last(dce, name)):
                by_source[source_of(name)].append(name)
        # the paper's own data if they are all there; never some of these and some of ours
        ids = by_source["D4RL"] if len(by_source["D4RL"]) >= len(by_source["sb3"]) else by_source["sb3"]
        scores = {name: {v.name: evidence.last(v, name) for v in agents} for name in ids}
        places = {
            name: 1 + sum(bool(len(s)) and s.mean() > of["DCE"].mean() for s in of.values()) for name, of in scores.items()
        }
        complete = all(len(s) for of in scores.values() for s in of.values())
        one_length = len({evidence.n_updates(name) for name in ids}) == 1
        tested = bool(wanted) and len(ids) == len(wanted) and complete and one_length
        if claim.startswith("C6"):
            tested = tested and all(len(s) > 1 for of in scores.values() for s in of.values())
            holds = tested and not any(_leads_by_more_than_chance(of) for of in scores.values())
            rule = "nowhere the 95 % interval over seeds of DCE's mean lies above that of every other agent"
        else:
            holds = all(place == 1 for place in places.values())
            rule = "DCE's mean is the highest of all the paper's agents on every such set, at one length"
        absent = sorted({name for of in scores.values() for name, s in of.items() if not len(s)})
        numbers = ", ".join(f"{name}: {place} ({evidence.scope(name, agents)})" for name, place in places.items())
        numbers = f"place of DCE: {numbers or '-'}" + (f"; without {', '.join(absent)}" if absent else "")
        found.append(judge(claim, rule, holds if tested else None, numbers))
    return found


def _leads_by_more_than_chance(scores: dict[str, np.ndarray]) -> bool:
    own = bootstrap_interval([scores["DCE"]])
    others = [bootstrap_interval([s]) for name, s in scores.items() if name != "DCE"]
    return all(own.low > other.high for other in others)


def _is_of_kind(paper: str, task: str, endings: tuple[str, ...]) -> bool:
    return paper.startswith(task) and paper.removesuffix("-v2").partition("-")[2] in endings


def _adroit(evidence: Evidence) -> list[Verdict]:
    experiment = evidence.experiment
    with_, without = experiment.variant("DCE"), experiment.variant("DCE without dropout")
    pairs, spreads = {}, {}
    for dataset, name in evidence.table_rows():
        scores = [evidence.last(v, name) for v in (with_, without)]
        human = dataset.paper in (without.datasets or ()) and not (dataset.other_kind and name == dataset.twin)
        if human and all(map(len, scores)):
            pairs[name] = (float(scores[0].mean()), float(scores[1].mean()))
        if len(scores[0]) > 1 and not isinstance(row_of(with_.algo, name)["ent_coef"], str):
            spreads[name] = sample_std(scores[0])
    numbers = ", ".join(
        f"{name}: {a:.1f} with, {b:.1f} without ({evidence.scope(name, [with_, without])})" for name, (a, b) in pairs.items()
    )
    holds = None if not pairs else all(a >= b for a, b in pairs.values()) and any(a > b for a, b in pairs.values())
    rule = "mean score with dropout 0.1 is higher, or both are equal, on every set of people's demonstrations that was run"
    found = [judge("Dropout of the critics helps on human demonstrations", rule, holds, numbers)]
    sources = {source_of(name) for name in spreads}
    spreads = {name: value for name, value in spreads.items() if source_of(name) == min(sources)}  # "D4RL" before "sb3"
    wide = None if not spreads else max(spreads.values()) > 15.0
    rule = "largest standard deviation over seeds above 15 (paper: 37 on pen-human), of the sets with a constant alpha"
    return [*found, judge("C9: a constant alpha gives high variance over seeds", rule, wide, _text(spreads))]


_TESTS: dict[str, tuple[Callable[[Evidence], list[Verdict]], ...]] = {
    "table1": (_table,),
    "table-adroit-kitchen": (_adroit,),
    "fig-tau": (_tau,),
    "fig-beta": (_beta,),
    "fig-ood": (_ood,),
    "fig-alpha": (_alpha,),
    "fig-cql-q": (_cql_q,),
    "fig-cql-return": (_cql_return,),
    "fig-sac": (_sac,),
    "fig-alpha-return": (_alpha_return,),
    "bounds": (_bounds,),
}
