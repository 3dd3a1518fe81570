"""Tables, verdicts, figures and the page, made from rows alone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import sb3_dce
from result_rows import SHA, run_rows, table_rows

from sb3_dce.experiments import results
from sb3_dce.experiments.captions import caption
from sb3_dce.experiments.claims import claim_table, own_table_facts
from sb3_dce.experiments.curves import panel_curves
from sb3_dce.experiments.diagnosis import diagnostics_table, variant_table, verdict_of
from sb3_dce.experiments.equal_steps import equal_steps_table, other_length_table
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.figures import draw, draw_profile
from sb3_dce.experiments.grid import EMBEDDED, experiment_ids, load_experiment, variant_hash
from sb3_dce.experiments.judging import CLOSE, HELD, NOT_HELD, UNTESTED, Verdict
from sb3_dce.experiments.pages import coverage, usual_runs
from sb3_dce.experiments.readings import mean_line
from sb3_dce.experiments.reports import config_table, make_report, toy_table
from sb3_dce.experiments.run_times import runtime_table
from sb3_dce.experiments.tables import aggregate_tables, common_rows, long_table, score_table, seed_table
from sb3_dce.experiments.text_table import TextTable
from sb3_dce.experiments.verdicts import verdicts
from sb3_dce.theory import shift_factor

TABLE, BETA = load_experiment("table1"), load_experiment("fig-beta")
AGENTS = [v.name for v in TABLE.variants]
CHEETAH = "halfcheetah-medium-sb3"
LONG = 100_000  # beyond the first change of DCE's beta


def evidence_of(rows: pd.DataFrame, name: str = "table1", n_updates: int | None = None) -> Evidence:
    experiment = load_experiment(name)
    return Evidence(experiment, rows, experiment.scales["cpu"], n_updates)


def cell(table: TextTable, row: str, column: str) -> str:
    (found,) = [cells for cells in table.rows if cells[0].split(" ")[0] == row]
    return found[table.header.index(column)]


def scores(**changes: list[float]) -> dict[str, list[float]]:
    # where the commonest row is the dataset's own, "DCE" and "one setting" are one run
    return {**{name: [40.0, 42.0, 44.0] for name in AGENTS}, **changes}


def diverged(variant: str, dataset: str, seed: int, n_updates: int = 1000) -> pd.DataFrame:
    row = run_rows(TABLE, variant, dataset, seed, n_updates=n_updates).iloc[:1]
    return row.assign(metric="diverged", step=300, value=1.0)


def test_cells_are_mean_and_deviation_over_seeds_beside_the_papers() -> None:
    table = score_table(evidence_of(table_rows(TABLE, {"walker2d-medium-sb3": scores(IQL=[70.0, 74.0, 81.0])})))
    assert cell(table, "walker2d-medium-sb3", "ours: IQL") == "**75.0 ± 5.6**"
    assert cell(table, "walker2d-medium-sb3", "ours: BC") == "42.0 ± 2.0"
    assert cell(table, "walker2d-medium-sb3", "D4RL set of the paper") == "walker2d-medium-v2"
    assert cell(table, "walker2d-medium-sb3", "paper: PBRL") == "**89.6 ± 0.7**"
    ours = [i for i, title in enumerate(table.header) if title.startswith("ours")]
    printed = [i for i, title in enumerate(table.header) if title.startswith("paper")]
    assert max(ours) < min(printed), "two blocks, never interleaved"


def test_bold_is_what_cannot_be_told_from_the_best() -> None:
    close = scores(IQL=[43.0, 44.0, 45.0], BC=[10.0, 11.0, 12.0])
    table = score_table(evidence_of(table_rows(TABLE, {"walker2d-medium-sb3": close})))
    bold = {name: cell(table, "walker2d-medium-sb3", f"ours: {name}").startswith("**") for name in AGENTS}
    assert bold.pop("BC") is False and all(bold.values())


def test_rows_without_results_say_whether_there_are_data() -> None:
    table = score_table(evidence_of(table_rows(TABLE, {"walker2d-medium-sb3": scores()})))
    assert [row[0] for row in table.rows[12:]] == ["total of 12 gym sets, D4RL", "total of 12 gym sets, our own"]
    assert sum(row[0].endswith(": not run") for row in table.rows) == 11
    kitchen = score_table(evidence_of(results.empty(), "table-adroit-kitchen"))
    assert {row[0] for row in kitchen.rows} >= {f"kitchen-{kind}-v0: no data" for kind in ("complete", "partial", "mixed")}


def test_d4rl_and_own_data_are_never_in_one_row_nor_in_one_total() -> None:
    rows = table_rows(
        TABLE,
        {
            "walker2d-medium-v2": {**scores(), "IQL": [90.0, 91.0, 92.0]},
            "walker2d-medium-sb3": scores(),
            "hopper-medium-sb3": scores(),
        },
    )
    evidence = evidence_of(rows)
    table = score_table(evidence)
    assert cell(table, "walker2d-medium-v2", "ours: IQL") == "**91.0 ± 1.0**"
    assert cell(table, "walker2d-medium-sb3", "ours: IQL") == "**42.0 ± 2.0**"
    totals = aggregate_tables(evidence)
    assert {source: cell(total, "IQL", "total") for source, total in totals.items()} == {"D4RL": "91.0", "sb3": "84.0"}
    assert "walker2d-medium-v2" in totals["D4RL"].caption and "-sb3" not in totals["D4RL"].caption


def test_totals_are_of_all_sets_or_missing() -> None:
    every = {dataset.twin or "": scores(IQL=[10.0, 11.0, 12.0]) for dataset in TABLE.datasets}
    del every["hopper-random-sb3"]["BC"]
    table = score_table(evidence_of(table_rows(TABLE, every)))
    totals = {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows if row[0].startswith("total")}
    ours, theirs = totals["total of 12 gym sets, our own"], totals["total of 12 gym sets, D4RL"]
    assert (ours["ours: IQL"], ours["ours: BC"], ours["ours: DCE"], ours["paper: DCE"]) == ("132.0", "-", "504.0", "")
    # E3 of the paper, printed
    assert (theirs["paper: BC"], theirs["paper: DCE"], theirs["ours: DCE"]) == ("480.2", "791.8 ± 73.3", "-")


def test_number_of_seeds_stands_where_it_is_not_the_rows() -> None:
    few = scores(UWAC=[40.0, 42.0], PBRL=[42.0])
    table = score_table(evidence_of(table_rows(TABLE, {"walker2d-medium-sb3": few})))
    assert cell(table, "walker2d-medium-sb3", "ours: UWAC").endswith("± 1.4** (2 seeds)")
    assert cell(table, "walker2d-medium-sb3", "ours: PBRL") == "42.0 (1 seed)"
    assert cell(table, "walker2d-medium-sb3", "ours: BC") == "**42.0 ± 2.0**"


def test_two_versions_of_a_file_are_not_mixed() -> None:
    main = table_rows(TABLE, {"walker2d-medium-sb3": scores()})
    other = run_rows(TABLE, "DCE", "walker2d-medium-sb3", 7, 99.0, sha="cd" * 32)
    evidence = evidence_of(results.merge([main, other]))
    assert evidence.last(TABLE.variant("DCE"), "walker2d-medium-sb3").tolist() == [40.0, 42.0, 44.0]
    assert evidence.left_out == 1


def test_a_row_has_one_length_the_longest_that_more_than_half_of_the_papers_agents_have() -> None:
    walker = "walker2d-medium-sb3"

    def length(longer: tuple[str, ...], **of: object) -> int | None:
        short = table_rows(TABLE, {walker: {name: [1.0] for name in AGENTS}}, n_updates=1000)
        long = table_rows(TABLE, {walker: {name: [2.0] for name in longer}}, n_updates=2000)
        return evidence_of(results.merge([short, long]), **of).n_updates(walker)  # type: ignore[arg-type]

    assert [v.name for v in TABLE.variants if v.paper is None] == ["DCE one setting"], "counted by the paper's seven agents"
    assert length(("BC", "IQL", "DCE", "DCE one setting")) == 1000
    assert length(("BC", "IQL", "TD3-BC", "DCE")) == 2000
    assert length(("BC", "IQL", "TD3-BC", "DCE"), n_updates=1000) == 1000, "the caller's"


def test_a_row_without_a_length_of_most_agents_has_the_commonest() -> None:
    parts = [("BC", 1000), ("IQL", 1000), ("DCE", 2000), ("CQL", 3000), ("PBRL", 4000)]
    rows = [table_rows(TABLE, {CHEETAH: {name: [1.0]}}, n_updates=n_updates) for name, n_updates in parts]
    assert evidence_of(results.merge(rows)).n_updates(CHEETAH) == 1000


def test_scores_are_of_the_rows_length_or_of_the_callers() -> None:
    long = table_rows(TABLE, {"walker2d-medium-sb3": scores()}, n_updates=2000)
    short = table_rows(TABLE, {"walker2d-medium-sb3": {"DCE": [1.0]}}, n_updates=1000)
    rows = results.merge([long, short])
    assert evidence_of(rows).last(TABLE.variant("DCE"), "walker2d-medium-sb3").tolist() == [40.0, 42.0, 44.0]
    assert evidence_of(rows, n_updates=1000).last(TABLE.variant("DCE"), "walker2d-medium-sb3").tolist() == [1.0]


def test_totals_are_of_data_of_one_length() -> None:
    parts = [
        table_rows(TABLE, {name: scores()}, n_updates=n_updates)
        for name, n_updates in (("walker2d-medium-sb3", 1000), ("hopper-medium-sb3", 1000), (CHEETAH, 2000))
    ]
    evidence = evidence_of(results.merge(parts))
    assert sorted(common_rows(evidence, "sb3")) == ["hopper-medium-sb3", "walker2d-medium-sb3"]


def test_what_is_left_of_an_agent_that_diverged_has_no_total_and_is_ahead_of_nobody() -> None:
    rows = table_rows(TABLE, {name: scores(CQL=[90.0, 91.0, 92.0], BC=[1.0] * 3) for name in HALFCHEETAHS}, n_updates=LONG)
    lost = diverged("CQL", CHEETAH, 3, n_updates=LONG)
    evidence = evidence_of(results.merge([rows, lost]))
    assert cell(score_table(evidence), CHEETAH, "ours: CQL") == "91.0 ± 1.0 (1 diverged)", "not bold"
    totals = {row[0]: row[1:] for row in aggregate_tables(evidence)["sb3"].rows}
    assert set(totals["CQL (1 diverged)"]) == {"-"} and totals["DCE"][0] != "-"
    only = {name: scores(CQL=[90.0, 91.0, 92.0] if name == CHEETAH else [1.0] * 3) for name in HALFCHEETAHS}
    whole = table_rows(TABLE, only, n_updates=LONG)
    assert claim_of(whole, "C4").outcome == NOT_HELD
    assert claim_of(results.merge([whole, lost]), "C4").outcome != NOT_HELD, "what is ahead there has failed"


def test_runs_without_scores_and_agents_that_all_diverged_are_no_error(tmp_path: Path) -> None:
    unscored = table_rows(TABLE, {CHEETAH: scores()}).query("metric != 'score'")
    assert make_report(evidence_of(unscored)).tables.keys() >= {"scores"} and not common_rows(evidence_of(unscored), "sb3")
    lost = [diverged(v.name, CHEETAH, 0) for v in TABLE.variants]
    evidence = evidence_of(results.merge(lost))
    assert {cell for row in aggregate_tables(evidence)["sb3"].rows for cell in row[1:]} == {"-"}
    assert draw_profile(evidence, "sb3", tmp_path, "profile") == []
    (finding,) = [row[-1] for row in variant_table(evidence_of(results.merge(lost), "why-dce-loses")).rows]
    assert finding == "DCE diverged on 1 of 1 seeds"


def test_course_of_the_score_is_empty_where_it_has_no_numbers() -> None:
    nan, columns = float("nan"), ("score at 40 to 60 %", "score at the end")
    for course, expected in (([1.0, nan, nan, 4.0, nan], ["-", "-"]), ([1.0, 2.0, nan, 4.0, 5.0], ["2", "5"])):
        rows = run_rows(load_experiment("why-dce-loses"), "DCE", CHEETAH, 0, curves={"score": course})
        table = diagnostics_table(evidence_of(rows, "why-dce-loses"))
        assert [cell(table, CHEETAH, column) for column in columns] == expected


def test_agent_with_runs_of_another_length_alone_is_shown_with_it_and_compared_with_nobody() -> None:
    others = {name: values for name, values in scores().items() if name != "PBRL"}
    long = table_rows(TABLE, {"walker2d-medium-sb3": others}, n_updates=50_000)
    short = table_rows(TABLE, {"walker2d-medium-sb3": {"PBRL": [90.0, 92.0]}}, n_updates=10_000, seconds=20.0)
    evidence = evidence_of(results.merge([long, short]))
    table = score_table(evidence)
    shown = cell(table, "walker2d-medium-sb3", "ours: PBRL")
    assert shown == "91.0 ± 1.4 (after 10,000, 2 seeds)", "not bold, though the best"
    assert cell(table, "walker2d-medium-sb3", "ours: BC") == "**42.0 ± 2.0**"
    assert "PBRL" not in {row[0] for row in aggregate_tables(evidence)["sb3"].rows}
    assert {row[0]: row[2] for row in runtime_table(evidence).rows}["PBRL"] == "2.0"
    only = evidence_of(results.merge([long, short]), n_updates=50_000)
    assert cell(score_table(only), "walker2d-medium-sb3", "ours: PBRL") == "-", "a length that was asked for is the only one"


def test_runs_of_another_length_that_diverged_are_counted() -> None:
    others = {name: values for name, values in scores().items() if name not in ("PBRL", "CQL")}
    lost = [diverged(name, CHEETAH, 3, n_updates=10_000) for name in ("PBRL", "CQL")]
    short = table_rows(TABLE, {CHEETAH: {"PBRL": [90.0, 92.0]}}, n_updates=10_000)
    table = score_table(evidence_of(results.merge([table_rows(TABLE, {CHEETAH: others}, n_updates=50_000), short, *lost])))
    assert cell(table, CHEETAH, "ours: PBRL") == "91.0 ± 1.4 (after 10,000, 2 seeds, 1 diverged)"
    assert cell(table, CHEETAH, "ours: CQL") == "(1 diverged, after 10,000)"


def test_agents_with_runs_of_several_lengths_have_a_table_of_scores_after_equally_many_steps() -> None:
    def curve(agent: str, seed: int, n_updates: int, *course: float) -> pd.DataFrame:
        return run_rows(TABLE, agent, CHEETAH, seed, curves={"score": course}, n_updates=n_updates)

    runs = [curve("BC", seed, 50_000, 1.0, 2.0 + seed, 3.0, 4.0, 5.0) for seed in (0, 1)]
    runs += [curve("DCE", 0, 50_000, 10.0, 20.0, 30.0, 40.0, 50.0), curve("PBRL", 0, 20_000, 6.0, 7.0)]
    runs += [diverged("CQL", CHEETAH, 0, n_updates=50_000)]
    table = equal_steps_table(evidence_of(results.merge(runs)))
    assert table is not None
    columns = ("steps", "BC", "PBRL", "CQL", "DCE", "IQL")
    shown = [cell(table, CHEETAH, column) for column in columns]
    assert shown == ["20,000", "2.5 ± 0.7 (2 seeds)", "7.0", "(1 diverged)", "20.0", "-"]
    other = table_rows(TABLE, {"walker2d-medium-sb3": {"BC": [3.0], "DCE": [5.0], "PBRL": [8.0]}}, n_updates=20_000)
    table = equal_steps_table(evidence_of(results.merge([*runs, other])))
    assert table is not None
    assert [cell(table, "total", column) for column in columns] == ["20,000", "5.5", "15.0", "-", "25.0", "-"]
    assert equal_steps_table(evidence_of(other)) is None, "the table of scores compares them"


def test_scores_after_equally_many_steps_are_of_the_runs_with_the_most_seeds() -> None:
    def curve(agent: str, seed: int, n_updates: int, level: float) -> pd.DataFrame:
        course = [level + step for step in range(n_updates // 10_000)]
        return run_rows(TABLE, agent, CHEETAH, seed, curves={"score": course}, n_updates=n_updates)

    runs = [curve("PBRL", 0, 20_000, 80.0)]
    for agent in ("BC", "IQL", "TD3-BC", "DCE"):
        runs += [curve(agent, seed, 50_000, 10.0 * seed) for seed in range(3 if agent == "DCE" else 1)]
        runs += [curve(agent, 0, 200_000, 50.0), *(curve(agent, seed, 10_000, 90.0) for seed in range(5))]
    evidence = evidence_of(results.merge(runs))
    assert evidence.n_updates(CHEETAH) == 200_000
    table = equal_steps_table(evidence)
    assert table is not None and "Gradient steps: 20,000 to 50,000; seeds: 1 to 3" in table.caption
    shown = [cell(table, CHEETAH, column) for column in ("steps", "BC", "PBRL", "DCE")]
    assert shown == ["20,000", "1.0", "81.0", "11.0 ± 10.0 (3 seeds)"], "those of 10,000 steps are too short"


def test_runs_of_another_length_have_a_table_with_the_mean_of_their_last_evaluations() -> None:
    def run(agent: str, dataset: str, seed: int, n_updates: int, *course: float) -> pd.DataFrame:
        return run_rows(TABLE, agent, dataset, seed, curves={"score": course}, n_updates=n_updates)

    usual = [run(agent, CHEETAH, 0, 50_000, 1.0, 2.0) for agent in ("BC", "UWAC", "IQL", "TD3-BC", "CQL", "DCE")]
    assert other_length_table(evidence_of(results.merge(usual))) is None
    slow = run("PBRL", CHEETAH, 0, 20_000, 1.0)
    assert other_length_table(evidence_of(results.merge([*usual, slow]))) is None, "it stands in the table of scores"
    longer = [run(agent, CHEETAH, seed, 100_000, *range(12)) for agent in ("BC", "DCE") for seed in (0, 1)]
    longer += [run("DCE", CHEETAH, 0, 200_000, 7.0, 8.0), diverged("IQL", CHEETAH, 0, n_updates=100_000)]
    table = other_length_table(evidence_of(results.merge([*usual, slow, *longer])))
    assert table is not None
    named = evidence_of(results.merge([*usual, slow, *longer]), n_updates=50_000)
    assert other_length_table(named) is None, "there is no other length for who names one"
    shown = [cell(table, CHEETAH, column) for column in ("steps", "BC", "IQL", "DCE", "CQL")]
    assert shown == ["100,000", "11.0 ± 0.0 (6.5, 2 seeds)", "(1 diverged)", "11.0 ± 0.0 (6.5, 2 seeds)", "-"]
    assert len(table.rows) == 1, "one set has no total"
    other = [run(agent, "walker2d-medium-sb3", 0, 200_000, 4.0, 7.0) for agent in ("BC", "IQL", "DCE")]
    other += [run(agent, "walker2d-medium-sb3", 0, 100_000, 4.0, 6.0) for agent in ("BC", "IQL")]
    table = other_length_table(evidence_of(results.merge([*usual, *longer, *other])))
    assert table is not None
    assert cell(table, "walker2d-medium-sb3", "IQL") == "6.0", "two evaluations have no mean of the last ten beside them"
    assert [cell(table, "total", column) for column in ("steps", "BC", "IQL", "DCE")] == ["100,000", "17.0", "-", "-"]


def test_seeds_evaluated_at_other_steps_count_by_their_own_last_evaluations() -> None:
    often = run_rows(TABLE, "DCE", CHEETAH, 0, curves={"score": [50.0] * 40})
    rarely = run_rows(TABLE, "DCE", CHEETAH, 1, curves={"score": [0.0] * 15 + [10.0] * 5})
    evidence = evidence_of(results.merge([often, rarely]))
    table = long_table(evidence)
    (row,) = [dict(zip(table.header, cells, strict=True)) for cells in table.rows if cells[2] == "DCE"]
    assert row["mean_last_10_evaluations"] == "27.5000"
    dce = evidence.experiment.variant("DCE")
    assert evidence.jumps(dce, CHEETAH) == 0.0, "neither score moves"
    curve = evidence.curve(dce, CHEETAH, "score")
    assert list(mean_line(curve)) == [25.0] * 15 + [30.0] * 5, "where both were evaluated"
    ended = curve.copy()
    ended.loc[ended.index > 500, 1] = np.nan
    assert list(mean_line(ended)) == [25.0] * 10 + [50.0] * 20, "one that diverged is waited for no more"


def test_all_columns_of_the_long_table_are_over_the_same_seeds() -> None:
    runs = [run_rows(TABLE, "DCE", CHEETAH, seed, curves={"score": [seed + 10.0 * i for i in range(12)]}) for seed in (0, 1)]
    best = run_rows(TABLE, "DCE", CHEETAH, 2, curves={"score": [500.0] * 12}).query("step < 900 and metric == 'score'")
    table = long_table(evidence_of(results.merge([*runs, pd.concat([best, diverged("DCE", CHEETAH, 2)])])))
    (row,) = [dict(zip(table.header, cells, strict=True)) for cells in table.rows if cells[2] == "DCE"]
    assert (row["n_seeds"], row["n_diverged"], row["scores"]) == ("2", "1", "110.0000 111.0000")
    assert (row["mean"], row["mean_best_evaluation"], row["mean_last_10_evaluations"]) == ("110.5000", "110.5000", "65.5000")


def with_q(q_data: float, agent: str = "TD3-BC", seed: int = 0, n_updates: int = 1000) -> pd.DataFrame:
    """A run that ends at a mean Q on data whose largest reward is 2: ten times the largest return is 2000."""
    facts = {"data_reward_abs_max": [2.0], "q_data": [0.0] * 9 + [q_data]}
    rows = run_rows(TABLE, agent, CHEETAH, seed, 40.0, facts, n_updates=n_updates)
    rows.loc[rows["metric"] == "data_reward_abs_max", "step"] = 0
    return rows


def test_critics_that_run_away_are_marked() -> None:
    rows = results.merge([with_q(-2100.0), with_q(1900.0, "DCE")])
    table = score_table(evidence_of(rows))
    assert cell(table, CHEETAH, "ours: TD3-BC") == "40.0 †" and cell(table, CHEETAH, "ours: DCE") == "40.0"
    assert "†: the critics diverge" in table.caption
    assert "†" not in score_table(evidence_of(rows[rows["metric"] != "q_data"])).caption
    # one seed of three; the mean of all is small
    seeds = results.merge([with_q(2100.0), with_q(-2000.0, seed=1), with_q(0.0, seed=2)])
    assert cell(score_table(evidence_of(seeds)), CHEETAH, "ours: TD3-BC").endswith("†")
    # runs of another length than those of the row
    other = results.merge([with_q(3e9, n_updates=500), with_q(0.0, "DCE"), with_q(0.0, "CQL")])
    assert cell(score_table(evidence_of(other)), CHEETAH, "ours: TD3-BC") == "40.0 (after 500) †"
    # IQL's rewards are normalised: what its largest is then is not known
    assert cell(score_table(evidence_of(with_q(3e9, "IQL"))), CHEETAH, "ours: IQL") == "40.0"
    totals = aggregate_tables(evidence_of(results.merge([with_q(3e9), *(with_q(0.0, v) for v in AGENTS if v != "TD3-BC")])))
    assert {row[0] for row in totals["sb3"].rows} >= {"TD3-BC †", "BC"}


def test_scores_stand_seed_by_seed_where_there_are_several() -> None:
    rows = table_rows(TABLE, {CHEETAH: {"DCE": [15.0, 0.0, 3.0], "BC": [40.0]}})
    longer = run_rows(TABLE, "DCE", CHEETAH, 1, 50.0, n_updates=2000)
    table = seed_table(evidence_of(results.merge([rows, longer, diverged("DCE", CHEETAH, 0, n_updates=2000)])))
    assert table is not None and table.rows == (
        (CHEETAH, "DCE", "cpu", "1,000", "15.0, 0.0, 3.0", "7.9"),
        (CHEETAH, "DCE", "cpu", "2,000", "diverged, 50.0", "-"),
    )
    assert (
        "9a76" not in table.caption and "abababab" in table.caption and "commits" in table.caption
    ) or "0123456" in table.caption
    assert seed_table(evidence_of(table_rows(TABLE, {CHEETAH: {"BC": [40.0]}}))) is None


def test_one_setting_is_shown_seed_by_seed_where_its_schedule_is_another() -> None:
    walker = "walker2d-medium-sb3"  # its row begins as the commonest one does, and goes on otherwise
    parts = [
        table_rows(TABLE, {walker: {name: [30.0, 31.0]}}, n_updates=n)
        for name in ("DCE", "DCE one setting")
        for n in (1000, LONG)
    ]
    table = seed_table(evidence_of(results.merge(parts)))
    assert table is not None
    shown = [(row[1], row[3]) for row in table.rows]
    assert shown == [("DCE", "1,000"), ("DCE", "100,000"), ("DCE one setting", "100,000")]


def test_seeds_of_two_precisions_are_told_apart_where_they_stand_one_by_one() -> None:
    runs = [run_rows(TABLE, "BC", CHEETAH, seed, 40.0) for seed in (0, 1)]
    evidence = evidence_of(results.merge([runs[0], runs[1].assign(device="cpu bf16-matmul")]))
    seeds = seed_table(evidence)
    assert seeds is not None
    for table in (seeds, long_table(evidence)):
        assert any("cpu and cpu bf16-matmul" in row for row in table.rows)


def test_longer_runs_are_named_with_the_mean_of_their_last_evaluations() -> None:
    why = load_experiment("why-dce-loses")
    row = {"BC": 80.0, "IQL": 10.0, "DCE": 20.0}
    runs = [run_rows(why, name, CHEETAH, 0, score, n_updates=1000) for name, score in row.items()]
    curve = [0.0] * 10 + [60.0] * 9 + [70.0]
    runs += [run_rows(why, "DCE", CHEETAH, 0, curves={"score": curve}, n_updates=2000)]
    lost = run_rows(why, "DCE", CHEETAH, 1, curves={"score": [500.0] * 20}, n_updates=2000)
    lost = lost[lost["step"] < 2000]
    runs += [pd.concat([lost, lost.iloc[:1].assign(metric="diverged", step=1950, value=1.0)])]
    finding = verdict_of(evidence_of(results.merge(runs), "why-dce-loses"), CHEETAH)
    assert "70.0 after 2,000 steps (1 seed; mean of the last ten evaluations 61.0)" in finding
    short = [*runs[:3], run_rows(why, "DCE", CHEETAH, 0, curves={"score": [60.0] * 10}, n_updates=2000)]
    assert "60.0 after 2,000 steps (1 seed)" in verdict_of(evidence_of(results.merge(short), "why-dce-loses"), CHEETAH)


def test_changes_that_are_none_are_no_numbers_and_seeds_are_counted() -> None:
    why = load_experiment("why-dce-loses")
    runs = [run_rows(why, "DCE", CHEETAH, seed, 20.0) for seed in (0, 1)] + [run_rows(why, "temperature 1", CHEETAH, 0, 25.0)]
    table = variant_table(evidence_of(results.merge(runs), "why-dce-loses"))
    cells = dict(zip(table.header, table.rows[0], strict=True))
    assert (cells["DCE"], cells["temperature 1"], cells["beta constant"], cells["c 0.5"]) == (
        "20.0 (2 seeds)",
        "25.0",
        "=",
        "-",
    )


@pytest.mark.parametrize(("gap", "said"), [(-0.62, "gap_td is 31% of beta_eff"), (0.3, None)])
def test_a_shift_that_is_not_checked_is_said(gap: float, said: str | None) -> None:
    why = load_experiment("why-dce-loses")
    runs = [
        run_rows(why, "DCE", CHEETAH, 0, 20.0, {"gap_td": [gap], "beta_eff": [2.0]}),
        run_rows(why, "BC", CHEETAH, 0, 80.0),
    ]
    finding = verdict_of(evidence_of(results.merge(runs), "why-dce-loses"), CHEETAH)
    assert ("gap_td" in finding) == (said is not None) and (said is None or said in finding)


def test_extent_of_the_evidence_is_said() -> None:
    rows = results.merge(
        [
            table_rows(TABLE, {CHEETAH: {"DCE": [1.0, 2.0], "BC": [3.0]}}),
            run_rows(TABLE, "DCE", CHEETAH, 0, 4.0, n_updates=500),
        ]
    )
    text = usual_runs({"table1": evidence_of(rows), "fig-beta": evidence_of(rows, "fig-beta")})
    assert text == "1,000 steps are commonest (3 of 4 runs), and one seed (1 of 2 pairs of agent and data)"
    assert usual_runs({"table1": evidence_of(results.empty())}) == "there are no runs yet"


def test_totals_have_the_papers_sum_of_deviations_beside_the_honest_one() -> None:
    rows = table_rows(TABLE, {"walker2d-medium-sb3": scores(), "hopper-medium-sb3": scores()})
    table = aggregate_tables(evidence_of(rows))["sb3"]
    assert cell(table, "CQL", "paper's style of ± (sum of stds)") == "4.0" and cell(table, "CQL", "std of the total") == "2.8"
    assert cell(table, "CQL", "paper: total of its rows, D4RL") == "131.0", "72.5 and 58.5"


def test_an_agent_with_little_does_not_take_the_others_data_out_of_the_totals() -> None:
    four = {"BC": [10.0], "IQL": [30.0], "DCE": [20.0]}
    names = ("halfcheetah-medium-replay-sb3", "hopper-medium-sb3", "walker2d-medium-sb3")
    rows = table_rows(TABLE, {CHEETAH: {**four, "CQL": [25.0]}, **{name: four for name in names}})
    evidence = evidence_of(rows)
    assert len(common_rows(evidence, "sb3")) == 4
    assert [row[0] for row in aggregate_tables(evidence)["sb3"].rows] == ["BC", "IQL", "DCE"]
    half = table_rows(TABLE, {CHEETAH: {**four, "CQL": [25.0]}, names[0]: {**four, "CQL": [5.0]}, names[1]: four})
    assert len(common_rows(evidence_of(half), "sb3")) == 2


def test_totals_are_over_all_data_of_the_papers_agents_and_show_no_run_twice() -> None:
    own = {"BC": [10.0], "IQL": [30.0], "DCE": [20.0]}
    rows = table_rows(TABLE, {CHEETAH: own, "hopper-medium-sb3": own})
    evidence = evidence_of(rows)
    # on halfcheetah-medium the commonest row is the dataset's own: "one setting" is DCE's run; on Hopper it was not run
    assert len(evidence.last(TABLE.variant("DCE one setting"), CHEETAH)) == 1
    assert common_rows(evidence, "sb3") == [CHEETAH, "hopper-medium-sb3"]
    table = aggregate_tables(evidence)["sb3"]
    assert [row[0] for row in table.rows] == ["BC", "IQL", "DCE"] and cell(table, "DCE", "total") == "40.0"
    assert cell(table, "BC", "P(DCE > agent)") == "-", "two runs against two"
    one = aggregate_tables(evidence_of(table_rows(TABLE, {CHEETAH: own})))["sb3"]
    assert [row[0] for row in one.rows] == ["BC", "IQL", "DCE"] and one.caption.count("Over the one data set") == 1


def test_run_times_of_precisions_stand_in_rows_of_their_own() -> None:
    parts = [run_rows(TABLE, name, CHEETAH, seed, 40.0, seconds=10.0 + seed) for name in ("DCE", "UWAC") for seed in range(4)]
    parts[3] = parts[3].assign(device="cpu bf16-matmul")
    rows = [row[:5] for row in runtime_table(evidence_of(results.merge(parts))).rows]
    assert rows == [
        ("UWAC", "cpu, fewer draws", "11.5", "10.0 to 13.0", "4"),
        ("DCE", "cpu", "11.0", "10.0 to 12.0", "3"),
        ("DCE", "cpu bf16-matmul", "13.0", "13.0 to 13.0", "1"),
    ]


def test_run_times_of_different_lengths_are_shown_and_not_compared() -> None:
    experiment = load_experiment("run-times")
    seconds = {"BC": 2.0, "IQL": 8.0, "CQL": 90.0, "UWAC": 400.0}
    parts = [run_rows(experiment, name, CHEETAH, 0, 40.0, seconds=value) for name, value in seconds.items()]
    compiled = run_rows(experiment, "DCE", CHEETAH, 0, 40.0, seconds=600.0, n_updates=50_000)
    evidence = evidence_of(results.merge([*parts, compiled]), "run-times")
    assert cell(runtime_table(evidence), "DCE", "s per 1000 updates (median)") == "12.0"
    order, far = verdicts(evidence)
    (faster,) = [row for row in claim_table({"run-times": evidence}, {}).rows if row[0] == "C3"]
    assert (order.outcome, far.outcome, faster[2]) == (UNTESTED, HELD, UNTESTED)


def test_figure_without_a_line_is_none_though_there_are_runs_of_its_data() -> None:
    experiment = load_experiment("fig-ood")
    rows = results.merge(run_rows(experiment, "DCE", CHEETAH, seed, 40.0) for seed in range(3))
    report = make_report(evidence_of(rows, "fig-ood"))
    assert not report.has_figure and report.caption == ""
    curves = {f"probe{b}_{kind}": [1.0] * 10 for b in (0, 1, 2, 4, 8) for kind in ("data", "policy", "max", "min")}
    probe = run_rows(experiment, "probe", CHEETAH, 0, curves=curves)
    both = make_report(evidence_of(results.merge([rows, probe]), "fig-ood"))
    assert both.has_figure and "seeds: 1;" in both.caption, "of the probe, not of DCE"


def test_adroit_and_kitchen_have_totals_of_their_own() -> None:
    adroit = load_experiment("table-adroit-kitchen")
    rows = table_rows(adroit, {"door-human-v0": {"BC": [10.0], "PBRL": [5.0]}, "kitchen-mixed-v0": {"BC": [50.0]}})
    tables = aggregate_tables(evidence_of(rows, "table-adroit-kitchen"))
    assert sorted(tables) == ["D4RL-adroit", "D4RL-kitchen"]
    assert cell(tables["D4RL-kitchen"], "BC", "total") == "50.0" and len(tables["D4RL-kitchen"].rows) == 1
    assert cell(tables["D4RL-adroit"], "BC", "total") == "10.0" and len(tables["D4RL-adroit"].rows) == 2
    assert cell(tables["D4RL-adroit"], "BC", "95 % interval of the IQM") == "-", "one seed has no interval"


def test_captions_name_data_hash_length_seeds_and_code() -> None:
    text = caption(evidence_of(table_rows(TABLE, {CHEETAH: scores()})), [CHEETAH])
    for part in (
        f"`{CHEETAH}` {SHA[:8]}…, made with this package, not D4RL's (run on cpu)",
        "Gradient steps: 1,000",
        "seeds: 3",
    ):
        assert part in text
    assert "10 episodes" in text and "0.1.0 (commit 0123456)" in text
    d4rl = caption(evidence_of(table_rows(TABLE, {"hopper-medium-v2": scores()})), ["hopper-medium-v2"])
    assert f"`hopper-medium-v2` {SHA[:8]}…, of D4RL" in d4rl


def test_further_runs_of_several_files_stand_together_by_their_length() -> None:
    ids = [CHEETAH, "hopper-medium-sb3"]
    shown = [table_rows(TABLE, {name: scores()}) for name in ids]
    further = [table_rows(TABLE, {name: {"BC": [1.0]}}, n_updates=200) for name in ids]
    once = [table_rows(TABLE, {CHEETAH: {"BC": [1.0, 2.0]}}, n_updates=3000)]
    text = caption(evidence_of(results.merge([*shown, *further, *once])), ids)
    assert text.endswith(f"Further runs, of other lengths: 2 of 200 steps on 2 data sets; 2 of 3,000 steps on {CHEETAH}.")


def test_a_panel_is_as_long_as_its_own_lines(tmp_path: Path) -> None:
    experiment = load_experiment("fig-beta")
    long = [run_rows(experiment, f"beta {b}", CHEETAH, 0, curves={"q_data": [1.0] * 4}, n_updates=200) for b in (0, 2, 4, 8)]
    short = [
        run_rows(experiment, variant.name, CHEETAH, 0, curves={"score": [1.0] * 4, "q_data": [1.0] * 4}, n_updates=100)
        for variant in experiment.variants
    ]
    evidence = evidence_of(results.merge([*long, *short]), "fig-beta")
    ends = {
        panel.metric: max(c.index[-1] for c, _ in panel_curves(evidence, panel).values()) for panel in experiment.panels[:2]
    }
    assert ends == {"score": 100, "q_data": 200}, "BC has no runs of the length that the betas have"
    report = make_report(evidence)
    assert "Gradient steps: 100 to 200; seeds: 1;" in report.caption and "Further runs" not in report.caption, "both are drawn"
    lengths = {(row[2], row[5]) for row in report.tables["long"].rows}
    assert {("beta 2", "100"), ("BC", "100")} <= lengths
    only = caption(evidence, [CHEETAH], [experiment.variant("beta 2"), experiment.variant("BC")])
    assert f"Further runs, of other lengths: 1 of 200 steps on {CHEETAH}." in only


def texts_of(name: str, rows: pd.DataFrame, folder: Path) -> list[str]:
    """What is written in the figure at smoke scale; its SVG has each text in a comment beside the letters' outlines."""
    experiment = load_experiment(name)
    (picture,) = [
        path for path in draw(Evidence(experiment, rows, experiment.scales["smoke"]), folder, name) if path.suffix == ".svg"
    ]
    return re.findall(r"<!-- (.*) -->", picture.read_text())


