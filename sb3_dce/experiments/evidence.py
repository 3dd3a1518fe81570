"""
What the rows say about an experiment: scores of a table's cells, curves of a figure's lines, and where they come from.

All cells of a table row come from one file: where rows of two versions of a dataset are known, those of the file that is here
are taken, else of the one with more runs, and the others are counted as left out. All have one length
(:meth:`Evidence.n_updates`); runs of an agent that has only others are shown as what they are
(:meth:`Evidence.of_other_length`) and take part in no comparison. A panel and a
claim about some of the variants have the length that these have (:meth:`Evidence.among`). A configuration without runs is
shown with those of another that is the same agent over their length: two schedules of beta part later.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cached_property

import numpy as np
import pandas as pd

from sb3_dce import configuration
from sb3_dce.configuration import config_hash
from sb3_dce.data.catalog import resolve
from sb3_dce.experiments.grid import (
    EMBEDDED,
    Experiment,
    GridDataset,
    Scale,
    Variant,
    agent_key,
    settings_in_force,
    variant_hash,
)
from sb3_dce.experiments.results import RUN_KEY, TIMING
from sb3_dce.theory import beta_eff, q_limit, shift_factor, value_shift_factor

UPDATES_PER_EPOCH = 1000
TAIL = 0.1  # share of a run, from its end, that stands for what it has become
N_JUMPS = 3  # last evaluations of a run, by which it is seen how far its score moves between two
N_LATE = 10  # last evaluations, whose mean stands beside the last score of a run
GAMMA, TAU = 0.99, 0.005  # of all DCE runs of the figures (paper, common configuration)


class Evidence:
    """
    Rows of one experiment at one scale.

    :param experiment: with its datasets and variants
    :param rows: any rows; those of other experiments count where the run is the same
    :param scale: may change settings of agents, and so decides which configurations are shown
    :param n_updates: only runs of this length; ``None`` takes for each dataset that of :meth:`n_updates`
    :param hash_here: gives the SHA-256 of a dataset's file on this machine, ``None`` without one
    :param whole: evidence that this one is a part of, see :meth:`among`
    """

    def __init__(
        self,
        experiment: Experiment,
        rows: pd.DataFrame,
        scale: Scale,
        n_updates: int | None = None,
        hash_here: Callable[[str], str | None] = lambda _: None,
        whole: Evidence | None = None,
    ) -> None:
        self.experiment, self.scale = experiment, scale
        if experiment.report != TIMING and (rows["experiment"] == TIMING).any():
            rows = rows[rows["experiment"] != TIMING]
        self._rows, self._n_updates, self._hash_here = rows, n_updates, hash_here
        self._whole = whole or self
        self._sha_of: dict[str, str] = {}
        self._on_file: dict[str, pd.DataFrame] = {}
        self._length_of: dict[str, int | None] = {}
        self._of_variant: dict[tuple[str, str], pd.DataFrame] = {}
        self._runs: dict[tuple[str, str], pd.DataFrame] = {}
        self._views: dict[tuple[tuple[str, ...], int | None], Evidence] = {}
        self._same_agent: dict[tuple[str, str], list[pd.DataFrame]] = {}

    # -- a part of it ----------------------------------------------------------------------------------------------

    def among(self, names: Iterable[str], n_updates: int | None = None) -> Evidence:
        """
        Evidence on some of the variants, whose own usual length counts instead of that of the whole experiment.

        :param names: of variants
        :param n_updates: only runs of this length, unless this evidence has one already; ``None`` for the one that most of
            these variants have
        :return: the same rows, of the same files: those of a figure's panel may have longer runs than all of the figure
        """
        wanted = set(names)
        variants = tuple(v for v in self.experiment.variants if v.name in wanted)
        length = self._n_updates if self._n_updates is not None else n_updates
        key = tuple(v.name for v in variants), length
        if key not in self._views:
            part = replace(self.experiment, variants=variants)
            self._views[key] = Evidence(part, self._rows, self.scale, length, self._hash_here, self._whole)
        return self._views[key]

    def of_one_length(self, names: Iterable[str], papers: Iterable[str | None] = (None,)) -> Evidence:
        """
        As :meth:`among`, with one length for several data sets: numbers of different lengths are not compared.

        :param names: of variants
        :param papers: D4RL ids; ``None`` for the grid's first
        :return: the variants at the length that most of them have over all these data, the longest of several
        """
        names = list(names)
        view = self.among(names)
        ids = [name for name in map(view.id_of, papers) if name is not None]
        runs = [runs_in(view._of_any_length(name)) for name in ids]
        return self.among(names, _usual_length(pd.concat(runs)) if runs else None)

    # -- which data ------------------------------------------------------------------------------------------------

    @property
    def left_out(self) -> int:
        """Number of runs of the variants that do not count, since they are on another version of a file than is taken."""
        names = [EMBEDDED] if self.scale.source == "embedded" else [name for d in self.experiment.datasets for name in d.ids]
        own = {name: self.every_run(name, self.experiment.variants)["dataset_sha256"] for name in names}
        return sum(int((hashes != self._file(name)).sum()) for name, hashes in own.items() if len(hashes))

    @cached_property
    def _groups(self) -> dict[tuple[str, str, str], pd.DataFrame]:
        if self._whole is not self:
            return self._whole._groups  # to group all rows takes longer than all else
        return dict(iter(self._rows.groupby(["dataset", "agent", "config_hash"], sort=False, observed=True)))  # type: ignore[arg-type]

    def ids(self, dataset: GridDataset) -> list[str]:
        """
        Ids under which a dataset of the grid has results: D4RL's and our twin's are two rows of a table, never one.

        :param dataset: of the grid
        :return: the paper's first; at smoke scale the embedded data's for the first dataset, none for the others
        """
        names = [EMBEDDED] if self.scale.source == "embedded" and dataset == self.experiment.datasets[0] else list(dataset.ids)
        if self.scale.source == "embedded" and names != [EMBEDDED]:
            return []
        return [name for name in names if any(len(self.rows_of(v, name)) for v in self.variants(dataset))]

    def paper_id(self, dataset: GridDataset) -> str:
        """
        D4RL set whose printed numbers stand beside ours, also where our runs are on the twin.

        :param dataset: of the grid
        :return: the paper's id; at smoke scale that of the set for which the embedded data stand
        """
        if self.scale.source != "embedded":
            return dataset.paper
        return resolve(EMBEDDED).paper_row or dataset.paper

    def table_rows(self) -> list[tuple[GridDataset, str]]:
        """
        Rows of a table that have results, in the order of the grid, D4RL's file before our twin.

        :return: dataset of the grid and id of the data of each
        """
        return [(dataset, name) for dataset in self.experiment.datasets for name in self.ids(dataset)]

    def variants(self, dataset: GridDataset) -> list[Variant]:
        """
        Variants that the grid runs on a dataset: all but those that are meant for other sets of the paper.

        :param dataset: of the grid
        :return: in the order of the columns
        """
        return [v for v in self.experiment.variants if v.datasets is None or dataset.paper in v.datasets]

    def id_of(self, paper: str | None) -> str | None:
        """
        Id of the data on which a panel or a claim about a set of the paper is shown, where several may stand for it.

        :param paper: D4RL id; ``None`` for the grid's first
        :return: the one with results of more variants, of equals D4RL's own; ``None`` if there is none
        """
        dataset = self.entry(paper)
        ids = self.ids(dataset)
        return max(ids, key=lambda name: sum(bool(len(self.rows_of(v, name))) for v in self.variants(dataset)), default=None)

    def entry(self, paper: str | None) -> GridDataset:
        """
        Dataset of the grid that a panel or a claim is about; those that name none are about the first.

        :param paper: D4RL id; ``None`` for the grid's first
        :return: the entry, with its twin and notes
        """
        return self.experiment.datasets[0] if paper is None else self.experiment.dataset(paper)

    def other_kind(self, paper: str | None) -> str:
        """
        Note on data of another kind than the paper's set, on which its claims cannot be tested.

        :param paper: D4RL id; ``None`` for the grid's first
        :return: how the data that stand for it differ in kind from it; empty if they do not
        """
        dataset = self.entry(paper)
        return (dataset.note or "of another kind") if dataset.is_other_kind(self.id_of(paper)) else ""

    def scope(self, dataset_id: str, variants: Iterable[Variant]) -> str:
        """
        Text behind the numbers of a statement: data, length and seeds that it rests on, and which runs are lost.

        :param dataset_id: data
        :param variants: agents; those without runs there do not count
        :return: such as "hopper-medium-sb3, 50,000 steps, 1 to 3 seeds; CQL: 1 diverged"
        """
        shown = [v for v in variants if len(self.rows_of(v, dataset_id))]
        seeds = sorted({self.rows_of(v, dataset_id)["seed"].nunique() for v in shown}) or [0]
        lost = [f"{v.name}: {n} diverged" for v in shown if (n := self.n_diverged(v, dataset_id))]
        word = "seed" if seeds[-1] == 1 else "seeds"
        return "; ".join([f"{dataset_id}, {self.n_updates(dataset_id) or 0:,} steps, {span(seeds)} {word}", *lost])

    # -- which runs ------------------------------------------------------------------------------------------------

    def _variants_on(self, dataset_id: str) -> list[Variant]:
        """Those that the grid has on these data; at smoke scale those of its first."""
        entries = [d for d in self.experiment.datasets if dataset_id in d.ids] or self.experiment.datasets[:1]
        return [v for v in self.experiment.variants if any(v in self.variants(entry) for entry in entries)]

    def _own(self, dataset_id: str, variants: Iterable[Variant]) -> list[pd.DataFrame]:
        """Rows of those of the variants that the grid has on these data, of any length and on any version of the file."""
        wanted, here = list(variants), self._variants_on(dataset_id)
        keys = {(dataset_id, v.algo, variant_hash(v, dataset_id, self.scale)) for v in here if v in wanted}
        return [self._groups[key] for key in sorted(keys) if key in self._groups]

    def _on_any_file(self, dataset_id: str) -> pd.DataFrame:
        """Rows of the variants, and of other variants that are the same agents."""
        here = {variant_hash(v, dataset_id, self.scale) + v.algo: v for v in self._variants_on(dataset_id)}
        again = [part for variant in here.values() for part in self._rows_of_the_same_agent(variant, dataset_id)]
        parts = [*self._own(dataset_id, here.values()), *again]
        return pd.concat(parts) if parts else self._rows.iloc[:0]

    def _file(self, dataset_id: str) -> str:
        """SHA-256 of the version of a file that is taken, the same for all parts of the experiment."""
        known = self._whole._sha_of
        if dataset_id not in known:
            # a run that stands for other variants, too, is there under their hashes: its hyperparameters are always its own
            key = ["hyperparameters" if column == "config_hash" else column for column in RUN_KEY]
            hashes = self._whole._on_any_file(dataset_id)[key].drop_duplicates()["dataset_sha256"]
            here = self._hash_here(dataset_id) if hashes.nunique() > 1 else None
            known[dataset_id] = here if here is not None and here in set(hashes) else _commonest(hashes)
        return known[dataset_id]

    def _of_any_length(self, dataset_id: str) -> pd.DataFrame:
        """All runs of the variants on one file."""
        if dataset_id not in self._on_file:
            found = self._on_any_file(dataset_id)
            self._on_file[dataset_id] = found[found["dataset_sha256"] == self._file(dataset_id)] if len(found) else found
        return self._on_file[dataset_id]

    def n_updates(self, dataset_id: str) -> int | None:
        """
        Length of the runs that count on these data: that asked for; else, in a table, the longest that more than half of the
        paper's agents with runs there have; else that of most variants, the longest of several.

        A row of a table thus moves on to longer runs before the slowest agents have them, as the paper's runs are far longer
        than any of ours; a figure keeps all its lines.

        :param dataset_id: data
        :return: gradient steps; ``None`` without runs of it
        """
        if dataset_id not in self._length_of:
            runs = runs_in(self._of_any_length(dataset_id))
            if self._n_updates is not None:
                runs = runs[runs["n_updates"] == self._n_updates]
            papers = self._of_the_papers_agents(dataset_id, runs) if self.experiment.report == "table" else runs.iloc[:0]
            longest = _longest_of_most(papers)
            self._length_of[dataset_id] = longest or (_usual_length(runs) if len(runs) else None)
        return self._length_of[dataset_id]

    def _of_the_papers_agents(self, dataset_id: str, runs: pd.DataFrame) -> pd.DataFrame:
        """Those of the runs that belong to a column of the paper's tables; further forms of an agent have none."""
        agents = [v for v in self.experiment.variants if v.paper is not None]
        keys = {(v.algo, variant_hash(v, dataset_id, self.scale)) for v in agents}
        is_one = (key in keys for key in zip(runs["agent"], runs["config_hash"], strict=True))
        return runs[np.fromiter(is_one, dtype=bool, count=len(runs))]

    def _rows_of_the_same_agent(self, variant: Variant, dataset_id: str) -> list[pd.DataFrame]:
        """
        Where a variant has no runs of a length: those of another configuration that is the same agent over this length, under
        its hash. Of several the one with the most seeds: runs of two precisions are not put together.
        """
        if (variant.name, dataset_id) in self._whole._same_agent:
            return self._whole._same_agent[variant.name, dataset_id]
        wanted, settings = variant_hash(variant, dataset_id, self.scale), settings_in_force(variant, dataset_id, self.scale)
        own = self._groups.get((dataset_id, variant.algo, wanted), self._rows.iloc[:0])
        known = set(own[["dataset_sha256", "n_updates"]].itertuples(index=False, name=None))
        found: dict[tuple[str, int], pd.DataFrame] = {}
        for (data, algo, digest), rows in self._groups.items():
            if data != dataset_id or algo != variant.algo or digest == wanted:
                continue
            theirs = configuration.settings_in_force(algo, dataset_id, json.loads(rows["hyperparameters"].iloc[0]))
            if config_hash(algo, theirs) != digest:
                continue  # made with another row of the hyperparameter file
            for sha, n_updates in rows[["dataset_sha256", "n_updates"]].drop_duplicates().itertuples(index=False, name=None):
                key = (sha, n_updates)
                if key in known or agent_key(algo, theirs, n_updates) != agent_key(algo, settings, n_updates):
                    continue
                part = rows[(rows["dataset_sha256"] == sha) & (rows["n_updates"] == n_updates)].assign(config_hash=wanted)
                if key not in found or part["seed"].nunique() > found[key]["seed"].nunique():
                    found[key] = part
        self._whole._same_agent[variant.name, dataset_id] = list(found.values())
        return self._whole._same_agent[variant.name, dataset_id]

    def key_of(self, variant: Variant, dataset_id: str, n_updates: int | None = None) -> str:
        """
        Text by which two variants are found to be one agent, as two schedules of beta that have not parted yet.

        :param variant: of the experiment
        :param dataset_id: data
        :param n_updates: over how many gradient steps; ``None`` for the length of the runs there (one step without any)
        :return: the same for variants that are one agent over this length
        """
        settings = settings_in_force(variant, dataset_id, self.scale)
        return agent_key(variant.algo, settings, n_updates or self.n_updates(dataset_id) or 1)

    def rows_of_any_length(self, variant: Variant, dataset_id: str) -> pd.DataFrame:
        """
        Rows of a variant's runs on the file that is taken, also those of another that is the same agent over their length.

        :param variant: of the experiment
        :param dataset_id: data
        :return: rows of runs of all lengths; only those of the length that the caller named, if one is
        """
        key = (variant.name, dataset_id)
        if key not in self._of_variant:
            rows = self._of_any_length(dataset_id)
            wanted = variant_hash(variant, dataset_id, self.scale)
            rows = rows[(rows["agent"] == variant.algo) & (rows["config_hash"] == wanted)]
            self._of_variant[key] = rows if self._n_updates is None else rows[rows["n_updates"] == self._n_updates]
        return self._of_variant[key]

    def rows_of(self, variant: Variant, dataset_id: str) -> pd.DataFrame:
        """
        Rows of the runs of a variant that count: those of the length that is compared on these data, see :meth:`n_updates`.

        :param variant: of the experiment
        :param dataset_id: data
        :return: as :meth:`rows_of_any_length`, of this length; empty if the variant has only others
        """
        key = (variant.name, dataset_id)
        if key not in self._runs:
            rows = self.rows_of_any_length(variant, dataset_id)
            self._runs[key] = rows[rows["n_updates"] == self.n_updates(dataset_id)]
        return self._runs[key]

    def of_other_length(self, variant: Variant, dataset_id: str) -> pd.DataFrame:
        """
        Rows of a variant that cannot be compared since it has no runs of the common length; tables show them as what they are.

        :param variant: of the experiment
        :param dataset_id: data
        :return: rows of its longest runs; empty if it has some of the length of the others, or if the caller named a length
        """
        rows = self.rows_of_any_length(variant, dataset_id)
        return rows.iloc[:0] if len(self.rows_of(variant, dataset_id)) else rows[rows["n_updates"] == rows["n_updates"].max()]

    def last_of_longer(self, variant: Variant, dataset_id: str) -> tuple[np.ndarray, int] | None:
        """
        Scores of runs that are longer than the row's, by which it is seen what more training does.

        :param variant: of the experiment
        :param dataset_id: data
        :return: scores at the end of its longest runs, one per seed, and their gradient steps; ``None`` without scores, or
            if these steps are no more than the others have
        """
        return _scores_and_length(self._longest(variant, dataset_id))

    def _longest(self, variant: Variant, dataset_id: str) -> pd.DataFrame:
        """Rows of the longest runs, if they are longer than the row's."""
        rows = self.rows_of_any_length(variant, dataset_id)
        rows = rows[rows["n_updates"] > (self.n_updates(dataset_id) or 0)]
        return rows[rows["n_updates"] == rows["n_updates"].max()]

    def usual_other_length(self, dataset_id: str) -> int | None:
        """
        Length at which the paper's agents of a row are shown a second time, after more or fewer steps.

        :param dataset_id: data
        :return: of the lengths but the row's that which most of them have, the longest of several; ``None`` without such runs
        """
        runs = self._of_the_papers_agents(dataset_id, runs_in(self._of_any_length(dataset_id)))
        is_of_row = runs["n_updates"] == self.n_updates(dataset_id)
        agents = set(runs[is_of_row]["config_hash"])
        others = runs[~is_of_row & runs["config_hash"].isin(agents)]
        return _usual_length(others) if len(others) else None

    def late_mean_of_longer(self, variant: Variant, dataset_id: str) -> float | None:
        """
        Mean of the last ten evaluations of the runs of :meth:`last_of_longer`: the last one alone may be a jump.

        :param variant: of the experiment
        :param dataset_id: data
        :return: as :func:`late_mean`
        """
        return late_mean(self._longest(variant, dataset_id))

    def last_of_most_seeds(self, variant: Variant, dataset_id: str) -> tuple[np.ndarray, int] | None:
        """
        Scores at whichever length has the most seeds, by which it is judged how far seeds spread.

        :param variant: of the experiment
        :param dataset_id: data
        :return: scores at the end of these runs, one per seed, of several such lengths the longest, and their gradient steps;
            ``None`` without scores
        """
        ends = self.rows_of_any_length(variant, dataset_id)
        ends = ends[(ends["metric"] == "score") & (ends["step"] == ends["n_updates"])]
        counts = ends["n_updates"].value_counts()
        usual = max(counts.index, key=lambda n: (counts[n], n), default=None)
        return _scores_and_length(ends[ends["n_updates"] == usual])

    def largest_spread(self, dataset_id: str) -> float:
        """
        Standard deviation that agents with too few seeds for one of their own borrow: the largest of any agent on these data.

        :param dataset_id: data
        :return: of an agent's last scores over seeds, of any length; 0 where no agent has two seeds. A part of the evidence
            (:meth:`among`) borrows from all of it: two claims on one agent take the same deviation
        """
        rows = self._whole._of_any_length(dataset_id)
        ends = rows[(rows["metric"] == "score") & (rows["step"] == rows["n_updates"])]
        stds = ends.groupby(["agent", "config_hash", "n_updates"], observed=True)["value"].std(ddof=1).dropna()
        return float(stds.max()) if len(stds) else 0.0

    def jumps(self, variant: Variant, dataset_id: str) -> float:
        """
        How far a score moves from one evaluation to the next: a run whose curve jumps could as well have ended elsewhere.

        :param variant: of the experiment
        :param dataset_id: data
        :return: standard deviation of the last three evaluations of a run, root of its mean square over the runs that count; 0
            with fewer evaluations
        """
        last = self.curve(variant, dataset_id, "score").tail(N_JUMPS)
        return float(np.sqrt((last.std(ddof=1) ** 2).mean())) if len(last) == N_JUMPS and last.size else 0.0

    # -- numbers ---------------------------------------------------------------------------------------------------

    def last(self, variant: Variant, dataset_id: str, metric: str = "score") -> np.ndarray:
        """
        Value of a metric at the end of the runs that count, by default the scores that a table's cell is made of.

        :param variant: of the experiment
        :param dataset_id: data
        :param metric: name
        :return: one per run that has it there, in the order of the seeds
        """
        return at_end(self.rows_of(variant, dataset_id), metric)

    def start(self, variant: Variant, dataset_id: str, metric: str) -> float | None:
        """
        A fact about the data that the runs noted at step 0, such as their mean reward or number of terminals.

        :param variant: of the experiment
        :param dataset_id: data
        :param metric: name of the fact, such as ``data_reward_mean``
        :return: its value; ``None`` if no run has it
        """
        rows = self.rows_of(variant, dataset_id)
        values = rows[(rows["metric"] == metric) & (rows["step"] == 0)]["value"]
        return float(values.iloc[0]) if len(values) else None

    def overvalues(self, variant: Variant, dataset_id: str) -> bool:
        """
        Whether critics have run away on any seed without a number that is not finite: such a score is that of a failed run.

        :param variant: of the experiment
        :param dataset_id: data
        :return: whether the mean Q on the data ends beyond :func:`~sb3_dce.theory.q_limit`, in the runs that count or, without
            any, those that the table shows instead; false where returns are normalised, whose factor is not among the rows
        """
        rows = self.rows_of(variant, dataset_id)
        rows = rows if len(rows) else self.of_other_length(variant, dataset_id)
        settings = settings_in_force(variant, dataset_id, self.scale)
        largest = rows[(rows["metric"] == "data_reward_abs_max") & (rows["step"] == 0)]["value"]
        curve = curve_of(rows, "q_data")
        # BC has no critics, and so none of these settings
        if curve.empty or not len(largest) or settings.get("reward_normalization", "none known") is not None:
            return False
        limit = q_limit(settings["reward_scale"] * float(largest.max()) + abs(settings["reward_shift"]), settings["gamma"])
        return bool((last_tenth(curve, int(rows["n_updates"].iloc[0])).mean().abs() > limit).any())

    def n_diverged(self, variant: Variant, dataset_id: str) -> int:
        """
        Number of runs that diverged among those that count: an agent with one has failed, whatever its other seeds score.

        :param variant: of the experiment
        :param dataset_id: data
        :return: runs; 0 without any
        """
        return n_diverged_in(self.rows_of(variant, dataset_id))

    def has_ended(self, variant: Variant, dataset_id: str) -> bool:
        """
        Whether a variant has a result on these data: a run with a last score, or one that diverged.

        :param variant: of the experiment
        :param dataset_id: data
        :return: false without runs, and for runs without a simulator, which have neither
        """
        return len(self.last(variant, dataset_id)) > 0 or self.n_diverged(variant, dataset_id) > 0

    def curve(self, variant: Variant, dataset_id: str, metric: str) -> pd.DataFrame:
        """
        Course of a metric over the runs that count: scores of the evaluations, diagnostics as means over intervals.

        :param variant: of the experiment
        :param dataset_id: data
        :param metric: name
        :return: one column per seed, indexed by gradient steps
        """
        return curve_of(self.rows_of(variant, dataset_id), metric)

    def tail(self, variant: Variant, dataset_id: str, metric: str) -> float | None:
        """
        What a metric has become by the end of the runs: its mean over their last tenth, each seed with the same weight.

        :param variant: of the experiment
        :param dataset_id: data
        :param metric: name
        :return: in the metric's units; ``None`` without values in the last tenth, as when all runs diverged before
        """
        return self.tail_mean(self.curve(variant, dataset_id, metric), dataset_id)

    def tail_mean(self, curve: pd.DataFrame, dataset_id: str) -> float | None:
        """
        As :meth:`tail`, of a curve that is no metric of the rows, such as the difference of two critics' Q.

        :param curve: one column per seed, indexed by gradient steps
        :param dataset_id: data of its runs
        :return: mean over the last tenth and over seeds; ``None`` without values in it
        """
        return mean_over_seeds(last_tenth(curve, self.n_updates(dataset_id) or 0))

    # -- theory ----------------------------------------------------------------------------------------------------

    def shift(
        self, variant: Variant, reference: Variant, dataset_id: str, of: str = "q_data"
    ) -> tuple[pd.DataFrame, pd.Series]:
        """
        How far the penalty has lowered Q (or V) on the data, and how far it should have by theory.

        :param variant: with a constant beta
        :param reference: the same with beta 0
        :param dataset_id: data
        :param of: "q_data" or "value"
        :return: reference minus variant, one column per common seed; theory's value at the same steps, reward units
        """
        curves = [self.curve(v, dataset_id, of) for v in (reference, variant)]
        # means over intervals of other widths cannot be subtracted
        lowered = curves[0] - curves[1] if curves[0].index[:1].equals(curves[1].index[:1]) else pd.DataFrame()
        lowered = lowered.dropna(how="all").dropna(axis=1, how="all")
        settings = settings_in_force(variant, dataset_id, self.scale)
        unit, gamma, tau = self.beta_eff(variant, dataset_id), settings["gamma"], settings["tau"]
        steps = np.asarray(lowered.index, dtype=int)
        width = int(steps[0]) if len(steps) else 0
        # logged values are means over the interval before the step
        factor = shift_factor if of == "q_data" else value_shift_factor
        expected = [unit * factor(max(1, int(step - width / 2)), gamma, tau) for step in steps]
        return lowered, pd.Series(expected, index=lowered.index, dtype=float)

    def beta_eff(self, variant: Variant, dataset_id: str) -> float:
        """
        Shift of Q on the data in one Bellman step, ``beta / (2 c)``, with the settings that a variant has on these data.

        :param variant: of DCE with a constant beta
        :param dataset_id: data
        :return: reward units per step
        """
        settings = settings_in_force(variant, dataset_id, self.scale)
        return beta_eff(settings["beta"], settings["td_loss_coef"])

    # -- what is shown ---------------------------------------------------------------------------------------------

    def shown(self, dataset_ids: Iterable[str], variants: Iterable[Variant]) -> pd.DataFrame:
        """
        Rows that a caption describes: of each variant on each data set the runs that count, else those of another length.

        :param dataset_ids: data
        :param variants: agents
        :return: rows; those of runs that stand for two variants may be there twice
        """
        cells = [(v, name) for name in dataset_ids for v in variants]
        parts = [part for cell in cells for part in (self.rows_of(*cell), self.of_other_length(*cell))]
        return pd.concat(parts) if parts else self._rows.iloc[:0]

    def every_run(self, dataset_id: str, variants: Iterable[Variant]) -> pd.DataFrame:
        """
        Runs of the variants themselves, of any length and on any version of the file, by which is counted what is not shown.

        :param dataset_id: data
        :param variants: agents; those that the grid does not have there do not count
        :return: one line per run, with the columns ``RUN_KEY``
        """
        parts = self._own(dataset_id, variants)
        return runs_in(pd.concat(parts) if parts else self._rows.iloc[:0])


