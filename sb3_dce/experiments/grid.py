"""
Declarative grids: which agents with which hyperparameters are trained on which data, how long, with which seeds.

A grid names the paper's datasets. A scale decides which file stands for each: our ``-sb3`` twin, D4RL's own where it is
present, or the embedded data. A run is known by what it is, not by the experiment that asked for it: two experiments with
a run in common share it.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from sb3_dce import configuration
from sb3_dce.agents import agent_class
from sb3_dce.checks import did_you_mean
from sb3_dce.configuration import config_hash, differences
from sb3_dce.data.catalog import resolve
from sb3_dce.data.locate import DATASETS_VARIABLE, search
from sb3_dce.errors import ConfigError, DatasetError, DatasetNotFoundError
from sb3_dce.run_files import RunSpec
from sb3_dce.schedules import StepSchedule

SCALES = ("smoke", "cpu", "full")
EMBEDDED = "halfcheetah-tiny-sb3"


@dataclass(frozen=True)
class Variant:
    """
    One agent with its hyperparameters: a column of a table or a line of a figure.

    :param name: heading
    :param algo: name of the agent
    :param set: constructor arguments that replace those of the dataset's row
    :param paper: method in the paper's tables, if it is there
    :param datasets: the paper's datasets it is run on; ``None`` for all of the grid
    :param best_policy_of: variant whose last policy the probe of out-of-distribution actions needs first
    """

    name: str
    algo: str
    set: dict[str, Any] = field(default_factory=dict)
    paper: str | None = None
    datasets: tuple[str, ...] | None = None
    best_policy_of: str | None = None


@dataclass(frozen=True)
class GridDataset:
    """
    A dataset of the paper and what may stand for it.

    :param paper: D4RL id in the paper's tables
    :param twin: our own data that stand for it; ``None`` where there are none
    :param note: how these differ
    :param other_kind: whether they are of another kind, so that a claim about the paper's kind cannot be tested on them
    """

    paper: str
    twin: str | None = None
    note: str | None = None
    other_kind: bool = False

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids under which results of this row may be found, the paper's first, then that of the twin if there is one."""
        return (self.paper,) if self.twin is None else (self.paper, self.twin)

    def is_other_kind(self, dataset_id: str | None) -> bool:
        """
        Whether a claim about the paper's kind of data cannot be tested on these: D4RL's own set is never of another kind.

        :param dataset_id: one of :attr:`ids`, ``None`` without results
        :return: true for a twin that the grid says to be of another kind
        """
        return self.other_kind and dataset_id == self.twin

    @property
    def absence(self) -> str:
        """
        What tables and panels say where there are no results: "no data" for a set without a twin, else "not run".

        :return: "no data" for Kitchen, where only D4RL's file can give some; a page says the same on every machine
        """
        return "no data" if self.twin is None else "not run"

    @property
    def why_untested(self) -> str:
        """
        Why a claim about this set has no numbers: as :attr:`absence`, but runs on data of another kind would test it no more.

        :return: "no data", how our data differ in kind, or "not run"
        """
        return f"no runs; our data are of another kind: {self.note}" if self.other_kind and self.note else self.absence


@dataclass(frozen=True)
class Panel:
    """
    One picture of a figure.

    :param metric: what is drawn over epochs
    :param dataset: the paper's dataset; ``None`` for the first of the grid
    :param variants: lines; empty for all of the grid
    :param over: draw one line per dataset of this list instead, of the one variant
    :param lines: values of beta of the probe's critics, one line each
    :param reference: variant whose values are subtracted
    :param title: addition to the heading
    :param scale: of the y axis
    """

    metric: str
    dataset: str | None = None
    variants: tuple[str, ...] = ()
    over: tuple[str, ...] = ()
    lines: tuple[int, ...] = ()
    reference: str | None = None
    title: str | None = None
    scale: str = "linear"