def test_panel_without_a_curve_has_the_name_of_the_data_that_the_scale_would_take(tmp_path: Path) -> None:
    titles = [text for text in texts_of("fig-beta", results.empty(), tmp_path) if "halfcheetah" in text]
    assert titles and all(title.startswith(EMBEDDED) for title in titles)
    alpha = load_experiment("fig-alpha")
    curves = {"ent_coef": [0.1] * 4}
    rows = run_rows(alpha, "beta 4", EMBEDDED, 0, curves=curves, n_updates=200, scale=alpha.scales["smoke"])
    assert not [text for text in texts_of("fig-alpha", rows, tmp_path) if re.search("(sb3|v2): no curve", text)]


def test_markdown_latex_and_csv_have_the_same_cells() -> None:
    table = TextTable(("data", "x_1"), (("a & b", "**1.0 ± 0.5**"), ("c", "-")), "50 % of `x`")
    assert table.markdown().splitlines()[2] == "| a & b | **1.0 ± 0.5** |"
    assert r"a \& b & \textbf{1.0 $\pm$ 0.5} \\" in table.latex() and r"\caption{50 \% of x}" in table.latex()
    assert table.csv().splitlines() == ["data,x_1", "a & b,1.0 ± 0.5", "c,-"]


# -- verdicts ------------------------------------------------------------------------------------------------------