def runs_in(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Runs that rows belong to, whatever their steps and metrics.

    :param rows: any
    :return: one line per run, with the columns ``RUN_KEY``
    """
    return rows[RUN_KEY].drop_duplicates()


def at_end(rows: pd.DataFrame, metric: str) -> np.ndarray:
    """
    Value of a metric at the last step of each run; a run that has none there is left out.

    :param rows: of runs of one agent
    :param metric: name
    :return: values in the order of the seeds
    """
    rows = rows[(rows["metric"] == metric) & (rows["step"] == rows["n_updates"])]
    return rows.sort_values("seed")["value"].to_numpy(dtype=float)


def curve_of(rows: pd.DataFrame, metric: str) -> pd.DataFrame:
    """
    Values of a metric as a table of steps by seeds, without step 0, where facts about the data stand.

    :param rows: of runs of one agent and length
    :param metric: name
    :return: one column per seed, indexed by gradient steps
    """
    rows = rows[(rows["metric"] == metric) & (rows["step"] > 0)]
    return rows.pivot(index="step", columns="seed", values="value").sort_index()


def last_tenth(curve: pd.DataFrame, n_updates: int) -> pd.DataFrame:
    """
    The part of a curve that stands for what a run has become.

    :param curve: one column per seed, indexed by gradient steps
    :param n_updates: length of the runs
    :return: its points in the last tenth; none if the runs ended before
    """
    return curve[curve.index > (1.0 - TAIL) * n_updates]


def mean_over_seeds(curve: pd.DataFrame) -> float | None:
    """
    Mean of a curve or of a part of one; each seed counts the same, however often it was evaluated.

    :param curve: one column per seed, indexed by gradient steps
    :return: in the metric's units; ``None`` without values
    """
    return float(curve.mean().mean()) if curve.notna().any(axis=None) else None


def of_seeds_that_ended(curve: pd.DataFrame, n_updates: int) -> pd.DataFrame:
    """
    The part of a curve that is of the same seeds at every step; those that diverged would move a mean where they leave it.

    :param curve: one column per seed, indexed by gradient steps
    :param n_updates: length of the runs
    :return: columns of the seeds with a value at the end; empty without any
    """
    return curve.loc[:, curve.reindex([n_updates]).notna().iloc[0]].dropna(how="all")


def ended_scores(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Course of the score of the seeds that did not diverge.

    :param rows: of runs of one agent and length
    :return: one column per seed, indexed by gradient steps; empty without any
    """
    return of_seeds_that_ended(curve_of(rows, "score"), int(rows["n_updates"].max() if len(rows) else 0))


def late_mean(rows: pd.DataFrame) -> float | None:
    """
    Mean of the last ten evaluations, beside which the last one is seen to be a jump or not.

    :param rows: of runs of one agent and length
    :return: normalised score, over the seeds that have not diverged; ``None`` without runs, or if ten evaluations are all they
        have
    """
    curve = ended_scores(rows)
    return mean_over_seeds(curve.tail(N_LATE)) if len(curve) > N_LATE else None


def n_diverged_in(rows: pd.DataFrame) -> int:
    """
    Number of runs among rows that diverged.

    :param rows: of one agent and data
    :return: runs; 0 without any
    """
    return int((rows["metric"] == "diverged").sum())


def _n_agents_by_length(runs: pd.DataFrame) -> pd.Series:
    return runs.drop_duplicates(["dataset", "agent", "config_hash", "n_updates"])["n_updates"].value_counts()


def _usual_length(runs: pd.DataFrame) -> int:
    """The length that most agents have, the longest of several."""
    counts = _n_agents_by_length(runs)
    return int(max(counts.index, key=lambda n: (counts[n], n)))


def _longest_of_most(runs: pd.DataFrame) -> int | None:
    """The longest length that more than half of the agents have; ``None`` if there is none."""
    counts, n_agents = _n_agents_by_length(runs), len(runs.drop_duplicates(["agent", "config_hash"]))
    return max((int(n) for n in counts.index[2 * counts > n_agents]), default=None)


def _scores_and_length(rows: pd.DataFrame) -> tuple[np.ndarray, int] | None:
    """Last scores of runs of one length, in the order of the seeds."""
    scores = at_end(rows, "score")
    return (scores, int(rows["n_updates"].iloc[0])) if len(scores) else None


def _commonest(values: pd.Series) -> str:
    counts = values.value_counts()
    return str(min(counts.index, key=lambda value: (-counts[value], value)))


def span(numbers: Iterable[int]) -> str:
    """
    Numbers of seeds, steps or episodes as they stand in a caption: "3", "1 to 5", "-" without any.

    :param numbers: in order
    :return: the only one, or the first and the last, thousands with commas
    """
    found = [f"{int(n):,}" for n in numbers]
    return found[0] if len(found) == 1 else f"{found[0]} to {found[-1]}" if found else "-"
