"""
The datasets this package knows by name: a table, without any access to files or network.

Official D4RL sets (Fu et al., 2020; host, file names, horizons and reference scores from Farama-Foundation/D4RL) keep
their D4RL ids. Data made with this package end in ``-sb3`` and never carry a D4RL id; they are scored with the constants
of the D4RL set they stand in for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import PurePath
from typing import Any, Literal

import numpy as np

from sb3_dce.checks import did_you_mean
from sb3_dce.errors import DatasetError

Family = Literal["gym", "adroit", "kitchen", "antmaze"]

D4RL_URL = "http://rail.eecs.berkeley.edu/datasets/offline_rl/"

# SHA-256 of the files that come with the package. Generated and official files are never pinned here: the bits of the
# former depend on the machine, and no hash of the latter has been published.
_EMBEDDED_SHA256 = {
    "halfcheetah-demo-sb3": "a47d8b88e9d9aba102fa4afdbac33803e9afee7275dd5ced1c13168345048808",
    "halfcheetah-tiny-sb3": "6b7598bdd4d121ac2388a6352c9d04fb40b032718d86349388bfc489436ea6a8",
}


@dataclass(frozen=True)
class DatasetSpec:
    """
    What is known about a dataset before its file is opened.

    :param id: name used everywhere, e.g. ``halfcheetah-medium-v2``
    :param family: group of environments the dataset belongs to
    :param env_id: id of the simulator in which a policy is evaluated; None where none of today's matches the data
    :param max_episode_steps: time limit of that environment, steps
    :param obs_dim: number of entries of an observation
    :param act_dim: number of entries of an action
    :param ref_min_score: return (reward units) that scores 0, D4RL's random policy
    :param ref_max_score: return (reward units) that scores 100, D4RL's expert
    :param file_name: name of the file, without folder
    :param url: where D4RL publishes the file; None for data made with this package
    :param sha256: hash of the file, only for files that come with the package
    :param paper_row: D4RL id whose hyperparameters apply: the id itself, the v0 id of an Adroit v1 set, the set a ``-sb3``
        set stands in for, and the nearest set for the expert sets, which are outside the paper; None for AntMaze
    :param generated: True for data made with this package
    :param embedded: True if the file comes with the package
    """

    id: str
    family: Family
    env_id: str | None
    max_episode_steps: int
    obs_dim: int
    act_dim: int
    ref_min_score: float
    ref_max_score: float
    file_name: str
    url: str | None
    sha256: str | None
    paper_row: str | None
    generated: bool = False
    embedded: bool = False


@dataclass(frozen=True)
class _Task:
    """The fields that all datasets of one task share; the order is that of :class:`DatasetSpec`."""

    family: Family
    env_id: str | None
    max_episode_steps: int
    obs_dim: int
    act_dim: int
    ref_min_score: float
    ref_max_score: float


_TASKS = {
    "halfcheetah": _Task("gym", "HalfCheetah-v4", 1000, 17, 6, -280.178953, 12135.0),
    "hopper": _Task("gym", "Hopper-v4", 1000, 11, 3, -20.272305, 3234.3),
    "walker2d": _Task("gym", "Walker2d-v4", 1000, 17, 6, 1.629008, 4592.3),
    "pen": _Task("adroit", "AdroitHandPen-v1", 100, 45, 24, 96.262799, 3076.8331017826877),
    "hammer": _Task("adroit", "AdroitHandHammer-v1", 200, 46, 26, -274.856578, 12794.134825156867),
    "door": _Task("adroit", "AdroitHandDoor-v1", 200, 39, 28, -56.512833, 2880.5693087298737),
    "relocate": _Task("adroit", "AdroitHandRelocate-v1", 200, 39, 30, -6.425911, 4233.877797728884),
    # The mazes of Gymnasium-Robotics have the y axis turned round and another origin than those of the data.
    "antmaze-umaze": _Task("antmaze", None, 700, 29, 8, 0.0, 1.0),
    "antmaze-medium": _Task("antmaze", None, 1000, 29, 8, 0.0, 1.0),
    "antmaze-large": _Task("antmaze", None, 1000, 29, 8, 0.0, 1.0),
    "kitchen": _Task("kitchen", "FrankaKitchen-v1", 280, 60, 9, 0.0, 4.0),
}

# Versions of D4RL in the order in which a name without version is completed (the paper's baselines use Adroit v0).
_DEFAULT_VERSIONS = ("v2", "v0", "v1")


def resolve(name: str) -> DatasetSpec:
    """
    The dataset with this name. The version may be left out and underscores may stand for hyphens:
    ``walker2d-medium`` and ``walker2d_medium-v2`` are both ``walker2d-medium-v2``, ``pen-human`` is ``pen-human-v0``.

    :param name: id or alias
    :return: entry of the table
    :raises DatasetError: if the name is unknown; the message lists the closest ones
    """
    key = name.strip().lower().replace("_", "-")
    for candidate in (key, *(f"{key}-{version}" for version in _DEFAULT_VERSIONS)):
        if candidate in _SPECS:
            return _SPECS[candidate]
    close = did_you_mean(key, _SPECS, n=4, cutoff=0.5)  # the name of a task alone, such as "hopper", is close enough
    raise DatasetError(
        f"unknown dataset {name!r}",
        hint=f"{close}All names: sb3-dce datasets list --all; a file of your own is given as a path",
        key=name,
    )


def spec_of_file(path: str | PathLike[str]) -> DatasetSpec | None:
    """
    The dataset a file claims to be by its name: an id, or D4RL's own file name.

    :param path: file, need not exist
    :return: entry of the table, or None for a file of another name
    """
    name = PurePath(path).name
    by_file_name = next((spec for spec in _SPECS.values() if spec.file_name == name), None)
    return by_file_name or _SPECS.get(PurePath(name).stem)


def is_id(name: str) -> bool:
    """
    Stricter than :func:`resolve`: a file that merely has an alias for its name is not scored as that dataset.

    :param name: any
    :return: whether it is the id of a dataset as it stands
    """
    return name in _SPECS


def all_specs() -> list[DatasetSpec]:
    """
    All datasets, in the order of the table.

    :return: entries of the table
    """
    return list(_SPECS.values())


def normalized_score(name: str, returns: Any) -> Any:
    """
    D4RL score ``100 * (R - min) / (max - min)``. D4RL's own function leaves out the factor 100.

    :param name: dataset id or alias
    :param returns: undiscounted episode return(s), reward units, a number or an array of any shape
    :return: score(s), 0 = random policy, 100 = expert; a float for a number, else an array of the same shape
    """
    spec = resolve(name)
    scores = 100.0 * (np.asarray(returns, dtype=np.float64) - spec.ref_min_score) / (spec.ref_max_score - spec.ref_min_score)
    return scores if scores.ndim else float(scores)


def _spec(dataset_id: str, task: str, **fields: Any) -> DatasetSpec:
    """Join the fields of a dataset with those of its task."""
    return DatasetSpec(id=dataset_id, **vars(_TASKS[task]), **fields)


def _official(dataset_id: str, task: str, path: str, paper_row: str | None = None) -> DatasetSpec:
    """A set published by D4RL at ``path`` below :data:`D4RL_URL`."""
    file_name = path.rpartition("/")[2]
    row = None if _TASKS[task].family == "antmaze" else paper_row or dataset_id
    return _spec(dataset_id, task, file_name=file_name, url=D4RL_URL + path, sha256=None, paper_row=row)


def _generated(dataset_id: str, paper_row: str) -> DatasetSpec:
    """A set made with this package."""
    return _spec(
        dataset_id,
        dataset_id.partition("-")[0],
        file_name=f"{dataset_id}.hdf5",
        url=None,
        sha256=_EMBEDDED_SHA256.get(dataset_id),
        paper_row=paper_row,
        generated=True,
        embedded=dataset_id in _EMBEDDED_SHA256,
    )


def _gym_specs() -> Iterator[DatasetSpec]:
    """D4RL gym v2: the twelve sets of the paper, and the expert sets."""
    for task in ("halfcheetah", "hopper", "walker2d"):
        for kind in ("random", "medium", "medium-replay", "medium-expert", "expert"):
            path = f"gym_mujoco_v2/{task}_{kind.replace('-', '_')}-v2.hdf5"
            paper_row = f"{task}-medium-expert-v2" if kind == "expert" else None
            yield _official(f"{task}-{kind}-v2", task, path, paper_row)


def _adroit_specs() -> Iterator[DatasetSpec]:
    """D4RL Adroit: v0 is the version of the paper; v0 and v1 numbers must not share a table column."""
    for task in ("pen", "hammer", "door", "relocate"):
        yield _official(f"{task}-human-v0", task, f"hand_dapg/{task}-v0_demos_clipped.hdf5")
        yield _official(f"{task}-cloned-v0", task, f"hand_dapg/{task}-demos-v0-bc-combined.hdf5")
        for kind in ("human", "cloned", "expert"):
            paper_row = f"{task}-{'cloned' if kind == 'expert' else kind}-v0"
            yield _official(f"{task}-{kind}-v1", task, f"hand_dapg_v1/{task}-{kind}-v1.hdf5", paper_row)


def _kitchen_specs() -> Iterator[DatasetSpec]:
    """D4RL Kitchen. Tasks of complete and partial: microwave, kettle, light, slide; mixed has the bottom burner for slide."""
    yield _official("kitchen-complete-v0", "kitchen", "kitchen/mini_kitchen_microwave_kettle_light_slider-v0.hdf5")
    yield _official("kitchen-partial-v0", "kitchen", "kitchen/kitchen_microwave_kettle_light_slider-v0.hdf5")
    yield _official("kitchen-mixed-v0", "kitchen", "kitchen/kitchen_microwave_kettle_bottomburner_light-v0.hdf5")


def _antmaze_specs() -> Iterator[DatasetSpec]:
    """D4RL AntMaze, outside the paper; v2 mends the timeouts of v0."""
    mazes = {"umaze": "u-maze", "medium": "big-maze", "large": "hardest-maze"}
    for version, folder, suffix in (("v2", "ant_maze_v2", "_fixed"), ("v0", "ant_maze_new", "")):
        for size, maze in mazes.items():
            for kind in ("", "-diverse") if size == "umaze" else ("-play", "-diverse"):
                starts, goals = kind != "", kind == "-diverse"
                file_name = f"Ant_maze_{maze}_noisy_multistart_{starts}_multigoal_{goals}_sparse{suffix}.hdf5"
                yield _official(f"antmaze-{size}{kind}-{version}", f"antmaze-{size}", f"{folder}/{file_name}")


def _generated_specs() -> Iterator[DatasetSpec]:
    """Sets made with this package, the two embedded ones first."""
    for dataset_id in _EMBEDDED_SHA256:
        yield _generated(dataset_id, "halfcheetah-medium-replay-v2")
    for task in ("halfcheetah", "hopper", "walker2d"):
        for kind in ("random", "medium", "medium-replay", "medium-expert"):
            yield _generated(f"{task}-{kind}-sb3", f"{task}-{kind}-v2")
        yield _generated(f"{task}-expert-sb3", f"{task}-medium-expert-v2")
    # A slow run that was stopped at D4RL's number of rows without reaching "medium".
    yield _generated("hopper-replay-402k-sb3", "hopper-medium-replay-v2")
    for task in ("pen", "hammer", "door", "relocate"):
        yield _generated(f"{task}-expert-sb3", f"{task}-cloned-v0")
        # 25 stochastic episodes of the expert, as many as there are demonstrations in the human sets.
        yield _generated(f"{task}-noisyexpert25-sb3", f"{task}-human-v0")
    # The real demonstrations of door-human with observations and rewards recomputed.
    yield _generated("door-human-replayed-sb3", "door-human-v0")


_TABLES = (_gym_specs, _adroit_specs, _kitchen_specs, _antmaze_specs, _generated_specs)
_SPECS = {spec.id: spec for specs in _TABLES for spec in specs()}