def beta_rows(factor: float = 1.0, gap: float = 0.01, best: str = "beta 4", wavy: str = "beta 2") -> pd.DataFrame:
    """Rows in which Q falls by ``factor`` times what theory says, at 25 points of 200,000 updates, one beta with a wave."""
    steps = [8000 * (i + 1) for i in range(25)]
    parts = []
    for variant in BETA.variants:
        unit = 0.0 if "beta" not in variant.set else variant.set["beta"] / (2 * variant.set.get("td_loss_coef", 1.0))
        lowered = [factor * unit * shift_factor(step - 4000, 0.99, 0.005) for step in steps]
        curves = {
            "q_data": [400.0 - x + (100.0 if variant.name == wavy and i == 17 else 0.0) for i, x in enumerate(lowered)],
            "value": [399.0 - (x - factor * unit) / 0.99 for x in lowered],
            "gap_td": [gap * unit] * 25,
        }
        score = {"beta 0": 20.0, "BC": 40.0, "SAC without V": 2.0, "beta 8": 10.0, best: 70.0}.get(variant.name, 45.0)
        parts.append(run_rows(BETA, variant.name, CHEETAH, 0, score, curves, n_updates=200_000))
    return results.merge(parts)


def test_claims_on_beta_hold_on_rows_made_by_the_theory() -> None:
    judged = verdicts(evidence_of(beta_rows(), "fig-beta")) + verdicts(evidence_of(beta_rows(), "bounds"))
    assert len(judged) == 8 and {verdict.outcome for verdict in judged} == {HELD}
    assert any("beta 2: 1.00, beta 4: 1.00, beta 8: 1.00" in verdict.numbers for verdict in judged)