@dataclass(frozen=True)
class Scale:
    """
    How much is run.

    :param source: "embedded", "twin", or "d4rl" (D4RL's file where it is present, else the twin)
    :param updates: gradient steps
    :param eval_freq: gradient steps between two evaluations
    :param episodes: of each evaluation
    :param seeds: number of seeds, 0 upwards
    :param set: constructor arguments of all agents that have them
    :param set_for: constructor arguments by agent
    """

    source: str
    updates: int
    eval_freq: int
    episodes: int
    seeds: int
    set: dict[str, Any] = field(default_factory=dict)
    set_for: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """
    One item of the paper.

    :param id: name on the command line
    :param title: heading
    :param items: labels in the list of what is reproduced (E1 to E27, docs/reproduce.md)
    :param report: "table", "run-times", "figure", "bounds", "diagnosis" or "configuration"
    :param datasets: rows, in the paper's order
    :param variants: columns or lines
    :param panels: pictures
    :param scales: by name
    """

    id: str
    title: str
    items: tuple[str, ...]
    report: str
    datasets: tuple[GridDataset, ...]
    variants: tuple[Variant, ...]
    panels: tuple[Panel, ...]
    scales: dict[str, Scale]

    def dataset(self, paper: str) -> GridDataset:
        """
        Entry of the grid for a set of the paper; a twin's id or an alias does not find it.

        :param paper: D4RL id
        :return: the entry
        :raises StopIteration: for an id that the grid does not have
        """
        return next(d for d in self.datasets if d.paper == paper)

    def variant(self, name: str) -> Variant:
        """
        Entry of the grid for a column of the table or a line of the figure.

        :param name: heading
        :return: the entry
        :raises StopIteration: for a heading that the grid does not have
        """
        return next(v for v in self.variants if v.name == name)


@dataclass(frozen=True)
class PlannedRun:
    """
    A run of a grid.

    :param experiment: id of the experiment
    :param variant: name of the variant
    :param row: the paper's dataset whose place it has
    :param spec: what is run
    :param config: hash of its configuration
    :param needs: folder of the run whose last policy it needs
    """

    experiment: str
    variant: str
    row: str
    spec: RunSpec
    config: str
    needs: str | None = None

    @property
    def key(self) -> tuple[str, str, str, int, int]:
        """Dataset, agent, configuration, length and seed, as in the rows: what makes two planned runs the same run."""
        return self.spec.dataset, self.spec.algo, self.config, self.spec.n_updates, self.spec.seed


def experiment_ids() -> list[str]:
    """
    Names of all experiments that have a grid, in the order of the page of results.

    :return: names; those that the order does not have come last, by their letters
    """
    order = ["table1", "table-adroit-kitchen", "run-times", "fig-tau", "fig-beta", "fig-ood", "fig-alpha", "fig-cql-q"]
    order += ["fig-cql-return", "fig-sac", "fig-alpha-return", "bounds", "config-tables", "why-dce-loses"]
    names = {e.name.removesuffix(".yml") for e in _grids().iterdir() if e.name.endswith(".yml")} - {"scales"}
    return sorted(names, key=lambda name: (order.index(name) if name in order else len(order), name))


def load_experiment(experiment_id: str) -> Experiment:
    """
    Experiment as its grid describes it; a scale has the common values where the grid gives none of its own.

    :param experiment_id: name on the command line
    :return: the experiment, with all three scales
    :raises ConfigError: for an unknown name
    """
    known = experiment_ids()
    if experiment_id not in known:
        hint = f"{did_you_mean(experiment_id, known)}Known: {', '.join(known)}."
        raise ConfigError(f"no experiment {experiment_id!r}", key="id", hint=hint)
    grid = _read(f"{experiment_id}.yml")
    defaults = _read("scales.yml")
    changes = grid.get("scales", {})
    return Experiment(
        id=experiment_id,
        title=grid["title"],
        items=tuple(grid["items"]),
        report=grid["report"],
        datasets=tuple(GridDataset(**d) for d in grid.get("datasets", ())),
        variants=tuple(Variant(**_tuples(v)) for v in grid.get("variants", ())),
        panels=tuple(Panel(**_tuples(p)) for p in grid.get("panels", ())),
        scales={name: Scale(**{**defaults[name], **changes.get(name, {})}) for name in SCALES},
    )


