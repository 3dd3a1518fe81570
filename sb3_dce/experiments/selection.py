"""
Which rows of all there are count for an experiment.

All cells of a table row come from one file: where rows of two versions of a dataset are known, those of the file that is here
are taken, else of the one with more runs, and the others are counted as left out. All have one length
(:meth:`Selection.n_updates`); runs of an agent that has only others are shown as what they are
(:meth:`Selection.of_other_length`) and take part in no comparison. A panel and a claim about some of the variants have the
length that these have (:meth:`Selection.among`). A configuration without runs is shown with those of another that is the same
agent over their length: two schedules of beta part later.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

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
from sb3_dce.experiments.readings import commonest, longest_of_most, runs_in, usual_length
from sb3_dce.experiments.results import RUN_KEY, TIMING

if TYPE_CHECKING:
    from typing_extensions import Self


class Selection:
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
        whole: Self | None = None,
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
        self._views: dict[tuple[tuple[str, ...], int | None], Self] = {}
        self._same_agent: dict[tuple[str, str], list[pd.DataFrame]] = {}

    def among(self, names: Iterable[str], n_updates: int | None = None) -> Self:
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
            self._views[key] = type(self)(part, self._rows, self.scale, length, self._hash_here, self._whole)
        return self._views[key]

    def of_one_length(self, names: Iterable[str], papers: Iterable[str | None] = (None,)) -> Self:
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
        return self.among(names, usual_length(pd.concat(runs)) if runs else None)

    # -- which data ---------------------------------------------------------------------------------------------------

    @property
    def left_out(self) -> int:
        """Number of runs of the variants that do not count, since they are on another version of a file than is taken."""
        runs = self.runs_in_columns()[["dataset", "dataset_sha256"]]
        return sum(sha != self._file(name) for name, sha in runs.itertuples(index=False, name=None))

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

    # -- which runs ---------------------------------------------------------------------------------------------------

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
            known[dataset_id] = here if here is not None and here in set(hashes) else commonest(hashes)
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
        than any of ours; a figure keeps all its lines. Times are those of the runs that were made for them, where there are
        any: a CPU executes long runs otherwise.

        :param dataset_id: data
        :return: gradient steps; ``None`` without runs of it
        """
        if dataset_id not in self._length_of:
            rows = self._of_any_length(dataset_id)
            if self.experiment.report == TIMING and (timed := rows["experiment"] == TIMING).any():
                rows = rows[timed]
            runs = runs_in(rows)
            if self._n_updates is not None:
                runs = runs[runs["n_updates"] == self._n_updates]
            papers = self._of_the_papers_agents(dataset_id, runs) if self.experiment.report == "table" else runs.iloc[:0]
            longest = longest_of_most(papers)
            self._length_of[dataset_id] = longest or (usual_length(runs) if len(runs) else None)
        return self._length_of[dataset_id]

    def _of_the_papers_agents(self, dataset_id: str, runs: pd.DataFrame) -> pd.DataFrame:
        """Those of the runs that belong to a column of the paper's tables; further forms of an agent have none."""
        agents = [v for v in self.experiment.variants if v.paper is not None]
        return runs[runs["config_hash"].isin([variant_hash(v, dataset_id, self.scale) for v in agents])]

    def usual_other_length(self, dataset_id: str) -> int | None:
        """
        Length at which the paper's agents of a row are shown a second time, after more or fewer steps.

        :param dataset_id: data
        :return: of the lengths but the row's that which most of them have, the longest of several; ``None`` without such runs,
            or if the caller named a length
        """
        if self._n_updates is not None:
            return None
        runs = self._of_the_papers_agents(dataset_id, runs_in(self._of_any_length(dataset_id)))
        is_of_row = runs["n_updates"] == self.n_updates(dataset_id)
        agents = set(runs[is_of_row]["config_hash"])
        others = runs[~is_of_row & runs["config_hash"].isin(agents)]
        return usual_length(others) if len(others) else None

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

    def _longest(self, variant: Variant, dataset_id: str) -> pd.DataFrame:
        """Rows of the longest runs, if they are longer than the row's."""
        rows = self.rows_of_any_length(variant, dataset_id)
        rows = rows[rows["n_updates"] > (self.n_updates(dataset_id) or 0)]
        return rows[rows["n_updates"] == rows["n_updates"].max()]

    # -- what is shown ------------------------------------------------------------------------------------------------

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

    def runs_in_columns(self) -> pd.DataFrame:
        """
        All runs that the grid has a place for, whether they are shown or not.

        :return: one line per run, with the columns ``RUN_KEY``
        """
        names = [EMBEDDED] if self.scale.source == "embedded" else [name for d in self.experiment.datasets for name in d.ids]
        return pd.concat([runs_in(self._rows.iloc[:0]), *(self.every_run(n, self.experiment.variants) for n in names)])

    def every_run(self, dataset_id: str, variants: Iterable[Variant]) -> pd.DataFrame:
        """
        Runs of the variants themselves, of any length and on any version of the file, by which is counted what is not shown.

        :param dataset_id: data
        :param variants: agents; those that the grid does not have there do not count
        :return: one line per run, with the columns ``RUN_KEY``
        """
        parts = self._own(dataset_id, variants)
        return runs_in(pd.concat(parts) if parts else self._rows.iloc[:0])