@pytest.mark.parametrize(
    ("change", "claim"),
    [
        ({"factor": 0.5}, "Q on the data is lowered by"),
        ({"factor": -0.1}, "In-data Q falls"),
        ({"gap": 0.5}, "gap_td near zero"),
        ({"best": "beta 8"}, "Beta 8 is too much"),
        ({"wavy": ""}, "has a large wave"),
    ],
)
def test_claims_on_beta_fail_on_rows_that_break_them(change: dict[str, object], claim: str) -> None:
    rows = beta_rows(**change)  # type: ignore[arg-type]
    judged = verdicts(evidence_of(rows, "fig-beta")) + verdicts(evidence_of(rows, "bounds"))
    (verdict,) = [v for v in judged if claim in v.claim]
    assert verdict.outcome == NOT_HELD


HALFCHEETAHS = [f"halfcheetah-{kind}-sb3" for kind in ("random", "medium", "medium-replay", "medium-expert")]


def claim_of(rows: pd.DataFrame, label: str, name: str = "table1") -> Verdict:
    (verdict,) = [v for v in verdicts(evidence_of(rows, name)) if v.claim.startswith(label)]
    return verdict


def test_claims_on_places_are_not_tested_on_d4rl_and_own_data_together() -> None:
    both = ["halfcheetah-random-v2", "halfcheetah-medium-v2", *HALFCHEETAHS[:2]]
    outcomes = []
    for names in (both, HALFCHEETAHS):
        rows = table_rows(TABLE, {name: scores(DCE=[90.0, 91.0, 92.0]) for name in names}, n_updates=LONG)
        outcomes.append(claim_of(rows, "C4").outcome)
    assert outcomes == [UNTESTED, HELD]