def expand(
    experiment: Experiment,
    scale: Scale,
    root: Path,
    datasets: Sequence[str] | None = None,
    seeds: Iterable[int] | None = None,
) -> list[PlannedRun]:
    """
    All runs of an experiment, dataset by dataset and seed by seed.

    :param experiment: what is made
    :param scale: how much of it
    :param root: folder below which the runs have their folders
    :param datasets: only these of its datasets, by any of their ids; ``None`` for all
    :param seeds: instead of those of the scale
    :return: runs, which say themselves whether they need another; a dataset for which there can be no data (Kitchen without
        D4RL's files) has none
    :raises ConfigError: if one of ``datasets`` is not in the grid
    :raises DatasetNotFoundError: if a file is missing; the message names the commands that get or make it
    """
    chosen = _chosen(experiment, datasets)
    numbers = range(scale.seeds) if seeds is None else list(seeds)
    if scale.source == "embedded":
        chosen = chosen[:1]
    planned = []
    for dataset in chosen:
        file_id = _file_of(dataset, scale.source, asked_for=datasets is not None)
        if file_id is None:
            continue
        for seed in numbers:  # all agents of a seed before the next: what is interrupted is a smaller table
            for variant in experiment.variants:
                if variant.datasets is not None and dataset.paper not in variant.datasets:
                    continue
                spec = _spec(variant, file_id, seed, scale, root)
                needs = None
                if variant.best_policy_of is not None:
                    needs = _spec(experiment.variant(variant.best_policy_of), file_id, seed, scale, root).folder
                config = variant_hash(variant, file_id, scale)
                planned.append(PlannedRun(experiment.id, variant.name, dataset.paper, spec, config, needs))
    return planned


def variant_hash(variant: Variant, dataset_id: str, scale: Scale | None = None) -> str:
    """
    Hash of the settings that a variant has on these data, by which its runs are found among the rows.

    :param variant: of a grid
    :param dataset_id: data it is run on
    :param scale: adds its own arguments
    :return: 12 hexadecimal digits, as in the column ``config_hash``
    """
    return config_hash(variant.algo, settings_in_force(variant, dataset_id, scale))


def settings_in_force(variant: Variant, dataset_id: str, scale: Scale | None = None) -> dict[str, Any]:
    """
    Settings with which a variant's agent is made: defaults, over these the dataset's row, the scale's, and last its own.

    :param variant: of a grid
    :param dataset_id: data it is run on
    :param scale: adds its own arguments
    :return: every argument of the agent's constructor
    """
    return configuration.settings_in_force(variant.algo, dataset_id, _overrides(variant, scale))


# Parameters of the schedule of beta.
_SCHEDULE = ("beta", "beta_final", "beta_rate", "beta_update_every", "steps_per_epoch")


def agent_key(algo: str, settings: Mapping[str, Any], n_updates: int) -> str:
    """
    What an agent is over a number of updates: two schedules of beta that part later make one agent until then.

    :param algo: name of the agent
    :param settings: every argument of its constructor
    :param n_updates: gradient steps
    :return: the same text for the same agent
    """
    if not settings.keys() >= set(_SCHEDULE):
        return config_hash(algo, dict(settings))
    others = {key: value for key, value in settings.items() if key not in _SCHEDULE}
    changes = [(at, float(by)) for at, by in StepSchedule.of(settings).changes(n_updates)]  # 8 and 8.0 are one number
    return f"{config_hash(algo, others)} {changes}"


def source_of(dataset_id: str) -> str:
    """
    Whose data these are: rows of D4RL's and of our own never enter one total.

    :param dataset_id: id of the catalogue
    :return: "D4RL" or "sb3" (made with this package)
    """
    return "sb3" if resolve(dataset_id).generated else "D4RL"


def _overrides(variant: Variant, scale: Scale | None) -> dict[str, Any]:
    if scale is None:
        return dict(variant.set)
    known = inspect.signature(agent_class(variant.algo)).parameters
    common = {key: value for key, value in scale.set.items() if key in known}
    return {**common, **scale.set_for.get(variant.algo, {}), **variant.set}


