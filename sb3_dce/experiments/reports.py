"""From the rows of an experiment to its report: tables, figure, caption and verdicts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_dce.configuration import row_of
from sb3_dce.dce import OfflineDCE
from sb3_dce.experiments import diagnosis, tables
from sb3_dce.experiments.captions import caption_of
from sb3_dce.experiments.curves import panel_curves, variants_of, view_of
from sb3_dce.experiments.equal_steps import equal_steps_table, other_length_table
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.grid import Variant, source_of
from sb3_dce.experiments.judging import CLOSE, HELD, NOT_HELD, UNTESTED, Verdict, judge
from sb3_dce.experiments.paper import PAPER_SEEDS, paper_score, read_csv
from sb3_dce.experiments.run_times import runtime_table
from sb3_dce.experiments.statistics import mean_interval
from sb3_dce.experiments.text_table import TextTable
from sb3_dce.experiments.verdicts import verdicts
from sb3_dce.schedules import StepSchedule
from sb3_dce.theory import penalty_bound, sampling_bound, upper_bound

PAPER_UPDATES = 1_000_000
# Of the paper's common configuration, with the reading where it prints none.
COMMON = (
    ("learning rate of Q, V and actor", "3e-4", "learning_rate"),
    ("gamma", "0.99", "gamma"),
    ("expectile (tau)", "0.7", "expectile"),
    ("Polyak coefficient (upsilon)", "0.005", "tau"),
    ("hidden layers", "256, 256", "policy_kwargs"),
    ("batch size", "not printed", "batch_size"),
    ("interval of the changes of beta, epochs", "50", "beta_update_every"),
    ("gradient steps per epoch", "1000 (500 epochs are 500,000 gradients)", "steps_per_epoch"),
)


class Report(NamedTuple):
    """
    What an experiment comes to, before any of it is written to files.

    :param tables: by name
    :param has_figure: whether there is anything to draw in its panels
    :param caption: of the figure
    :param verdicts: on the paper's claims
    """

    tables: dict[str, TextTable]
    has_figure: bool
    caption: str
    verdicts: list[Verdict]


def make_report(evidence: Evidence) -> Report:
    """
    All that the kind of an experiment (``report`` in its grid) calls for; what has no rows says so.

    :param evidence: rows of one experiment
    :return: tables, caption and verdicts; the figure itself is drawn by :func:`sb3_dce.experiments.figures.draw`
    """
    kind = evidence.experiment.report
    drawn = drawn_in(evidence)
    caption = caption_of(evidence, *drawn) if drawn is not None else ""
    found: dict[str, TextTable] = {}
    judged = verdicts(evidence)
    if kind == "table":
        found["scores"] = tables.score_table(evidence)
        if (other := other_length_table(evidence)) is not None:
            found["other-length"] = other
        if (equal := equal_steps_table(evidence)) is not None:
            found["equal-steps"] = equal
        if (seeds := tables.seed_table(evidence)) is not None:
            found["seeds"] = seeds
        found |= {f"aggregates-{part}": table for part, table in tables.aggregate_tables(evidence).items()}
        found["run-times"] = runtime_table(evidence)
        found["long"] = tables.long_table(evidence)
        judged.append(reproduction(evidence))
    elif kind == "run-times":
        found["run-times"] = runtime_table(evidence)
    elif kind == "figure":
        found["long"] = tables.long_table(evidence)
    elif kind == "bounds":
        found = {"bounds": bounds_table(), "claim-4.3": toy_table()}
        judged = [_toy_verdict(found["claim-4.3"]), *judged]
    elif kind == "diagnosis":
        found = {"changes": diagnosis.variant_table(evidence), "diagnostics": diagnosis.diagnostics_table(evidence)}
    elif kind == "configuration":
        found = {"rows": config_table(), "common": common_table()}
        judged = [_config_verdict(found["rows"])]
    return Report(found, drawn is not None, caption, judged)


def drawn_in(evidence: Evidence) -> tuple[pd.DataFrame, list[Variant]] | None:
    """
    What the caption of a figure is about; each panel has runs of the length that its own variants have.

    :param evidence: rows of one experiment
    :return: rows of the runs that have a line in any panel, and the variants of these panels; ``None`` if all are empty
    """
    parts: list[pd.DataFrame] = []
    names: set[str] = set()
    for panel in evidence.experiment.panels:
        curves, view = panel_curves(evidence, panel), view_of(evidence, panel)
        if not curves:
            continue
        ids = list(curves) if panel.over else [name for name in [view.id_of(panel.dataset)] if name is not None]
        # lines of one variant (over data sets, or critics of the probe) have names of their own
        lines = {*(variants_of(view, panel)[:1] if panel.over or panel.lines else curves)}
        lines |= {panel.reference} if panel.reference else set()
        parts.append(view.shown(ids, [v for v in view.experiment.variants if v.name in lines]))
        names |= {v.name for v in view.experiment.variants}
    if not parts:
        return None
    return pd.concat(parts), [v for v in evidence.experiment.variants if v.name in names]


def reproduction(evidence: Evidence) -> Verdict:
    """
    Whether DCE's scores are the paper's, row by row on D4RL's own files, after as many steps and with at least as many seeds.

    :param evidence: of a table
    :return: on how many of DCE's rows our interval meets the paper's mean and deviation; one with a run that diverged does
        not, whatever its number of seeds
    """
    hits: list[str] = []
    misses: list[str] = []
    dce = evidence.experiment.variant("DCE")
    evidence = evidence.among(["DCE"], PAPER_UPDATES)
    for dataset, name in evidence.table_rows():
        cell, scores = paper_score(dataset.paper, "DCE"), evidence.last(dce, name)
        if source_of(name) != "D4RL" or cell is None or cell.score is None or evidence.n_updates(name) != PAPER_UPDATES:
            continue
        if evidence.n_diverged(dce, name):
            misses.append(f"{name} (diverged, paper {cell.score:g})")
            continue
        if len(scores) < PAPER_SEEDS:  # the interval of two seeds overlaps nearly everything
            continue
        low, high = mean_interval(scores)
        spread = cell.std or 0.0
        met = low <= cell.score + spread and high >= cell.score - spread
        (hits if met else misses).append(f"{name} ({scores.mean():.1f}, paper {cell.score:g})")
    n, wanted = len(hits) + len(misses), sum(paper_score(d.paper, "DCE") is not None for d in evidence.experiment.datasets)
    numbers = f"no {PAPER_SEEDS} seeds of {PAPER_UPDATES:,} steps on D4RL's own files"
    if n:
        numbers = f"{len(hits)} of {n} rows, of {wanted} in the table; missed: {', '.join(misses) or 'none'}"
    rule = (
        f"held: with {PAPER_SEEDS} seeds or more the 95 % interval over ours overlaps the paper's mean ± its deviation, on "
        "every row of D4RL's data; did not hold: on one of the rows it does not, or DCE diverged on any seed"
    )
    return judge("DCE's scores are reproduced", rule, False if misses else True if n == wanted else None, numbers)


# -- appendix ------------------------------------------------------------------------------------------------------


def bounds_table() -> TextTable:
    """
    Bounds of Eq. 14, 16 and 17 for the betas of the figures, from the formulas alone.

    :return: one row per beta, theory units; bounds in reward units
    """
    sampling = sampling_bound(1.0, 1.0, 1.0, 0.7, 0.99, 100)
    rows = []
    for beta in (1.0, 2.0, 4.0, 8.0):
        penalty = penalty_bound(beta, 0.99)
        rows.append((f"{beta:g}", *(f"{value:.2f}" for value in (penalty, sampling, upper_bound(0.0, penalty, sampling)))))
    header = ("beta, theory units", "penalty, Eq. 14", "sampling, Eq. 16", "sum, Eq. 17")
    caption = (
        "Formulas alone: gamma 0.99, n infinite, C_r = C_T = R_max = 1, expectile 0.7, 100 visits. Theory "
        "units are beta_eff = beta / (2 td_loss_coef). Eq. 17 is printed as an upper bound; it bounds the absolute error. "
        "Eq. 14 has a density ratio of policy and data, which is not known; with 1, taken here, it is the shift that theory "
        "expects and that the claims below are about, so that no run could tell the bound from it."
    )
    return TextTable(header, tuple(rows), caption)


def toy_table() -> TextTable:
    """
    Claim 4.3 on a linear critic with features (1, a), data at a = -1 and 1, values k a, and a policy at x outside.

    :return: solved critics and which action they prefer
    """
    rows = []
    for k, beta, x in ((1.2, 0.5, 2.0), (0.8, 0.5, 2.0), (2.0, 0.5, 3.0), (1.2, 0.5, 3.0)):
        data = np.array([[1.0, -1.0], [1.0, 1.0]])
        second_moment, target = data.T @ data / 2, data.T @ (k * data[:, 1]) / 2
        w = np.linalg.solve(second_moment, target - beta * np.array([1.0, x]))
        q_data, q_ood = float(w @ [1.0, 1.0]), float(w @ [1.0, x])
        gain, shift = k * (x - 1), beta * (1 + x * x) - beta * (1 + x)
        cells = (f"{k:g}", f"{beta:g}", f"{x:g}", f"{q_data:.2f}", f"{q_ood:.2f}", f"{gain:.2f}", f"{shift:.2f}")
        rows.append((*cells, "yes" if q_ood > q_data else "no", "yes" if gain > shift else "no"))
    header = ("k", "beta_eff", "x", "Q(1)", "Q(x)", "gain of Q*", "difference of the shifts", "x preferred", "claim says")
    return TextTable(
        header,
        tuple(rows),
        "Linear critic, features (1, a), solved in closed form; data at a = -1 and 1 with values k a, policy at x.",
    )


def _toy_verdict(table: TextTable) -> Verdict:
    agreeing = sum(row[-1] == row[-2] for row in table.rows)
    claim = "Claim 4.3: an action outside of the data is preferred exactly if its gain exceeds the difference of the shifts"
    rule = "holds in every row of the linear example"
    return judge(claim, rule, agreeing == len(table.rows), f"{agreeing} of {len(table.rows)} rows")._replace(is_check=True)


# -- configuration -------------------------------------------------------------------------------------------------


def config_table() -> TextTable:
    """
    The 23 rows as printed and as in our file, the schedule of beta compared value by value at the printed epochs.

    :return: one row per dataset, with "yes" at its end if alpha and schedule agree
    """
    schedules = {row.pop("dataset"): row for row in read_csv("beta_schedules.csv")}
    rows = []
    for printed in read_csv("paper_config.csv"):
        name = printed["dataset"]
        ours = row_of("dce", name)
        beta, final, rate = ours["beta"], ours["beta_final"], ours["beta_rate"]
        schedule = StepSchedule.of(ours)
        same = all(
            abs(schedule.value(int(epoch) * ours["steps_per_epoch"]) - float(value)) < 1e-6
            for epoch, value in schedules[name].items()
        )
        alpha = str(ours["ent_coef"]) if isinstance(ours["ent_coef"], str) else f"{ours['ent_coef']:g}"
        end = beta if final is None else final
        cells = (printed["ent_coef"], printed["beta_start"], printed["beta_end"], printed["beta_rate"])
        in_file = (alpha, f"{beta:g}", f"{end:g}", f"{rate:g}")
        rows.append((name, *cells, *in_file, "yes" if same and cells[0] == alpha else "no"))
    names = ("alpha", "beta, start", "beta, end", "rate")
    header = ("data", *(f"paper: {n}" for n in names), *(f"file: {n}" for n in names), "alpha and schedule agree")
    note = "Schedules are compared at every 50th epoch. relocate-cloned: printed '0.1' with rate 0.5, read as a constant."
    return TextTable(header, tuple(rows), note)


def common_table() -> TextTable:
    """
    The configuration that all of the paper's rows share, as printed and as the file has it for halfcheetah-medium-v2.

    :return: one row per parameter, "not printed" where the paper is silent
    """
    ours = row_of("dce", "halfcheetah-medium-v2")
    cells = [(text, printed, str(ours[name]), f"`{name}`") for text, printed, name in COMMON]
    note = (
        f"`zoo_hyperparams/{OfflineDCE.algo_name}.yml`. Batch size and hidden layers of the ancestors where none is printed."
    )
    return TextTable(("what", "paper", "file", "parameter"), tuple(cells), note)


def _config_verdict(table: TextTable) -> Verdict:
    agreeing = sum(row[-1] == "yes" for row in table.rows)
    rule = "alpha and the whole schedule of beta agree in all 23 rows"
    verdict = judge("The configurations are the paper's", rule, agreeing == 23, f"{agreeing} of {len(table.rows)} rows")
    return verdict._replace(is_check=True)


def count(judged: list[Verdict]) -> str:
    """
    How many verdicts have each outcome, in words; checks of formulas and files are counted apart.

    :param judged: verdicts
    :return: part of a sentence, without its full stop
    """
    claims, checks = ([v for v in judged if v.is_check == wanted] for wanted in (False, True))
    numbers = {outcome: sum(v.outcome == outcome for v in claims) for outcome in (HELD, NOT_HELD, CLOSE, UNTESTED)}
    text = ", ".join(f"{n} {outcome}" for outcome, n in numbers.items())
    if checks:
        right = sum(v.outcome == HELD for v in checks)
        text += f"; checks of formulas and files, which no run could refute: {right} of {len(checks)} right"
    return text