def test_claims_on_places_rest_on_the_files_with_more_of_the_sets() -> None:
    ours = {name: scores(DCE=[90.0, 91.0, 92.0]) for name in HALFCHEETAHS}
    theirs = {name.replace("-sb3", "-v2"): scores(DCE=[1.0, 2.0, 3.0]) for name in HALFCHEETAHS}
    for some, outcome in ((dict(list(theirs.items())[:3]), HELD), (theirs, NOT_HELD)):  # the paper's own, where both have all
        assert claim_of(table_rows(TABLE, {**ours, **some}, n_updates=LONG), "C4").outcome == outcome


def test_claims_on_places_need_all_the_papers_agents_at_one_length() -> None:
    without = {name: values for name, values in scores(DCE=[90.0]).items() if name != "PBRL"}
    verdict = claim_of(table_rows(TABLE, {name: without for name in HALFCHEETAHS}, n_updates=LONG), "C4")
    assert verdict.outcome == UNTESTED and "without runs of this length: PBRL" in verdict.numbers
    parts = [table_rows(TABLE, {n: scores(DCE=[90.0])}, n_updates=LONG * (i + 1)) for i, n in enumerate(HALFCHEETAHS)]
    assert claim_of(results.merge(parts), "C4").outcome == UNTESTED


def test_claims_on_places_are_about_the_longer_runs_of_most_agents() -> None:
    columns = scores(IQL=[90.0, 91.0, 92.0])
    slow = ("UWAC", "PBRL", "CQL")
    long = table_rows(TABLE, {n: {k: v for k, v in columns.items() if k not in slow} for n in HALFCHEETAHS}, n_updates=200_000)
    short = table_rows(TABLE, dict.fromkeys(HALFCHEETAHS, columns), n_updates=50_000)
    assert claim_of(short, "C4").outcome == UNTESTED, "before the first change of beta"
    verdict = claim_of(results.merge([long, short]), "C4")
    assert verdict.outcome == NOT_HELD and "2 of 4 (200,000 steps" in verdict.numbers
    assert "without runs of this length: CQL on 4 of 4 sets" in verdict.numbers