def _spec(variant: Variant, dataset_id: str, seed: int, scale: Scale, root: Path) -> RunSpec:
    overrides = json.loads(differences(variant.algo, dataset_id, _overrides(variant, scale)))
    digest = variant_hash(variant, dataset_id, scale)
    name = f"{variant.algo}--{digest}--{scale.updates}x{scale.eval_freq}x{scale.episodes}"
    folder = root / f"{dataset_id}--{name}--seed_{seed}"
    label = f"{variant.algo} {digest[:4]} {dataset_id} seed {seed}"
    n, every = scale.updates, scale.eval_freq
    return RunSpec(variant.algo, dataset_id, seed, n, str(folder), every, scale.episodes, overrides, label)


def _chosen(experiment: Experiment, datasets: Sequence[str] | None) -> list[GridDataset]:
    if datasets is None:
        return list(experiment.datasets)
    by_id = {name: d for d in experiment.datasets for name in d.ids}
    wanted = []
    for name in datasets:
        try:
            wanted.append(resolve(name).id)  # no path: the file of that id in the known folders would be taken, not this one
        except DatasetError:
            wanted.append(name)
        if wanted[-1] not in by_id:
            hint = f"It has {', '.join(by_id)}; present, by itself, takes those that are here. A file is named by its id and "
            hint += f"found in the folders of ${DATASETS_VARIABLE}."
            raise ConfigError(f"{experiment.id} has no dataset {wanted[-1]!r}", key="--datasets", hint=hint)
    return [d for d in experiment.datasets if any(by_id[name] is d for name in wanted)]


def planned_id(dataset: GridDataset, source: str) -> str:
    """
    Id of the data that a scale takes for a dataset, whether there are results or not.

    :param dataset: of the grid
    :param source: of a scale
    :return: of the data that may stand for it the first whose file is here; the first of all if none is
    """
    names = _ids_for(dataset, source)
    return next((name for name in names if search(resolve(name)) is not None), names[0])


def _ids_for(dataset: GridDataset, source: str) -> tuple[str, ...]:
    """Ids of the data that a scale lets stand for a dataset, the first choice first."""
    if source == "embedded":
        return (EMBEDDED,)
    return dataset.ids if source == "d4rl" else dataset.ids[-1:]  # D4RL's own, too, where there is no twin to prefer


def _file_of(dataset: GridDataset, source: str, asked_for: bool) -> str | None:
    """Id of the data that stand for a dataset, None where none can be had without D4RL's file."""
    file_id = planned_id(dataset, source)
    if search(resolve(file_id)) is not None:
        return file_id
    if dataset.twin is None and not asked_for:
        return None
    names = _ids_for(dataset, source)
    what = "the file is not here"
    if dataset.twin is None:
        what += ", and no data of our own stand for it"
    elif len(names) > 1:
        what += f", nor is that of its twin {dataset.twin}"
    commands = [f"sb3-dce datasets {'generate' if resolve(name).generated else 'download'} {name}" for name in names]
    raise DatasetNotFoundError(
        what,
        where=f"dataset {file_id}",
        key=file_id,
        hint=f"Run: {', or '.join(commands)} - or take those that are here with --datasets, or all of them with "
        "--datasets present",
    )


def present_datasets(experiment: Experiment, scale: Scale) -> list[str]:
    """
    Datasets of the grid that can be run here without another file, which is what ``--datasets present`` takes.

    :param experiment: with its datasets
    :param scale: decides which file is looked for
    :return: the paper's ids of those whose data are on this machine, also where a twin stands for them
    """
    found = []
    for dataset in experiment.datasets:
        try:
            file_id = _file_of(dataset, scale.source, asked_for=False)
        except DatasetNotFoundError:
            continue
        if file_id is not None:
            found.append(dataset.paper)
    return found


def _tuples(entry: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()}


def _grids() -> Any:
    return resources.files("sb3_dce.experiments") / "grids"


@cache
def _read(name: str) -> dict[str, Any]:
    return yaml.safe_load((_grids() / name).read_text(encoding="utf-8"))
