"""Scores after equally many steps, where slow agents have shorter runs than the row of the table, and after another number."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from sb3_dce.experiments.captions import caption_of
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.grid import Variant
from sb3_dce.experiments.readings import N_LATE, ended_scores, late_mean, n_diverged_in
from sb3_dce.experiments.tables import mark, mark_note, mean_and_spread, parts_of, rows_of_part
from sb3_dce.experiments.text_table import TextTable

NOTE = (
    "The last number of steps after which every agent with runs on a set was evaluated, by its runs with the most seeds, of "
    "several the shortest. Longer runs are on their way there: what an agent plans over a whole run (IQL the learning rate of "
    "its actor) is that of the longer one. No claim is judged by these scores."
)
OTHER_NOTE = (
    "What more or fewer steps do: further runs of the agents of the table of scores, of the commonest other length of each "
    f"set; in brackets the mean of the last {N_LATE} evaluations, where there were more. No claim is judged by these scores."
)


def equal_steps_table(evidence: Evidence) -> TextTable | None:
    """
    What the table of scores cannot compare, since a cell "after n" is of another length than its row.

    :param evidence: of an experiment with a table
    :return: one row per file on which two agents of the paper or more have runs, at the last step at which all of them were
        evaluated; totals where that is the same on all data of a source; ``None`` if all runs have the length of their row
    """
    agents = [v for v in evidence.experiment.variants if v.paper is not None]
    ids = [name for _, name in evidence.table_rows()]
    if not any(len(evidence.of_other_length(v, name)) for name in ids for v in agents):
        return None
    rows: list[tuple[str, ...]] = []
    scores: dict[str, tuple[int, dict[str, np.ndarray]]] = {}
    parts: list[pd.DataFrame] = []
    for name in ids:
        runs = _runs_to_compare({v.name: evidence.rows_of_any_length(v, name) for v in agents})
        lost = {agent: n for agent, found in runs.items() if (n := n_diverged_in(found))}
        curves = {agent: ended_scores(found) for agent, found in runs.items()}
        after = _last_common_step(curves)
        if after is None:
            continue
        at = {agent: curve.loc[after].to_numpy() for agent, curve in curves.items() if len(curve)}
        rows.append((name, f"{after:,}", *(_cell(at.get(v.name), lost.get(v.name, 0)) for v in agents)))
        scores[name] = after, {agent: found for agent, found in at.items() if agent not in lost}
        parts += [runs[agent] for agent in at]
    if not rows:
        return None
    rows += _totals(evidence, agents, scores)
    header = ("data", "steps", *(v.name for v in agents))
    origin = caption_of(evidence, pd.concat(parts), agents, "the policy at the step of the row")
    return TextTable(header, tuple(rows), f"{NOTE} {origin}")


def _runs_to_compare(every: Mapping[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """
    Of each agent the runs with the most seeds, of several lengths the shortest; none shorter than the shortest of the longest
    runs of all agents, which would cut the common step.
    """
    shortest = min((rows["n_updates"].max() for rows in every.values() if len(rows)), default=0)
    found = {}
    for agent, rows in every.items():
        lengths = rows[rows["n_updates"] >= shortest].groupby("n_updates")["seed"].nunique()
        chosen = max(lengths.index, key=lambda n: (lengths[n], -n), default=None)
        found[agent] = rows[rows["n_updates"] == chosen]
    return found


def other_length_table(evidence: Evidence) -> TextTable | None:
    """
    What more or fewer steps do, where agents have been trained for another time than in the row of the table of scores, too.

    :param evidence: of an experiment with a table
    :return: one row per file with such runs, totals as in :func:`equal_steps_table`; ``None`` without any
    """
    agents = [v for v in evidence.experiment.variants if v.paper is not None]
    rows: list[tuple[str, ...]] = []
    scores: dict[str, tuple[int, dict[str, np.ndarray]]] = {}
    parts: list[pd.DataFrame] = []
    for _, name in evidence.table_rows():
        if (length := evidence.usual_other_length(name)) is None:
            continue
        view = evidence.among([v.name for v in agents], length)
        late = {v.name: late_mean(view.rows_of(v, name)) for v in agents}
        lost = {v.name: n for v in agents if (n := view.n_diverged(v, name))}
        at = {v.name: found for v in agents if len(found := view.last(v, name))}
        cells = (_cell(at.get(v.name), lost.get(v.name, 0), late[v.name]) + mark(view, v, [name]) for v in agents)
        rows.append((name, f"{length:,}", *cells))
        scores[name] = length, {agent: found for agent, found in at.items() if agent not in lost}
        parts += [view.rows_of(v, name) for v in agents]
    if not rows:
        return None
    rows += _totals(evidence, agents, scores)
    origin = caption_of(evidence, pd.concat(parts), agents)
    return TextTable(("data", "steps", *(v.name for v in agents)), tuple(rows), f"{OTHER_NOTE}{mark_note(rows)} {origin}")


def _totals(
    evidence: Evidence, agents: list[Variant], scores: Mapping[str, tuple[int, dict[str, np.ndarray]]]
) -> list[tuple[str, ...]]:
    """Sums over the data of a source with scores after the same number of steps on all of them, for agents that have all."""
    rows: list[tuple[str, ...]] = []
    for part in parts_of(evidence):
        ids = [name for name in rows_of_part(evidence, part) if name in scores]
        steps = {scores[name][0] for name in ids}
        if len(ids) > 1 and len(steps) == 1:
            sums = (_total([scores[name][1] for name in ids], v.name) for v in agents)
            rows.append((f"total of these {len(ids)} ({part.replace('-', ', ')})", f"{steps.pop():,}", *sums))
    return rows


def _last_common_step(curves: Mapping[str, pd.DataFrame]) -> int | None:
    steps = [set(curve.dropna().index) for curve in curves.values() if len(curve)]
    common = set.intersection(*steps) if len(steps) > 1 else set()
    return int(max(common)) if common else None


def _cell(scores: np.ndarray | None, n_diverged: int, late: float | None = None) -> str:
    notes = [] if late is None else [f"{late:.1f}"]
    notes += [] if scores is None or len(scores) < 2 else [f"{len(scores)} seeds"]
    notes += [f"{n_diverged} diverged"] if n_diverged else []
    text = "" if scores is None else mean_and_spread(scores)
    return f"{text} ({', '.join(notes)})".strip() if notes else text or "-"


def _total(rows: list[dict[str, np.ndarray]], agent: str) -> str:
    return f"{sum(float(of[agent].mean()) for of in rows):.1f}" if all(agent in of for of in rows) else "-"