@pytest.mark.parametrize(
    ("dce", "others", "outcome"),
    [
        ([40.0, 41.0, 43.0, 45.0, 46.0], [40.0, 41.0, 42.0, 43.0, 44.0], HELD),
        ([80.0, 81.0, 83.0, 85.0, 86.0], [40.0, 41.0, 42.0, 43.0, 44.0], NOT_HELD),
        # so few seeds show no advantage, whether there is one or not
        ([40.0, 43.0, 46.0], [40.0, 42.0, 44.0], UNTESTED),
        ([80.0, 83.0, 86.0], [40.0, 42.0, 44.0], NOT_HELD),
        # but where others are clearly ahead there is none
        ([1.0, 2.0, 3.0], [80.0, 82.0, 84.0], HELD),
    ],
)
def test_an_advantage_within_chance_is_none(dce: list[float], others: list[float], outcome: str) -> None:
    experts = [f"{task}-medium-expert-sb3" for task in ("halfcheetah", "hopper", "walker2d")]
    rows = table_rows(TABLE, {n: {**{agent: others for agent in AGENTS}, "DCE": dce} for n in experts}, n_updates=LONG)
    assert claim_of(rows, "C6").outcome == outcome
    short = table_rows(TABLE, {n: {**{agent: others for agent in AGENTS}, "DCE": dce} for n in experts}, n_updates=50_000)
    found = claim_of(short, "C6")
    assert found.outcome == UNTESTED and "before the first change of beta: 2 of 3 sets" in found.numbers, (
        "Hopper's is constant"
    )


@pytest.mark.parametrize(
    ("cql", "device", "outcomes"),
    [
        (90.0, "cpu", (HELD, HELD, HELD)),
        (200.0, "cpu", (HELD, NOT_HELD, HELD)),
        (9.0, "cpu", (NOT_HELD, HELD, NOT_HELD)),
        # rounded products make an agent faster: nothing is known about it then
        (90.0, "cpu bf16-matmul", (UNTESTED, UNTESTED, UNTESTED)),
    ],
)
def test_run_times_are_judged_by_order_distance_and_against_cql(cql: float, device: str, outcomes: tuple[str, ...]) -> None:
    experiment = load_experiment("run-times")
    seconds = {"BC": 2.0, "IQL": 8.0, "DCE": 12.0, "CQL": cql, "UWAC": 400.0}
    parts = [run_rows(experiment, name, CHEETAH, 0, 40.0, seconds=value) for name, value in seconds.items()]
    parts[3] = parts[3].assign(device=device)
    evidence = evidence_of(results.merge(parts), "run-times")
    (faster,) = [row for row in claim_table({"run-times": evidence}, {}).rows if row[0] == "C3"]
    assert (*(v.outcome for v in verdicts(evidence)), faster[2]) == outcomes


def test_run_times_are_those_of_the_runs_made_for_them() -> None:
    timing = load_experiment("run-times")
    timed = [run_rows(timing, name, CHEETAH, 0, seconds=s) for name, s in (("BC", 4.0), ("IQL", 16.0), ("DCE", 24.0))]
    others = [run_rows(TABLE, name, CHEETAH, 0, n_updates=50_000, seconds=50.0) for name in ("BC", "IQL", "DCE", "CQL")]
    rows = results.merge([*timed, *others])
    assert {row[2] for row in runtime_table(evidence_of(rows, "run-times")).rows} == {"4.0", "16.0", "24.0"}
    table = runtime_table(evidence_of(results.merge(others), "run-times"))
    assert {row[2] for row in table.rows} == {"1.0"}, "without any, those that there are"


def test_claims_on_a_kind_of_data_are_not_tested_on_another() -> None:
    tau = load_experiment("fig-tau")
    rows = results.merge(run_rows(tau, v.name, "relocate-expert-sb3", 0, 50.0) for v in tau.variants)
    (verdict,) = [v for v in verdicts(evidence_of(rows, "fig-tau")) if "relocate" in v.claim]
    assert verdict.outcome == UNTESTED and verdict.numbers.startswith("expert data, not cloned: expectile 0.5: 50.0")


