"""Carrying out the runs of a grid: processes on a CPU, populations on a GPU, or the nodes of a Ray cluster."""

from __future__ import annotations

import gc
import hashlib
import traceback
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch as th
from rich.console import Console
from stable_baselines3.common.utils import get_device

from sb3_dce.agents import agent_class
from sb3_dce.configuration import row_of
from sb3_dce.data.catalog import resolve
from sb3_dce.errors import DivergenceError, SB3DCEError
from sb3_dce.experiments.grid import PlannedRun
from sb3_dce.experiments.probe import prepare_probe
from sb3_dce.launch import launch_all
from sb3_dce.population import free_parameters
from sb3_dce.population_runs import members_to_go_on, train_population
from sb3_dce.run_files import RunSpec, read_divergence, read_result

# More members than this are trained one population after the other. The second table is for agents that evaluate
# their critics on many rows per sample: 10 x 100 of UWAC, 20 of PBRL's ten critics, 30 of CQL.
MAX_MEMBERS = 64
MAX_MEMBERS_OF = {"offline_uwac": 5, "offline_pbrl": 15, "offline_cql": 30}

# Beside the folders of the members; a name for each population.
STATE_FILES = "population-{}.pt"


def execute(
    planned: Sequence[PlannedRun],
    done: set[tuple[Any, ...]],
    workers: int,
    device: th.device | str,
    ray_address: str | None,
    console: Console,
) -> tuple[list[str], list[BaseException]]:
    """
    Train what is not complete, each run once, those first that others need.

    :param planned: runs of grids
    :param done: keys of runs whose rows are known; they are not trained
    :param workers: processes on a CPU
    :param device: "cpu", "cuda" or "auto"; on "cuda" runs that differ in data, seed or numbers are one batched computation
    :param ray_address: of a Ray cluster that trains instead of this machine
    :param console: where progress is shown
    :return: for each run that diverged, what happened; other errors
    """
    wanted = {run.spec.folder: run for run in planned if run.key not in done and not is_complete(run.spec)}
    needed = {run.needs for run in wanted.values() if run.needs is not None}
    # rows may be known without a model: the probe needs that
    wanted.update({run.spec.folder: run for run in planned if run.spec.folder in needed and not is_complete(run.spec)})
    first = [run.spec for run in wanted.values() if run.needs is None]
    after = [(run.spec, Path(run.needs)) for run in wanted.values() if run.needs is not None]
    device = get_device(device)
    everything = [run.spec for run in planned if run.needs is None]
    failures = _run_all(first, everything, workers, device, ray_address, console)
    without = [best_policy for _, best_policy in after if read_divergence(best_policy) is not None]
    hint = "Take another --first-seed, or leave the probe out with --agents DCE."
    failures += [
        DivergenceError(f"the probe needs the last policy of {path.name}, which diverged", hint=hint) for path in without
    ]
    # where the run that is needed has failed otherwise, its own error says why
    prepared = []
    for spec, best_policy in after:
        if best_policy not in without and read_result(best_policy) is not None:
            try:
                prepare_probe(spec, best_policy)
                prepared.append(spec)
            except SB3DCEError as error:
                failures.append(error)
    # A probe begins from a file on this machine, and is one model with five sets of critics: never batched.
    failures += _run_all(prepared, prepared, workers, th.device("cpu"), None, console)
    diverged = [str(error) for error in failures if isinstance(error, DivergenceError)]
    return diverged, [error for error in failures if not isinstance(error, DivergenceError)]


def is_complete(spec: RunSpec) -> bool:
    """
    Whether there is nothing left to train; a run that has diverged is complete, since it would do so again.

    :param spec: of a run
    :return: true only for a result of the length that is asked for, or a divergence
    """
    folder = Path(spec.folder)
    result = read_result(folder)
    return read_divergence(folder) is not None or (result is not None and result["n_updates"] == spec.n_updates)


