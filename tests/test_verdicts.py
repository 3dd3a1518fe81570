"""Rules of the verdicts: on numbers that bear a claim out, and on numbers that break it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from result_rows import run_rows, table_rows

from sb3_dce.experiments import results
from sb3_dce.experiments.claims import claim_table
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.grid import load_experiment
from sb3_dce.experiments.judging import CLOSE, HELD, NOT_HELD, UNTESTED, uncertainty, values_of
from sb3_dce.experiments.reports import reproduction
from sb3_dce.experiments.verdicts import verdicts
from sb3_dce.theory import shift_factor

CHEETAH = "halfcheetah-medium-sb3"


def outcomes(name: str, rows: pd.DataFrame) -> dict[str, str]:
    experiment = load_experiment(name)
    return {v.claim: v.outcome for v in verdicts(Evidence(experiment, rows, experiment.scales["cpu"]))}


def one_of(found: dict[str, str], part: str) -> str:
    (outcome,) = [outcome for claim, outcome in found.items() if part in claim]
    return outcome


def scored(name: str, by_data: dict[str, dict[str, float]], metric: str = "score", n_updates: int = 100_000) -> pd.DataFrame:
    experiment = load_experiment(name)
    return results.merge(
        run_rows(experiment, variant, data, 0, curves={metric: [value] * 10}, n_updates=n_updates)
        for data, values in by_data.items()
        for variant, value in values.items()
    )


@pytest.mark.parametrize(
    ("name", "metric", "values", "claim"),
    [
        (
            "fig-alpha-return",
            "score",
            {"DCE, alpha 1": 50, "DCE, alpha 3": 40, "Eq. 18, alpha 1": 50, "Eq. 18, alpha 3": 68},
            "At alpha 3 both are below",
        ),
        (
            "fig-alpha-return",
            "score",
            {"DCE, alpha 3": 30, "Eq. 18, alpha 3": 48},
            "At alpha 3 DCE is above",
        ),
        ("fig-cql-return", "score", {"DCE": 58, "Eq. 18": 40}, "Eq. 18 is better on halfcheetah"),
        ("fig-cql-q", "q_data", {"expectile 0.5": 3, "expectile 0.7": 2, "expectile 0.9": 1}, "higher expectile"),
        ("fig-sac", "score", {"SAC, alpha auto": 25, "SAC with V, alpha auto": 4}, "SAC with V returns more than SAC"),
        ("fig-sac", "score", {"SAC with V, alpha auto": 60, "BC": 40}, "V alone is not enough"),
        ("fig-beta", "score", {"beta 0": 60, "BC": 40}, "With beta 0 the agent does badly"),
        ("fig-beta", "score", {"beta 0": 10, "SAC without V": 40}, "better than SAC without V"),
        ("fig-sac", "q_data", {"SAC, alpha 1": 100, "SAC with V, alpha 1": 60}, "far lower (paper: 4000 and 400), alpha 1"),
        ("fig-alpha", "ent_coef", {f"beta {b}": 1 - b / 10 for b in (0, 1, 2, 4, 8)}, f"(paper: within a range) on {CHEETAH}"),
        (
            "fig-tau",
            "score",
            {f"expectile 0.{n}": 2 * n for n in (5, 6, 7, 8, 9)} | {"expectile 0.5": 60},
            "little difference on half",
        ),
    ],
)
def test_claims_fail_on_numbers_that_break_them(name: str, metric: str, values: dict[str, float], claim: str) -> None:
    assert one_of(outcomes(name, scored(name, {CHEETAH: values}, metric)), claim) == NOT_HELD


@pytest.mark.parametrize(
    ("name", "values", "claim"),
    [
        ("fig-cql-return", {"DCE": 56, "Eq. 18": 40}, "Eq. 18 is better on halfcheetah"),
        ("fig-cql-return", {"DCE": 40, "Eq. 18": 45}, "Eq. 18 is better on halfcheetah"),
        ("fig-sac", {"SAC, alpha auto": 15, "SAC with V, alpha auto": 14}, "SAC with V returns more than SAC"),
        ("fig-beta", {"beta 0": 5, "SAC without V": 9}, "better than SAC without V"),
        ("fig-beta", {"beta 0": 20, "SAC without V": 4}, "better than SAC without V"),
        ("fig-beta", {"beta 0": 0, "beta 2": 40, "beta 4": 44, "beta 8": 45}, "Beta 8 is too much"),
        (
            "fig-alpha-return",
            {"DCE, alpha 1": 50, "DCE, alpha 3": 48, "Eq. 18, alpha 1": 50, "Eq. 18, alpha 3": 5},
            "At alpha 3 both are below",
        ),
        ("fig-tau", {f"expectile 0.{n}": 3 * (n - 5) for n in (5, 6, 7, 8, 9)}, "little difference on half"),
        ("fig-tau", {f"expectile 0.{n}": n for n in (5, 6, 7, 8, 9)}, "little difference on half"),
    ],
)
def test_what_seeds_alone_could_do_is_too_close_to_tell(name: str, values: dict[str, float], claim: str) -> None:
    assert one_of(outcomes(name, scored(name, {CHEETAH: values})), claim) == CLOSE


def test_little_difference_needs_more_than_one_seed() -> None:
    experiment = load_experiment("fig-tau")
    runs = [
        run_rows(experiment, f"expectile 0.{n}", CHEETAH, seed, curves={"score": [40.0 + n / 2 + seed] * 10})
        for n in (5, 6, 7, 8, 9)
        for seed in range(3)
    ]
    assert one_of(outcomes("fig-tau", results.merge(runs)), "little difference on half") == HELD


@pytest.mark.parametrize(
    ("name", "values", "claim"),
    [
        ("fig-sac", {"SAC, alpha auto": -2, "SAC with V, alpha auto": 4}, "SAC with V returns more than SAC"),
        ("fig-cql-return", {"DCE": 4, "Eq. 18": -30}, "Eq. 18 is better on halfcheetah"),
        ("fig-beta", {"beta 0": 3, "SAC without V": -30}, "better than SAC without V"),
    ],
)
def test_two_agents_that_fail_are_not_compared(name: str, values: dict[str, float], claim: str) -> None:
    assert one_of(outcomes(name, scored(name, {CHEETAH: values})), claim) == UNTESTED


@pytest.mark.parametrize(
    ("alphas", "outcome"),
    [
        ((0.50, 0.52, 0.54, 0.56, 0.58), CLOSE),
        ((0.50, 0.55, 0.60, 0.65, 0.70), HELD),  # no step of it is more than seeds can do, the whole is
        ((0.5, 0.6, 0.4, 0.9, 1.0), NOT_HELD),
    ],
)
def test_alpha_rises_by_more_than_seeds_can_do(alphas: tuple[float, ...], outcome: str) -> None:
    replay = "halfcheetah-medium-replay-sb3"
    values = {f"beta {b}": alpha for b, alpha in zip((0, 1, 2, 4, 8), alphas, strict=True)}
    both = {CHEETAH: values, replay: {"beta 1": 0.3, "beta 4": 0.1}}
    found = outcomes("fig-alpha", scored("fig-alpha", both, "ent_coef"))
    assert one_of(found, f"rises with beta (paper: within a range) on {CHEETAH}") == outcome
    assert one_of(found, f"rises with beta (paper: within a range) on {replay}") == NOT_HELD, "each set is a matter of its own"


def test_set_without_all_betas_is_not_tested_but_refutes() -> None:
    for values, outcome in (((0.3, 0.9), UNTESTED), ((0.5, 0.5), UNTESTED), ((0.9, 0.3), NOT_HELD)):
        two = {CHEETAH: dict(zip(("beta 1", "beta 4"), values, strict=True))}
        found = outcomes("fig-alpha", scored("fig-alpha", two, "ent_coef"))
        assert one_of(found, f"(paper: within a range) on {CHEETAH}") == outcome


def test_seeds_that_agree_tell_a_smaller_difference() -> None:
    experiment = load_experiment("fig-cql-return")

    def judged(shift: float) -> str:
        runs = [
            run_rows(experiment, name, CHEETAH, seed, curves={"score": [score + seed / 10] * 10}, n_updates=1000)
            for name, score in (("DCE", 40.0), ("Eq. 18", 40.0 + shift))
            for seed in range(3)
        ]
        return one_of(outcomes("fig-cql-return", results.merge(runs)), "Eq. 18 is better on halfcheetah")

    assert [judged(shift) for shift in (2.0, 0.05, -2.0)] == [HELD, CLOSE, NOT_HELD]


@pytest.mark.parametrize(
    ("name", "metric", "values", "claim"),
    [
        ("fig-alpha-return", "score", {"DCE, alpha 3": 50, "Eq. 18, alpha 3": 30}, "At alpha 3 DCE is above"),
        ("fig-cql-return", "score", {"DCE": 40, "Eq. 18": 58}, "Eq. 18 is better on halfcheetah"),
        ("fig-cql-q", "q_data", {"expectile 0.5": 1, "expectile 0.7": 2, "expectile 0.9": 3}, "higher expectile"),
        ("fig-sac", "score", {"SAC, alpha auto": 5, "SAC with V, alpha auto": 26}, "SAC with V returns more than SAC"),
        ("fig-sac", "score", {"SAC with V, alpha auto": 15, "BC": 40}, "V alone is not enough"),
        ("fig-beta", "score", {"beta 0": 10, "BC": 40}, "With beta 0 the agent does badly"),
        ("fig-beta", "score", {"beta 0": 60, "SAC without V": 40}, "better than SAC without V"),
        ("fig-sac", "q_data", {"SAC, alpha 1": 100, "SAC with V, alpha 1": 40}, "far lower (paper: 4000 and 400), alpha 1"),
        (
            "fig-alpha",
            "ent_coef",
            {f"beta {b}": (b + 1) / 10 for b in (0, 1, 2, 4, 8)},
            f"(paper: within a range) on {CHEETAH}",
        ),
    ],
)
def test_claims_hold_on_numbers_that_bear_them_out(name: str, metric: str, values: dict[str, float], claim: str) -> None:
    assert one_of(outcomes(name, scored(name, {CHEETAH: values}, metric)), claim) == HELD


@pytest.mark.parametrize(("sign", "outcome"), [(-1.0, HELD), (1.0, NOT_HELD)])
def test_values_outside_of_the_data_are_ordered_by_beta(sign: float, outcome: str) -> None:
    experiment = load_experiment("fig-ood")
    curves = {f"probe{b}_{kind}": [sign * b] * 10 for b in (0, 1, 2, 4, 8) for kind in ("policy", "max", "min")}
    curves |= {f"probe{b}_data": [0.0] * 10 for b in (0, 1, 2, 4, 8)}
    found = outcomes("fig-ood", run_rows(experiment, "probe", CHEETAH, 0, curves=curves))
    assert one_of(found, "C1: the ranking") == UNTESTED, "its curves are missing here"
    others = [found[claim] for claim in found if not claim.startswith("C1")]
    assert others == [outcome] * 3


@pytest.mark.parametrize(
    ("ranks", "outcome"),
    [((0.5, 0.5, 0.5, 0.48, 0.41), HELD), ((0.5, 0.5, 0.5, 0.48, 0.39), NOT_HELD), ((0.9, 0.75, 0.9, 0.9, 0.9), NOT_HELD)],
)
def test_order_of_the_data_is_measured_against_that_of_two_critics_of_beta_0(ranks: Any, outcome: str) -> None:
    curves = {f"probe{b}_rank": [0.0] * 9 + [rank] for b, rank in zip((0, 1, 2, 4, 8), ranks, strict=True)}
    experiment = load_experiment("fig-ood")
    new, old = (run_rows(experiment, "probe", CHEETAH, seed, 1.0, curves if seed else {}) for seed in (1, 0))
    assert one_of(outcomes("fig-ood", new), "C1: the ranking") == outcome
    evidence = Evidence(experiment, results.merge([new, old]), experiment.scales["cpu"])  # the old one did not log it
    (verdict,) = [v for v in verdicts(evidence) if v.claim.startswith("C1")]
    assert verdict.outcome == outcome and verdict.numbers.endswith("1,000 steps, 1 seed)")


@pytest.mark.parametrize(("factors", "outcome"), [((1.0, 1.0, 1.0), HELD), ((0.9, 1.0, 1.3), NOT_HELD)])
def test_bound_and_shift_are_judged_by_the_worst_beta(factors: tuple[float, ...], outcome: str) -> None:
    experiment, steps = load_experiment("bounds"), [10_000 * (i + 1) for i in range(10)]
    parts = []
    for variant, factor in zip(experiment.variants, (1.0, *factors), strict=True):
        unit = variant.set["beta"] / 2
        lowered = [factor * unit * shift_factor(step - 5000, 0.99, 0.005) for step in steps]
        curves = {"q_data": [400.0 - x for x in lowered], "value": [399.0 - (x - factor * unit) / 0.99 for x in lowered]}
        parts.append(run_rows(experiment, variant.name, CHEETAH, 0, curves=curves, n_updates=100_000))
    found = outcomes("bounds", results.merge(parts))
    assert one_of(found, "Q on the data is lowered") == outcome


@pytest.mark.parametrize(
    ("pairs", "outcome"),
    [(((34, 20), (10, 10)), HELD), (((30, 20), (10, 10)), CLOSE), (((30, 20), (5, 25)), NOT_HELD), (((9, 9), (9, 12)), CLOSE)],
)
def test_dropout_has_to_help_somewhere_and_hurt_nowhere(pairs: Any, outcome: str) -> None:
    adroit = load_experiment("table-adroit-kitchen")
    data = ("pen-human-v0", "door-human-v0")
    rows = table_rows(
        adroit,
        {
            d: {name: [value - 4.0, float(value), value + 4.0] for name, value in (("DCE", a), ("DCE without dropout", b))}
            for d, (a, b) in zip(data, pairs, strict=True)
        },
    )
    assert one_of(outcomes("table-adroit-kitchen", rows), "Dropout of the critics") == outcome


def test_two_seeds_on_demonstrations_of_people_tell_nothing_of_dropout() -> None:
    adroit = load_experiment("table-adroit-kitchen")
    rows = table_rows(adroit, {"pen-human-v0": {"DCE": [90.0, 92.0], "DCE without dropout": [20.0, 22.0]}})
    assert one_of(outcomes("table-adroit-kitchen", rows), "Dropout of the critics") == UNTESTED


def test_best_on_every_set_is_not_best_on_one() -> None:
    table = load_experiment("table1")
    agents = {v.name: [40.0, 42.0] for v in table.variants}
    names = [f"halfcheetah-{kind}-sb3" for kind in ("random", "medium", "medium-replay", "medium-expert")]
    scores = {n: {**agents, "DCE": [90.0, 92.0] if n == names[0] else [10.0, 12.0]} for n in names}
    for n_updates, outcome in ((100_000, NOT_HELD), (50_000, UNTESTED)):  # beta changes for the first time after 50,000
        rows = table_rows(table, scores, n_updates=n_updates)
        assert one_of(outcomes("table1", rows), "C4") == outcome


def test_claim_on_seeds() -> None:
    table, hopper = load_experiment("table1"), "hopper-medium-sb3"

    def runs(data: str, spread: float, n_seeds: int) -> list[pd.DataFrame]:
        return [run_rows(table, "DCE", data, seed, 40.0 + seed * spread) for seed in range(n_seeds)]

    def outcome(rows: list[pd.DataFrame]) -> str:
        evidence = Evidence(table, results.merge(rows), table.scales["cpu"])
        return {row[0]: row[2] for row in claim_table({"table1": evidence}, {}).rows}["C7"]

    assert outcome(runs(hopper, 30.0, 5)) == HELD
    assert outcome(runs(hopper, 12.3 / np.std(range(5), ddof=1), 5)) == HELD, "the paper's own spread there"
    assert outcome(runs(hopper, 5.0, 5)) == CLOSE
    assert outcome(runs(hopper, 1.0, 5)) == NOT_HELD
    assert outcome([*runs(CHEETAH, 1.0, 5), *runs(hopper, 30.0, 2)]) == UNTESTED, "two seeds of Hopper"
    assert outcome(runs(hopper, 30.0, 4)) == UNTESTED, "four seeds say little on a deviation"
    assert outcome(runs(CHEETAH, 1.0, 5)) == UNTESTED, "the claim is about Hopper and people's demonstrations"


def test_a_score_within_the_papers_deviation_is_reproduced() -> None:
    table = load_experiment("table1")  # the paper: 75.9 ± 12.3
    full = table.scales["full"]
    rows = table_rows(table, {"hopper-medium-v2": {"DCE": [65.0, 66.0, 65.0, 66.0, 65.0]}}, n_updates=1_000_000, scale=full)
    assert reproduction(Evidence(table, rows, full)).numbers.startswith("1 of 1 rows")


def lost(name: str, variant: str, data: str = CHEETAH) -> pd.DataFrame:
    """A run that diverged before anything was evaluated."""
    row = run_rows(load_experiment(name), variant, data, 0).iloc[:1]
    return row.assign(metric="diverged", step=500, value=1.0)


def test_an_agent_that_diverges_has_failed() -> None:
    sac = lost("fig-beta", "SAC without V")
    works = scored("fig-beta", {CHEETAH: {"beta 0": 40}}, n_updates=1000)
    assert one_of(outcomes("fig-beta", results.merge([works, sac])), "better than SAC without V") == HELD
    both = results.merge([lost("fig-beta", "beta 0"), sac])
    assert one_of(outcomes("fig-beta", both), "better than SAC without V") == UNTESTED
    returns = load_experiment("fig-cql-return")
    some = [run_rows(returns, "DCE", CHEETAH, seed, curves={"score": [90.0] * 10}) for seed in range(2)]
    some += [lost("fig-cql-return", "DCE").assign(seed=2)]
    some += [run_rows(returns, "Eq. 18", CHEETAH, seed, curves={"score": [20.0 + seed] * 10}) for seed in range(3)]
    found = outcomes("fig-cql-return", results.merge(some))
    assert one_of(found, "Eq. 18 is better on halfcheetah") == HELD, "its other seeds do not make up for the one it lost"
    table, names = load_experiment("table1"), [f"halfcheetah-{k}-sb3" for k in ("random", "medium", "medium-replay")]
    agents = {v.name: [40.0] for v in table.variants}
    parts = [table_rows(table, {name: {**agents, "DCE": [90.0]} for name in names}, n_updates=100_000)]
    parts += [lost("table1", v, "halfcheetah-medium-expert-sb3").assign(n_updates=100_000) for v in ("DCE", "BC")]
    assert one_of(outcomes("table1", results.merge(parts)), "C4") == NOT_HELD


def test_nothing_is_said_where_all_diverged() -> None:
    names = [v.name for v in load_experiment("fig-tau").variants]
    found = outcomes("fig-tau", results.merge(lost("fig-tau", name) for name in names))
    assert one_of(found, "little difference on half") == UNTESTED


def test_q_of_sac_that_diverged_is_compared_with_runs_that_are_there() -> None:
    sac = lost("fig-sac", "SAC, alpha 1")
    assert one_of(outcomes("fig-sac", sac), "far lower (paper: 4000 and 400), alpha 1") == UNTESTED
    with_v = scored("fig-sac", {CHEETAH: {"SAC with V, alpha 1": 60}}, "q_data", n_updates=1000)
    assert one_of(outcomes("fig-sac", results.merge([sac, with_v])), "far lower (paper: 4000 and 400), alpha 1") == HELD


@pytest.mark.parametrize(
    ("sac", "with_v", "outcome"),
    [
        ((400.0, 3.0), (390.0, 0.0), UNTESTED),  # SAC's may go on to more than twice
        ((400.0, 0.1), (390.0, 0.0), NOT_HELD),
        ((3000.0, 50.0), (400.0, 0.0), HELD),  # there what rises only makes it clearer
        ((4000.0, 0.0), (1000.0, 30.0), UNTESTED),
    ],
)
def test_q_whose_rise_could_turn_the_outcome_is_not_judged(
    sac: tuple[float, float], with_v: tuple[float, float], outcome: str
) -> None:
    experiment = load_experiment("fig-sac")
    courses = {"SAC, alpha auto": sac, "SAC with V, alpha auto": with_v}
    curves = {name: [start + slope * i for i in range(20)] for name, (start, slope) in courses.items()}
    runs = [run_rows(experiment, n, CHEETAH, 0, curves={"q_data": q}, n_updates=200_000) for n, q in curves.items()]
    assert one_of(outcomes("fig-sac", results.merge(runs)), "(paper: 4000 and 400), alpha auto") == outcome


@pytest.mark.parametrize(("n_updates", "outcome"), [(99_000, UNTESTED), (100_000, NOT_HELD)])
def test_level_of_q_is_judged_when_it_is_reached(n_updates: int, outcome: str) -> None:
    values = {CHEETAH: {"SAC, alpha auto": 457.0, "SAC with V, alpha auto": 445.0}}
    found = outcomes("fig-sac", scored("fig-sac", values, "q_data", n_updates))
    assert one_of(found, "far lower (paper: 4000 and 400), alpha auto") == outcome


def test_a_claim_is_about_runs_as_long_as_those_of_its_own_agents() -> None:
    betas = (0, 2, 4, 8)
    long = scored("fig-beta", {CHEETAH: {f"beta {b}": 10.0 - b for b in betas}}, "q_data", n_updates=200_000)
    experiment = load_experiment("fig-beta")
    values = {v.name: 50.0 for v in experiment.variants} | {f"beta {b}": 10.0 + b for b in betas}
    short = [
        run_rows(experiment, name, CHEETAH, 0, curves={"q_data": [value] * 10, "score": [value] * 10}, n_updates=50_000)
        for name, value in values.items()
    ]
    found = outcomes("fig-beta", results.merge([long, *short]))
    assert one_of(found, "In-data Q falls") == HELD, "the longer runs count, though most agents have shorter ones"
    assert one_of(found, "below BC") == HELD, "and BC is compared at the length it has"


def test_all_numbers_of_a_claim_are_of_one_length() -> None:
    agents = {f"{agent}, alpha {alpha}": 50.0 for agent in ("DCE", "Eq. 18") for alpha in (1, 5)} | {"Eq. 18, alpha 5": 2.0}
    short = scored("fig-alpha-return", {CHEETAH: agents}, n_updates=50_000)
    long = scored("fig-alpha-return", {CHEETAH: {"DCE, alpha 1": 80.0, "DCE, alpha 5": 10.0}}, n_updates=200_000)
    claim = "At alpha 5 Eq. 18 fails and DCE works"
    assert one_of(outcomes("fig-alpha-return", results.merge([short, long])), claim) == HELD, "Eq. 18 has no long runs"


def test_alpha_of_several_data_sets_is_compared_at_one_length() -> None:
    names = [f"{d}-sb3" for d in ("halfcheetah-medium", "hopper-medium", "walker2d-medium", "halfcheetah-medium-replay")]
    short = scored("fig-alpha", {name: {"beta 4": 0.5} for name in names}, "ent_coef", n_updates=50_000)
    long = scored("fig-alpha", {CHEETAH: {"beta 4": 5.0}}, "ent_coef", n_updates=200_000)
    found = outcomes("fig-alpha", results.merge([short, long]))
    assert one_of(found, "between data sets (MuJoCo)") == NOT_HELD


def test_runs_of_the_papers_length_are_compared_with_it_though_others_are_shorter() -> None:
    table = load_experiment("table1")
    full = table.scales["full"]
    hopper = {"hopper-medium-v2": {"DCE": [70.0, 75.0, 80.0, 76.0, 78.0]}}
    long = table_rows(table, hopper, n_updates=1_000_000, scale=full)
    short = table_rows(table, {"hopper-medium-v2": {"BC": [40.0], "IQL": [40.0]}}, n_updates=50_000, scale=full)
    assert reproduction(Evidence(table, results.merge([long, short]), full)).numbers.startswith("1 of 1 rows")


@pytest.mark.parametrize(
    ("largest", "others", "outcome"),
    [(8.0, 4.0, HELD), (4.4, 4.0, CLOSE), (2.5, 4.0, NOT_HELD), (0.01, 0.0, NOT_HELD)],
)
def test_large_wave_can_be_seen_and_is_the_largest(largest: float, others: float, outcome: str) -> None:
    experiment = load_experiment("fig-beta")
    sizes = {"beta 0": others, "beta 2": largest, "beta 4": others, "beta 8": others}
    waves = {name: [100.0 + size * (-1) ** i for i in range(40)] for name, size in sizes.items()}
    rows = [run_rows(experiment, n, CHEETAH, 0, curves={"q_data": q}, n_updates=200_000) for n, q in waves.items()]
    assert one_of(outcomes("fig-beta", results.merge(rows)), "large wave") == outcome


def test_wave_of_a_run_that_diverged_is_not_judged() -> None:
    experiment = load_experiment("fig-beta")
    curve = [float(i % 3) for i in range(20)]
    runs = [run_rows(experiment, f"beta {b}", CHEETAH, 0, curves={"q_data": curve}, n_updates=200_000) for b in (0, 2, 4, 8)]
    assert one_of(outcomes("fig-beta", results.merge(runs)), "large wave") != UNTESTED
    broken = runs[1][runs[1]["step"] <= 150_000]
    assert one_of(outcomes("fig-beta", results.merge([runs[0], broken, *runs[2:]])), "large wave") == UNTESTED


def test_seed_that_diverges_makes_no_wave() -> None:
    experiment = load_experiment("fig-beta")
    curve = [400.0 + i for i in range(20)]
    runs = [run_rows(experiment, f"beta {b}", CHEETAH, 0, curves={"q_data": curve}, n_updates=200_000) for b in (0, 2, 4, 8)]
    high = run_rows(experiment, "beta 2", CHEETAH, 1, curves={"q_data": [900.0] * 20}, n_updates=200_000)
    rows = results.merge([*runs, high[high["step"] <= 150_000]])
    assert one_of(outcomes("fig-beta", rows), "large wave") == NOT_HELD


def test_parts_of_an_experiment_are_of_one_file() -> None:
    experiment = load_experiment("fig-beta")
    new, old = "cd" * 32, "ab" * 32
    runs = [
        run_rows(experiment, f"beta {b}", CHEETAH, s, curves={"q_data": [1.0] * 4}, sha=new) for b in (0, 2) for s in (0, 1)
    ]
    runs += [run_rows(experiment, "beta 8, c 0.5", CHEETAH, 0, curves={"q_data": [1.0] * 4}, sha=old)]
    evidence = Evidence(experiment, results.merge(runs), experiment.scales["cpu"])
    assert evidence.among(["beta 8, c 0.5"]).id_of(None) is None and evidence.id_of(None) == CHEETAH
    assert evidence.left_out == 1


def test_borrowed_deviation_is_no_second_estimate() -> None:
    experiment = load_experiment("fig-cql-return")

    def judged(difference: float, *dce: float) -> str:
        runs = [run_rows(experiment, "DCE", CHEETAH, s, curves={"score": [score] * 10}) for s, score in enumerate(dce)]
        runs.append(run_rows(experiment, "Eq. 18", CHEETAH, 0, curves={"score": [float(np.mean(dce)) + difference] * 10}))
        return one_of(outcomes("fig-cql-return", results.merge(runs)), "Eq. 18 is better on halfcheetah")

    # two single runs, both with 4.2 and its four degrees of freedom: 2.776 * 4.2 * sqrt(2)
    assert [judged(x, 40.0) for x in (16.4, 16.6)] == [CLOSE, HELD]
    # a single run with the deviation of three others, 5, counts four too, and no more with theirs: 2.776 * 5 * sqrt(1 + 1 / 3)
    assert [judged(x, 35.0, 40.0, 45.0) for x in (15.9, 16.2)] == [CLOSE, HELD]


def test_single_runs_spread_on_each_data_set_as_the_papers_dce() -> None:
    table = load_experiment("table1")
    hopper = {"hopper-medium-sb3": {"DCE": [40.0], "BC": [60.0]}, CHEETAH: {"DCE": [40.0], "BC": [60.0]}}
    evidence = Evidence(table, table_rows(table, hopper), table.scales["cpu"])
    assert [uncertainty(evidence, table.variant("DCE"), name).error for name in hopper] == [12.3, 4.2]


def test_a_curve_that_jumps_tells_little() -> None:
    experiment = load_experiment("fig-cql-return")
    # a deviation of 6.5 of three evaluations has two degrees of freedom; with four the difference would be clear
    for jump, outcome in ((0.0, HELD), (6.5, CLOSE)):
        curves = {"DCE": [40.0 - jump, 40.0 + jump, 40.0], "Eq. 18": [61.8] * 3}
        runs = [run_rows(experiment, name, CHEETAH, 0, curves={"score": curve}) for name, curve in curves.items()]
        assert one_of(outcomes("fig-cql-return", results.merge(runs)), "Eq. 18 is better on halfcheetah") == outcome


def test_no_advantage_is_not_shown_by_runs_that_diverged_alone() -> None:
    experts = [f"{task}-medium-expert-sb3" for task in ("halfcheetah", "hopper", "walker2d")]
    rows = results.merge(lost("table1", "DCE", name).assign(n_updates=100_000) for name in experts)
    assert one_of(outcomes("table1", rows), "C6") == UNTESTED


def test_first_by_a_hair_is_not_best() -> None:
    table = load_experiment("table1")
    names = [f"halfcheetah-{kind}-sb3" for kind in ("random", "medium", "medium-replay", "medium-expert")]
    for dce, outcome in ((40.1, CLOSE), (60.0, CLOSE), (95.0, HELD), (-15.0, NOT_HELD)):
        scores = {name: {**{v.name: [40.0] for v in table.variants}, "DCE": [dce]} for name in names}
        rows = table_rows(table, scores, n_updates=100_000)
        assert one_of(outcomes("table1", rows), "C4") == outcome


def test_few_seeds_are_taken_to_spread_as_much_as_any_agent_on_the_data() -> None:
    table = load_experiment("table1")

    def errors(**scores: list[float]) -> list[float]:
        evidence = Evidence(table, table_rows(table, {CHEETAH: scores}), table.scales["cpu"])
        return [uncertainty(evidence, table.variant(name), CHEETAH).error for name in scores]

    assert errors(DCE=[10.0, 70.0]) == [pytest.approx(30.0)]
    assert errors(DCE=[40.0, 40.0]) == [pytest.approx(4.2 / np.sqrt(2))]
    assert errors(DCE=[40.0], BC=[1.0, 1.0, 1.0]) == [4.2, 0.0]
    assert errors(DCE=[40.0], IQL=[10.0, 20.0, 30.0]) == [10.0, pytest.approx(10.0 / np.sqrt(3))]


@pytest.mark.parametrize(("spread", "outcome"), [(0.0, HELD), (30.0, CLOSE)])
def test_agents_that_a_claim_is_not_about_tell_how_far_seeds_spread(spread: float, outcome: str) -> None:
    returns = load_experiment("fig-alpha-return")
    single = {"DCE, alpha 1": 60, "DCE, alpha 3": 40, "Eq. 18, alpha 1": 60, "Eq. 18, alpha 3": 40}
    runs = [scored("fig-alpha-return", {CHEETAH: single})]
    runs += [
        run_rows(returns, "DCE, alpha 5", CHEETAH, seed, curves={"score": [40.0 + spread * seed] * 10}, n_updates=100_000)
        for seed in range(2)
    ]
    assert one_of(outcomes("fig-alpha-return", results.merge(runs)), "At alpha 3 both are below") == outcome


def test_only_scores_have_an_uncertainty_over_seeds() -> None:
    experiment = load_experiment("fig-cql-return")
    rows = run_rows(experiment, "DCE", CHEETAH, 0, 40.0, {"q_data": [300.0] * 10})
    evidence = Evidence(experiment, rows, experiment.scales["cpu"])
    found = {metric: values_of(evidence, ["DCE"], metric) for metric in ("score", "q_data")}
    assert {metric: values is not None and list(values.errors) for metric, values in found.items()} == {
        "score": ["DCE"],
        "q_data": [],
    }


@pytest.mark.parametrize(("alphas", "outcome"), [((0.2, 0.3, 0.5, 0.25), HELD), ((0.2, 0.3, 0.35, 0.25), NOT_HELD)])
def test_alpha_differs_between_data_sets_by_a_factor(alphas: tuple[float, ...], outcome: str) -> None:
    experiment = load_experiment("fig-alpha")
    data = [entry.twin for entry in experiment.datasets[:4]]
    rows = scored("fig-alpha", {str(d): {"beta 4": a} for d, a in zip(data, alphas, strict=True)}, "ent_coef")
    assert one_of(outcomes("fig-alpha", rows), "between data sets (MuJoCo)") == outcome
    cheetahs = [str(d) for d in data if str(d).startswith("halfcheetah")]
    rows = scored("fig-alpha", {d: {"beta 4": 0.1 * 9**i} for i, d in enumerate(cheetahs)}, "ent_coef")
    assert one_of(outcomes("fig-alpha", rows), "between data sets (MuJoCo)") == UNTESTED, "two sets of one task"


@pytest.mark.parametrize(("slope", "outcome"), [(0.5, HELD), (2.0, NOT_HELD), (0.97, CLOSE)])
def test_flatter_curve_is_the_one_that_varies_less(slope: float, outcome: str) -> None:
    experiment = load_experiment("fig-cql-q")
    curves = {"expectile 0.7": [float(i) for i in range(25)], "without policy": [slope * i for i in range(25)]}
    for n_updates, expected in ((200_000, outcome), (100_000, UNTESTED)):  # before, Q is on the way to its level
        rows = [run_rows(experiment, n, CHEETAH, 0, curves={"q_data": q}, n_updates=n_updates) for n, q in curves.items()]
        assert one_of(outcomes("fig-cql-q", results.merge(rows)), "Q is flatter") == expected


def test_more_seeds_make_no_agent_flatter() -> None:
    experiment = load_experiment("fig-cql-q")
    wave = 10.0 * np.sin(np.arange(50) * 2.0 * np.pi / 12.0)  # the mean over seeds of other phases is nearly flat
    for counts in ((1, 4), (4, 1)):
        rows = [
            run_rows(experiment, name, CHEETAH, seed, curves={"q_data": np.roll(wave, 3 * seed) + 50.0}, n_updates=200_000)
            for name, n in zip(("expectile 0.7", "without policy"), counts, strict=True)
            for seed in range(n)
        ]
        assert one_of(outcomes("fig-cql-q", results.merge(rows)), "Q is flatter") == CLOSE


def test_curve_without_any_spread_is_the_flatter_one() -> None:
    experiment = load_experiment("fig-cql-q")
    # a spread that no figure shows, below 2 % of Q, says nothing
    for size, outcome in ((1.0, HELD), (0.0, CLOSE), (0.05, CLOSE)):
        curves = {"expectile 0.7": [5.0 + size * (-1) ** i for i in range(25)], "without policy": [5.0] * 25}
        rows = [run_rows(experiment, n, CHEETAH, 0, curves={"q_data": q}, n_updates=200_000) for n, q in curves.items()]
        assert one_of(outcomes("fig-cql-q", results.merge(rows)), "Q is flatter") == outcome


def test_claims_on_demonstrations_of_people_are_not_tested_on_those_of_a_policy() -> None:
    adroit = load_experiment("table-adroit-kitchen")
    rows = table_rows(adroit, {"pen-noisyexpert25-sb3": {"DCE": [20.0, 60.0]}})
    assert one_of(outcomes("table-adroit-kitchen", rows), "constant alpha") == UNTESTED
    data = [str(entry.twin) for entry in load_experiment("fig-alpha").datasets[4:8]]
    rows = scored("fig-alpha", {d: {"beta 4": 0.1 * 4**i} for i, d in enumerate(data)}, "ent_coef")
    assert one_of(outcomes("fig-alpha", rows), "between data sets (Adroit)") == UNTESTED


@pytest.mark.parametrize(("scores", "outcome"), [([0.0, 80.0], HELD), ([20.0, 60.0], CLOSE), ([38.0, 42.0], NOT_HELD)])
def test_constant_alpha_varies_if_one_set_varies(scores: list[float], outcome: str) -> None:
    adroit = load_experiment("table-adroit-kitchen")
    rows = table_rows(
        adroit, {"pen-human-v0": {"DCE": [*scores, *scores, scores[0]]}, "hammer-human-v0": {"DCE": [40.0, 41.0]}}
    )
    assert one_of(outcomes("table-adroit-kitchen", rows), "constant alpha") == outcome
    hammer = table_rows(adroit, {"hammer-human-v0": {"DCE": [40.0, 41.0]}})
    assert one_of(outcomes("table-adroit-kitchen", hammer), "constant alpha") == UNTESTED, "not even the paper's varies there"