def test_numbers_of_a_verdict_say_on_what_they_rest() -> None:
    assert all(
        "halfcheetah-medium-sb3, 200,000 steps, 1 seed" in v.numbers for v in verdicts(evidence_of(beta_rows(), "fig-beta"))
    )


def test_agent_that_diverges_is_one_that_fails() -> None:
    returns = load_experiment("fig-alpha-return")
    parts = [run_rows(returns, v.name, CHEETAH, 0, 40.0) for v in returns.variants if v.name != "Eq. 18, alpha 5"]
    lost = run_rows(returns, "Eq. 18, alpha 5", CHEETAH, 0).iloc[:1].assign(metric="diverged", step=300, value=1.0)
    verdict = claim_of(results.merge([*parts, lost]), "At alpha 5", "fig-alpha-return")
    assert verdict.outcome == HELD
    values = {"Eq. 18, alpha 1": 12.0, "Eq. 18, alpha 5": 5.9}
    near = [run_rows(returns, v.name, CHEETAH, 0, values.get(v.name, 40.0)) for v in returns.variants]
    assert claim_of(results.merge(near), "At alpha 5", "fig-alpha-return").outcome == CLOSE, "two single runs"
    weak = [run_rows(returns, v.name, CHEETAH, 0, 2.0) for v in returns.variants]
    assert claim_of(results.merge(weak), "At alpha 5", "fig-alpha-return").outcome == UNTESTED, "half of nothing is nothing"


def test_end_of_runs_that_have_diverged_is_not_claimed() -> None:
    rows = beta_rows()
    lost = (rows["step"] > 100_000) & (rows["config_hash"] == variant_hash(BETA.variant("beta 0"), CHEETAH))
    evidence = evidence_of(rows[~lost], "fig-beta", 200_000)
    assert evidence.tail(BETA.variant("beta 0"), CHEETAH, "q_data") is None
    assert {v.outcome for v in verdicts(evidence) if "In-data Q falls" in v.claim} == {UNTESTED}


@pytest.mark.parametrize("name", [n for n in experiment_ids() if n not in ("bounds", "config-tables")])
def test_without_rows_nothing_is_claimed(name: str) -> None:
    report = make_report(evidence_of(results.empty(), name))
    assert {verdict.outcome for verdict in report.verdicts} <= {UNTESTED}
    assert report.verdicts or name == "why-dce-loses", "a claim without runs is shown"


def test_gap_to_the_reference_is_zero_on_rows_made_by_the_theory() -> None:
    evidence = evidence_of(beta_rows(wavy=""), "fig-beta")
    (panel,) = [p for p in BETA.panels if p.metric == "gap_ref" and p.title is None]
    curves = panel_curves(evidence, panel)
    assert list(curves) == ["beta 2", "beta 4", "beta 8"]
    assert all(np.abs(curve.to_numpy()).max() < 1e-3 for curve, _ in curves.values())


def test_file_that_is_here_counts_where_rows_of_two_are_known() -> None:
    other = "cd" * 32
    rows = results.merge(
        [
            table_rows(TABLE, {CHEETAH: {"IQL": [40.0, 41.0], "BC": [30.0]}}),
            table_rows(TABLE, {CHEETAH: {"IQL": [20.0]}}, sha=other),
        ]
    )
    for here, score in ((None, 40.5), ("ef" * 32, 40.5), (SHA, 40.5), (other, 20.0)):
        evidence = Evidence(TABLE, rows, TABLE.scales["cpu"], None, lambda _, here=here: here)  # type: ignore[misc]
        assert evidence.last(TABLE.variant("IQL"), CHEETAH).mean() == score
        assert evidence.left_out == (3 if here == other else 1)


def test_run_that_stands_for_two_columns_is_one_run_of_its_file() -> None:
    walker = "walker2d-medium-sb3"  # after so few steps "DCE one setting" is DCE under another hash
    rows = results.merge(
        [
            table_rows(TABLE, {walker: {"DCE": [40.0, 41.0]}}),
            table_rows(TABLE, {walker: {"BC": [30.0, 31.0, 32.0]}}, sha="cd" * 32),
        ]
    )
    assert len(evidence_of(rows[rows["agent"] == "dce"]).last(TABLE.variant("DCE one setting"), walker)) == 2
    evidence = evidence_of(rows)
    assert evidence.last(TABLE.variant("BC"), walker).tolist() == [30.0, 31.0, 32.0] and evidence.left_out == 2


def test_reproduction_counts_rows_of_d4rl_at_the_papers_length_only() -> None:
    table = {"walker2d-medium-v2": {"DCE": [84.0, 85.0] * 2 + [84.5]}, "hopper-medium-v2": {"DCE": [10.0, 11.0] * 2 + [10.5]}}
    own = {"walker2d-random-sb3": {"DCE": [0.0, 0.0]}}
    verdict = make_report(evidence_of(table_rows(TABLE, {**table, **own}, n_updates=1_000_000))).verdicts[-1]
    missed = "1 of 2 rows, of 12 in the table; missed: hopper-medium-v2 (10.5, paper 75.9)"
    assert verdict.outcome == NOT_HELD and verdict.numbers.startswith(missed)
    hit = table_rows(TABLE, {"walker2d-medium-v2": table["walker2d-medium-v2"]}, n_updates=1_000_000)
    assert make_report(evidence_of(hit)).verdicts[-1].outcome == UNTESTED, "11 rows are not there"
    assert make_report(evidence_of(table_rows(TABLE, table))).verdicts[-1].outcome == UNTESTED, "too short"
    few = table_rows(TABLE, {"hopper-medium-v2": {"DCE": [10.0, 11.0]}}, n_updates=1_000_000)
    assert make_report(evidence_of(few)).verdicts[-1].outcome == UNTESTED, "the interval of two seeds overlaps anything"
    lost = few[few["seed"] == 1].iloc[:1].assign(metric="diverged", step=500, value=1.0)
    failed = make_report(evidence_of(results.merge([few[few["seed"] == 0], lost]))).verdicts[-1]
    assert failed.outcome == NOT_HELD and "or DCE diverged on any seed" in failed.rule, "whatever the number of seeds"


def test_cause_of_a_loss_is_the_change_that_closes_the_gap() -> None:
    experiment = load_experiment("why-dce-loses")
    curves = {"survival_margin": [-0.5, 0.5]}
    base = {"BC": 20.0, "IQL": 110.0, "DCE": 30.0, "c 0.5": 90.0, "temperature 0.2": 42.0, "beta 1": 30.0}
    rows = results.merge(
        run_rows(experiment, name, "hopper-medium-sb3", 0, score, curves, n_updates=1000) for name, score in base.items()
    )
    terminals = rows.iloc[:1].assign(metric="data_n_terminals", step=0, value=2382.0)
    dce = rows[rows["config_hash"] == variant_hash(experiment.variant("DCE"), "hopper-medium-sb3")].iloc[:1]
    fact = dce.assign(metric="data_n_terminals", step=0, value=float(terminals["value"].iloc[0]))
    report = make_report(evidence_of(pd.concat([rows, fact], ignore_index=True), "why-dce-loses"))
    finding = cell(report.tables["changes"], "hopper-medium-sb3", "finding")
    assert finding == "behind IQL by 80.0: survival condition broken (margin -0.50); c 0.5 closes 75%"


def test_loss_is_not_explained_by_changes_that_were_not_run() -> None:
    experiment = load_experiment("why-dce-loses")
    # the row of this set has the learned temperature, so "temperature auto" is the same run and no change
    known = {"IQL": [60.0], "DCE": [40.0], "temperature auto": [40.0]}
    for scores_of, finding in (
        (known, "behind IQL by 20.0: no change was run"),
        ({**known, "beta 1": [41.0]}, "behind IQL by 20.0: none of the changes explains it"),
        ({**known, "DCE": [61.0]}, "not behind (IQL 60.0)"),
    ):
        rows = table_rows(experiment, {CHEETAH: scores_of})
        report = make_report(evidence_of(rows, "why-dce-loses"))
        assert report.tables["changes"].rows[0][-1] == finding