def _run_all(
    specs: list[RunSpec],
    planned: list[RunSpec],
    workers: int,
    device: th.device,
    ray_address: str | None,
    console: Console,
) -> list[BaseException]:
    """``specs`` of those ``planned`` are to be trained; an interrupted population has members of which this is not asked."""
    if not specs:
        return []
    if ray_address is not None:
        from sb3_dce.experiments.cluster import run_on_cluster

        return run_on_cluster(specs, ray_address, console)
    if device.type == "cpu":
        here = [replace(spec, device="cpu") for spec in specs]
        return [outcome for outcome in launch_all(here, workers, console) if isinstance(outcome, BaseException)]
    begun = begun_populations(specs, planned)
    taken = {spec.folder for group in begun for spec in group}
    rest = [spec for spec in specs if spec.folder not in taken]
    begun_alone = [spec for spec in rest if (Path(spec.folder) / "checkpoint.zip").is_file()]  # and so they go on
    groups = [*begun, *([spec] for spec in begun_alone), *populations(spec for spec in rest if spec not in begun_alone)]
    alone = [replace(group[0], device=str(device)) for group in groups if len(group) == 1]
    failures = [outcome for outcome in launch_all(alone, 1, console) if isinstance(outcome, BaseException)]
    for group in (group for group in groups if len(group) > 1):
        try:
            _train_group(group, device, console)
        except DivergenceError as error:
            # its traceback would keep the whole population on the device while the next ones are trained
            failures.append(error.with_traceback(None))
        except Exception as error:
            traceback.clear_frames(error.__traceback__)  # they hold the population, too
            failures.append(error)
        # a population refers to itself: it would stay on the device until a collection that comes by chance
        gc.collect()
        th.cuda.empty_cache()
    return failures


def begun_populations(specs: Sequence[RunSpec], planned: Sequence[RunSpec]) -> list[list[RunSpec]]:
    """
    Populations that were interrupted, as they were. One that was killed while it wrote its results has members that are
    complete; without these the others would be another population and begin anew. So they would if a plan has grown.

    :param specs: runs to train
    :param planned: these and those that are complete
    :return: members of each population that was to train some of ``specs`` and no run that is not planned
    """
    wanted, by_folder = {spec.folder for spec in specs}, {spec.folder: spec for spec in planned}
    groups = []
    for common in sorted({Path(folder).parent for folder in wanted}):
        for path in sorted(common.glob(STATE_FILES.format("*"))):
            folders = [str(folder) for folder in members_to_go_on(path)]
            if wanted.intersection(folders) and by_folder.keys() >= set(folders):
                groups.append([by_folder[folder] for folder in folders])
                wanted -= set(folders)
    return groups


def populations(specs: Iterable[RunSpec]) -> list[list[RunSpec]]:
    """
    Groups of runs that differ in nothing but data, seed and free parameters, cut where one would be too large.

    :param specs: runs
    :return: groups that can be trained as one population each; one of a single run is trained alone
    """
    groups: dict[Any, list[RunSpec]] = {}
    for spec in specs:
        cls, data = agent_class(spec.algo), resolve(spec.dataset)
        free = free_parameters(cls)
        settings = {**row_of(spec.algo, data.id), **spec.overrides}
        fixed = {k: v for k, v in settings.items() if k not in free}
        shape = (data.obs_dim, data.act_dim)
        key = (spec.algo, shape, repr(sorted(fixed.items())), spec.n_updates, spec.eval_freq, spec.n_eval_episodes)
        groups.setdefault(key, []).append(spec)
    cut = []
    for group in groups.values():
        size = MAX_MEMBERS_OF.get(group[0].algo, MAX_MEMBERS)
        cut += [group[i : i + size] for i in range(0, len(group), size)]
    return cut


def population_file(group: Sequence[RunSpec]) -> str:
    """
    Name of a population's state file, by a hash of its members' folders: the same in whatever order they come.

    :param group: members of a population
    :return: file name, to go beside the folders of the members
    """
    names = sorted(Path(spec.folder).name for spec in group)
    return STATE_FILES.format(hashlib.sha256(" ".join(names).encode()).hexdigest()[:12])


def _train_group(group: list[RunSpec], device: th.device, console: Console) -> None:
    train_population(group, device=device, console=console, state_file=population_file(group))