def test_change_that_begins_after_the_run_is_none() -> None:
    experiment = load_experiment("why-dce-loses")
    # the row of this set changes beta after 50,000 updates: until then a constant one is the same agent
    known = {"IQL": [64.0], "DCE": [40.0], "beta constant": [58.0]}
    findings = {}
    for n_updates in (50_000, 50_001):
        rows = table_rows(experiment, {CHEETAH: known}, n_updates=n_updates)
        report = make_report(evidence_of(rows, "why-dce-loses"))
        findings[n_updates] = report.tables["changes"].rows[0][-1]
    assert findings == {
        50_000: "behind IQL by 24.0: no change was run",
        50_001: "behind IQL by 24.0: beta constant closes 75%",
    }


def test_score_in_the_middle_of_a_run_is_of_its_middle() -> None:
    experiment = load_experiment("why-dce-loses")
    for n in (5, 10):  # evaluations at a fifth and at a tenth of the run
        curve = [float(i + 1) for i in range(n)]
        parts = [run_rows(experiment, "DCE", CHEETAH, 0, curves={"score": curve}, n_updates=1000)]
        report = make_report(
            evidence_of(results.merge([*parts, run_rows(experiment, "IQL", CHEETAH, 0, 99.0)]), "why-dce-loses")
        )
        row = report.tables["diagnostics"].rows[0]
        middle = [x for x, share in zip(curve, np.arange(1, n + 1) / n, strict=True) if 0.4 <= share <= 0.6]
        assert row[-2:] == (f"{np.mean(middle):.3g}", f"{curve[-1]:.3g}")


# -- facts without runs --------------------------------------------------------------------------------------------


def test_configuration_of_all_23_rows_is_the_papers() -> None:
    table = config_table()
    assert len(table.rows) == 23 and {row[-1] for row in table.rows} == {"yes"}


def test_claim_on_actions_outside_of_the_data_in_the_linear_example() -> None:
    first, second = toy_table().rows[:2]
    assert first[3:5] == ("-0.30", "-0.10") and second[3:5] == ("-0.70", "-0.90")
    assert all(row[-1] == row[-2] for row in toy_table().rows)


def test_facts_of_the_papers_own_table_are_computed() -> None:
    facts = {row[0]: row[2] for row in own_table_facts().rows}
    assert "Gym PBRL 805.3, DCE 791.8; Adroit DCE 159.3, IQL 118.1; Kitchen IQL 159.8, DCE 157.8" in facts["M1"]
    assert facts["M2"].endswith("true for 3 of 4") and "standard errors with 5 seeds 12.6, 16.7" in facts["M9"]
    assert facts["M3"].startswith("DCE has the top score in 5 of 9 rows; PBRL leads hopper-random")
    assert facts["M4"] == "its rows sum to 157.8" and "DCE: 791.8, printed 791.7" in facts["M5"]
    assert facts["M9"].startswith("sum of the row deviations: DCE 73.3, PBRL 78.6; independent rows: 28.1, 37.3")
    assert "PBRL's lead of 13.5 is within noise" in facts["M9"] and len(facts) == 16


# -- the page ------------------------------------------------------------------------------------------------------


def test_report_from_rows_alone_is_the_same_every_time(tmp_path: Path) -> None:
    for name in ("a", "b"):
        rows = results.merge([beta_rows(), table_rows(TABLE, {CHEETAH: {"IQL": [40.0, 41.0]}})])
        results.write_rows(tmp_path / name / "rows" / "all.csv.gz", rows)
        page = tmp_path / name / "results.md"
        arguments = ("--report-only", "--scale", "cpu", "--out", str(tmp_path / name), "--page", str(page))
        outcome = sb3_dce("reproduce", "table1,fig-beta,fig-tau", *arguments)
        assert outcome.code == 0, outcome.stderr
    first = sorted(path for path in (tmp_path / "a").rglob("*") if path.is_file() and path.name != "results.md")
    for path in first:
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes(), path.name
    assert {"fig-beta.png", "fig-beta.svg", "table1-scores.tex", "table1-scores.md", "table1-long.csv"} <= {
        p.name for p in first
    }
    page = (tmp_path / "a" / "results.md").read_text()
    assert "![Ablation of beta](figures/fig-beta.png)" in page and f"`{CHEETAH}` abababab…" in page
    assert '"No data": nor can there be any without files of D4RL' in page, "whether they are on this machine or not"
    assert "## The paper's claims" in page and "**held**" in page and "**could not be tested**" in page
    assert not (tmp_path / "a" / "runs").exists(), "nothing is trained"


def test_runs_of_a_schedule_that_parts_later_are_those_of_the_constant() -> None:
    alpha = load_experiment("fig-alpha")
    walker = "walker2d-medium-sb3"  # its row begins with beta 4 and the learned temperature, as on HalfCheetah
    for n_updates, shown in ((50_000, True), (150_000, False)):
        curves = {"ent_coef": [0.1] * 10, "score": [30.0] * 10}
        rows = run_rows(TABLE, "DCE", walker, 0, curves=curves, n_updates=n_updates)
        evidence = evidence_of(rows, "fig-alpha")
        assert (evidence.tail(alpha.variant("beta 4"), walker, "ent_coef") == 0.1) is shown
        assert len(evidence.rows_of(alpha.variant("beta 2"), walker)) == 0
        assert (len(evidence_of(rows).last(TABLE.variant("DCE one setting"), walker)) == 1) is shown
    own = run_rows(alpha, "beta 4", walker, 0, curves={"ent_coef": [0.3] * 10}, n_updates=50_000)
    rows = results.merge([run_rows(TABLE, "DCE", walker, 0, curves=curves, n_updates=50_000), own])
    evidence = evidence_of(rows, "fig-alpha")
    assert evidence.tail(alpha.variant("beta 4"), walker, "ent_coef") == 0.3, "its own runs count first"
    assert aggregate_tables(evidence_of(rows))["sb3"].rows[-1][0] == "DCE", "no agent stands there twice"


def test_runs_are_borrowed_once_however_many_columns_they_stand_for() -> None:
    why, hopper = load_experiment("why-dce-loses"), "hopper-medium-sb3"
    rows = run_rows(why, "beta constant", hopper, 0, curves={"survival_margin": [1.0] * 4, "score": [30.0] * 4})
    evidence = evidence_of(rows, "why-dce-loses")
    assert why.variant("DCE").set != why.variant("temperature auto").set  # one agent under one hash on this set
    for name in ("DCE", "temperature auto"):
        assert evidence.last(why.variant(name), hopper).tolist() == [30.0]
        assert len(evidence.curve(why.variant(name), hopper, "survival_margin")) == 4
    assert make_report(evidence).tables["changes"].rows


def test_coverage_counts_data_sets_and_not_files() -> None:
    both = {"walker2d-medium-v2": {"DCE": [1.0]}, "walker2d-medium-sb3": {"DCE": [1.0], "BC": [1.0]}}
    (text,) = coverage({"table1": evidence_of(table_rows(TABLE, both))})
    assert text.startswith("Gym locomotion, all agents: runs on 1 of 12 data sets (BC, DCE: 1; ")


def test_what_is_no_cause_of_a_loss_is_said_too() -> None:
    experiment = load_experiment("why-dce-loses")
    hopper = "hopper-medium-sb3"
    curves = {"survival_margin": [1.5, 1.4], "score": [10.0, 20.0, 30.0, 28.0, 9.0, 2.0, 1.0, 1.0, 1.0, 1.0]}
    dce = run_rows(experiment, "DCE", hopper, 0, curves=curves, n_updates=50_000)
    fact = dce.iloc[:1].assign(metric="data_n_terminals", step=0, value=7.0)
    longer = [run_rows(experiment, "DCE", hopper, seed, 50.0 + seed, n_updates=100_000) for seed in range(2)]
    rival = run_rows(experiment, "IQL", hopper, 0, 12.0, n_updates=50_000)
    rows = pd.concat([results.merge([rival, *longer]), dce, fact], ignore_index=True)
    finding = cell(make_report(evidence_of(rows, "why-dce-loses")).tables["changes"], hopper, "finding")
    assert finding == (
        "behind IQL by 11.0, which seeds can do: falling (13.0 in the middle of the run); 50.5 after 100,000 steps (2 seeds); "
        "no change was run; survival condition kept (margin 1.40)"
    )
