"""
Recipes of the ``-sb3`` datasets: which policy, how many rows, which seeds.

A policy or replay buffer is taken from a given file, else from a folder in which files have known names, else (gym sets) SAC
is trained here after D4RL's procedure.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sb3_dce.data.catalog import DatasetSpec, all_specs, resolve
from sb3_dce.data.hashes import file_sha256
from sb3_dce.data.hdf5 import D4RLFile, write_hdf5
from sb3_dce.data.layout import CORE_KEYS
from sb3_dce.data.locate import cache_folder, search_folders
from sb3_dce.data.transitions import Transitions
from sb3_dce.errors import ConfigError, DatasetError, DatasetNotFoundError
from sb3_dce.files import expanded
from sb3_dce.recording.episodes import Arrays, RecordingSpec
from sb3_dce.recording.recorder import Recorded, check_target, describe, record, score_of

POLICIES_VARIABLE = "SB3_DCE_POLICIES"

# Mean returns of D4RL's medium sets. D4RL's text has a third of the expert's return, but its sets are above that.
MEDIUM_TARGETS = {"halfcheetah": 4773.0, "hopper": 1422.0, "walker2d": 2852.0}

# File names looked for, by dataset id.
_POLICY_FILES = {
    "halfcheetah-medium-sb3": "sac-HalfCheetah-90k.npz",
    "halfcheetah-expert-sb3": "tqc-HalfCheetah.npz",
    "hopper-medium-sb3": "sac-Hopper.npz",
    "hopper-expert-sb3": "tqc-Hopper.npz",
    "walker2d-medium-sb3": "sac-Walker2d-260k.npz",
    "walker2d-expert-sb3": "sac-Walker2d.npz",
}
_BUFFER_FILES = {"door-human-replayed-sb3": "door-human_replayed_d4rl-layout.hdf5"}

# Public files that do not say themselves where they come from, by their SHA-256.
_HAND_DAPG = "aravindr93/hand_dapg@9a1de23df6574e1b94e1da742e3326eb1f61c013:dapg"
_SAC = "replay buffer of SAC (SBX 0.28.0, 16 updates after every 16 steps, seed 0), a run made for this project"
_ORIGINS = {
    "6a6cfffb2e5ff6b681e505d7110d43a356097737bd881f49dd235406572bf2a5": (f"{_HAND_DAPG}/policies/pen-v0.pickle", "Apache-2.0"),
    "4139c55e945aac10e54fa16ddfdb15ad75e6bab06007cd6cc13428c1ef613cb4": (
        f"{_HAND_DAPG}/policies/hammer-v0.pickle",
        "Apache-2.0",
    ),
    "4c32070298abde99564c5c1594fb4c7878792341f1d47e7033106581e278f54d": (
        f"{_HAND_DAPG}/policies/door-v0.pickle",
        "Apache-2.0",
    ),
    "3d8a8dc953317875f9cb84402407ce89a1437ce3666ff1d11c6d91f51adb1a6e": (
        f"{_HAND_DAPG}/policies/relocate-v0.pickle",
        "Apache-2.0",
    ),
    "9895ac44e7220718b64b37e9634de098e046ab1839af51675d69c1939547c084": (
        f"human demonstrations of {_HAND_DAPG}/demonstrations/door-v0_demos.pickle, replayed in AdroitHandDoor-v1",
        "Apache-2.0",
    ),
    "a597b6980026ff53a28dcef69ac3c52492bb34b266f40319a38a2416375de05a": (f"{_SAC}; stopped at a return of 4857", "MIT"),
    "b56cc512a8658318190ed4d70c11d5b05a1b23c88dabe0b7c3116576d38fc9bc": (f"{_SAC}; stopped at a return of 3508", "MIT"),
    "771371455dca39b1f134d8f84adca4c08ec58add92e2b669b5f17ea48e42b318": (
        f"{_SAC}; stopped at 402,000 steps with a return of 732, below medium (1422)",
        "MIT",
    ),
}

# Every kind of data has seeds of its own, so that two sets of one environment do not start in the same states.
_SEED_STEP = 100_000_000
_KINDS = ("random", "medium", "expert", "noisyexpert25")

Note = Callable[[str], None]
LabelledProgress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Recipe:
    """
    How a dataset is made.

    :param dataset: its catalogue entry
    :param source: ``random`` actions, a ``policy``, a ``buffer`` that was recorded elsewhere, or ``parts`` joined
    :param rows: default number of rows, ``None`` for all there are
    :param episodes: whole episodes instead of rows
    :param file: name under which the policy or buffer is looked for
    """

    dataset: DatasetSpec
    source: Literal["random", "policy", "buffer", "parts"]
    rows: int | None = None
    episodes: int | None = None
    file: str | None = None

    @property
    def task(self) -> str:
        """First part of the dataset's id, such as ``hopper``, by which SAC runs and their folders are named."""
        return self.dataset.id.partition("-")[0]

    @property
    def kind(self) -> str:
        """The dataset's id without task and ``-sb3``, such as ``medium-replay``; the seeds follow from it."""
        return self.dataset.id.partition("-")[2].removesuffix("-sb3")


@dataclass(frozen=True)
class Sources:
    """
    Where policies and buffers come from.

    :param policy: file of the policy, for sets made by one
    :param buffer: HDF5 file in D4RL's layout, for replay and human sets
    :param policies: folder in which files have known names; ``None`` for the folders in ``$SB3_DCE_POLICIES``
    :param algo: algorithm of ``policy``, if it is a zip file
    :param vecnormalize: statistics of ``policy``, if it is a zip file
    """

    policy: Path | None = None
    buffer: Path | None = None
    policies: Path | None = None
    algo: str | None = None
    vecnormalize: str | None = None


@dataclass(frozen=True)
class Training:
    """
    How a missing policy is trained.

    :param target: mean return at which SAC is "medium"; ``None`` for D4RL's level
    :param settings: fields of :class:`~sb3_dce.recording.sac_run.SACSettings`
    """

    target: float | None = None
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Job:
    """One call of :func:`generate`; parameters are described there."""

    recipe: Recipe
    folder: Path
    sources: Sources
    training: Training
    rows: int | None
    seed: int
    workers: int
    force: bool
    progress: LabelledProgress
    note: Note

    @property
    def out(self) -> Path:
        return self.folder / self.recipe.dataset.file_name

    @property
    def n_rows(self) -> int | None:
        return self.recipe.rows if self.rows is None else self.rows

    @property
    def base_seed(self) -> int:
        kind = _KINDS.index(self.recipe.kind) + 1
        return _SEED_STEP * (kind + 10 * self.seed)


def recipes() -> dict[str, Recipe]:
    """Id to recipe of every dataset that can be generated; those whose files come with the package have none."""
    return {spec.id: _recipe(spec) for spec in all_specs() if spec.generated and not spec.embedded}


def generate(
    dataset: str,
    folder: Path | None = None,
    sources: Sources | None = None,
    training: Training | None = None,
    rows: int | None = None,
    seed: int = 0,
    workers: int = 1,
    force: bool = False,
    progress: LabelledProgress = lambda label, done, total: None,
    note: Note = lambda text: None,
) -> Recorded:
    """
    Make one of the ``-sb3`` datasets and write it where ``load_dataset`` finds it.

    Interrupted, it keeps what it has; the same call goes on.

    :param dataset: id, see :func:`recipes`
    :param folder: where it is written; default: the first folder in which data are looked for
    :param sources: policies and buffers there are
    :param training: how SAC is trained where there are none
    :param rows: rows to make, default D4RL's number; of a buffer, the first rows, default all
    :param seed: makes other data of the same kind
    :param workers: processes that record
    :param force: replace an existing file
    :param progress: called with what is being done, how much of it there is and how much there will be
    :param note: called with lines for people
    :return: what was written
    :raises ConfigError: if the id is unknown or a parameter does not belong to it
    :raises DatasetNotFoundError: if a policy or buffer is missing and cannot be trained here
    :raises DatasetError: if a buffer or part has fewer rows than are wanted
    """
    recipe = _find_recipe(dataset)
    fewest = 2 if recipe.source == "parts" else 1
    if rows is not None and rows < fewest:
        hint = f"For example --rows {recipe.rows or 1_000_000}."
        raise ConfigError(f"rows of {recipe.dataset.id} must be at least {fewest}, got {rows}", key="rows", hint=hint)
    sources = sources or Sources()
    for name, value, fitting in (("policy", sources.policy, "policy"), ("buffer", sources.buffer, "buffer")):
        if value is not None and recipe.source != fitting:
            raise ConfigError(
                f"{recipe.dataset.id} is not made from a {name}",
                key=name,
                hint=_SOURCE_HINTS[recipe.source].format(task=recipe.task),
            )
    where = folder or (search_folders() or [cache_folder()])[0]
    job = _Job(recipe, where, sources, training or Training(), rows, seed, workers, force, progress, note)
    check_target(job.out, recipe.dataset.id, recipe.dataset.id, force)
    return {"random": _from_policy, "policy": _from_policy, "buffer": _from_buffer, "parts": _from_parts}[recipe.source](job)


_SOURCE_HINTS = {
    "random": "Leave it out: the actions are random.",
    "policy": "Give --policy, or --policies with the folder of the policies.",
    "buffer": "Give --buffer, an HDF5 file in D4RL's layout.",
    "parts": "Make {task}-medium-sb3 and {task}-expert-sb3 first, each from its own policy; then this one joins them.",
}


def _find_recipe(dataset: str) -> Recipe:
    known = recipes()
    spec = resolve(dataset)
    if spec.id in known:
        return known[spec.id]
    twin = f"{spec.id.rpartition('-')[0]}-sb3"
    wanted = f"Did you mean {twin}? " if twin in known else ""
    raise ConfigError(
        f"{spec.id} is {'a file of the package' if spec.embedded else 'an official D4RL dataset'} and cannot be generated",
        key="dataset",
        hint=f"{wanted}There are recipes for {', '.join(known)}.",
    )


def _recipe(spec: DatasetSpec) -> Recipe:
    task, _, rest = spec.id.partition("-")
    kind = rest.removesuffix("-sb3")
    if kind == "random":
        return Recipe(spec, "random", rows=1_000_000)
    if kind == "medium-expert":
        return Recipe(spec, "parts", rows=2_000_000)
    if kind == "noisyexpert25":
        return Recipe(spec, "policy", episodes=25, file=f"{task}-v0.npz")
    if kind in ("medium", "expert"):
        # D4RL's expert sets of Adroit have 5000 episodes' worth of rows
        rows = 1_000_000 if spec.family == "gym" else 5000 * spec.max_episode_steps
        return Recipe(spec, "policy", rows=rows, file=_POLICY_FILES.get(spec.id, f"{task}-v0.npz"))
    return Recipe(spec, "buffer", file=_BUFFER_FILES.get(spec.id, spec.file_name))


def _from_policy(job: _Job) -> Recorded:
    recipe, sources = job.recipe, job.sources
    policy = "random"
    extra: dict[str, Any] = {}
    if recipe.source == "policy":
        path = sources.policy or _search(job) or _train(job)
        policy, extra = str(path), _origin(path)
    spec = RecordingSpec(policy, recipe.dataset.id, job.base_seed, algo=sources.algo, vecnormalize=sources.vecnormalize)
    return record(
        spec,
        job.out,
        n_rows=job.n_rows,
        n_episodes=recipe.episodes if job.n_rows is None else None,
        name=recipe.dataset.id,
        workers=job.workers,
        force=job.force,
        progress=lambda done, total: job.progress(f"recording {recipe.dataset.id}", done, total),
        extra=extra,
    )


def _from_buffer(job: _Job) -> Recorded:
    """Write a recorded buffer anew, with the attributes of generated data."""
    started = time.monotonic()
    path = job.sources.buffer or _search(job)
    if path is not None:
        Transitions.from_hdf5(path, spec=job.recipe.dataset)  # its checks
        arrays, extra = _read(path), {"behaviour_policy": "not recorded", **_origin(path)}
        extra["behaviour_file"] = path.name
        if "behaviour_source" in extra:
            extra["behaviour_policy"] = extra.pop("behaviour_source")
    else:
        run = _sac_run(job)
        path, arrays = run.folder, run.replay()
        extra = {
            "behaviour_policy": f"replay buffer of SAC up to a mean return of {run.target:g}, reached after "
            f"{len(arrays['rewards']):,} steps; seed {job.seed}",
            "behaviour_source": "sb3-dce datasets generate",
        }
    arrays = _first_rows(arrays, job.n_rows, path, "Ask for fewer --rows, or leave it out for all.")
    return _write(job, arrays, extra, started)


def _from_parts(job: _Job) -> Recorded:
    """D4RL's medium-expert: the expert part, cut at its last whole episode, then the medium part."""
    started = time.monotonic()
    assert job.n_rows is not None
    half = job.n_rows // 2
    parts, extra = [], {}
    for kind in ("expert", "medium"):
        path = _part(job, kind, half)
        with D4RLFile(path) as file:
            attrs = file.attributes()
        arrays = _read(path)
        hint = f"Make it longer with --rows, or ask for --rows {2 * len(arrays['rewards'])} here."
        arrays = _first_rows(arrays, half, path, hint)
        if kind == "expert":
            ends = np.flatnonzero(arrays["terminals"] | arrays["timeouts"])
            if not len(ends):
                raise DatasetError("no episode ends in it", where=str(path), path=path, hint="Ask for more --rows.")
            arrays = {key: array[: ends[-1] + 1] for key, array in arrays.items()}
        parts.append(arrays)
        for name in ("behaviour_policy", "behaviour_sha256", "behaviour_source", "behaviour_licence", "seed"):
            if name in attrs:
                extra[f"{kind}_{name}"] = attrs[name]
        extra[f"{kind}_rows"], extra[f"{kind}_content_hash"] = (
            len(arrays["rewards"]),
            attrs.get("content_hash", "not recorded"),
        )
    policies = [extra.get(f"{kind}_behaviour_policy", "not recorded") for kind in ("expert", "medium")]
    extra["behaviour_policy"] = f"first {policies[0]}, then {policies[1]}"
    keys = [key for key in parts[0] if key in parts[1]]
    return _write(job, {key: np.concatenate([part[key] for part in parts]) for key in keys}, extra, started)


def _first_rows(arrays: Arrays, n: int | None, path: Path, hint: str) -> Arrays:
    there = len(arrays["rewards"])
    if n is not None and there < n:
        raise DatasetError(f"has {there:,} rows, {n:,} are wanted", where=str(path), path=path, hint=hint)
    return {key: array[:n] for key, array in arrays.items()}


def _part(job: _Job, kind: str, rows: int) -> Path:
    part = _find_recipe(f"{job.recipe.task}-{kind}-sb3")
    path = job.folder / part.dataset.file_name
    if path.is_file():
        job.note(f"{kind} part: {path}")
        return path
    return _from_policy(replace(job, recipe=part, rows=rows)).path


def _write(job: _Job, arrays: Arrays, extra: dict[str, Any], started: float) -> Recorded:
    dataset_id = job.recipe.dataset.id
    attrs = {**describe(dataset_id, dataset_id, arrays), **extra}
    job.progress(f"writing {dataset_id}", 0, len(arrays["rewards"]))
    write_hdf5(job.out, arrays, attrs)
    job.progress(f"writing {dataset_id}", len(arrays["rewards"]), len(arrays["rewards"]))
    return Recorded(job.out, attrs, time.monotonic() - started, 0, score_of(dataset_id, attrs))


def _read(path: Path) -> Arrays:
    with D4RLFile(path) as file:
        return {key: array[slice(None)] for key, array in file.select(CORE_KEYS).items()}


def _origin(path: Path) -> dict[str, Any]:
    """What is known about a file from its bytes; what an NPZ policy says about itself is added when it is recorded."""
    digest = file_sha256(path)
    if digest not in _ORIGINS:
        return {"behaviour_sha256": digest}
    source, licence = _ORIGINS[digest]
    return {"behaviour_sha256": digest, "behaviour_source": source, "behaviour_licence": licence}


def _search(job: _Job) -> Path | None:
    """
    The file with the known name, in the given folder or those of ``$SB3_DCE_POLICIES``, or in one of their folders.

    :raises DatasetNotFoundError: if a folder was given and lacks it, or nothing else can be done
    """
    named = job.sources.policies
    folders = [named] if named else [expanded(f) for f in os.environ.get(POLICIES_VARIABLE, "").split(os.pathsep) if f]
    name = job.recipe.file
    assert name is not None
    for folder in folders:
        for found in (folder / name, *sorted(folder.glob(f"*/{name}"))):
            if found.is_file():
                job.note(f"{job.recipe.dataset.id} from {found}")
                return found
    trainable = job.recipe.task in MEDIUM_TARGETS and job.recipe.dataset.id.removesuffix("-sb3").endswith(
        ("-medium", "-expert", "-medium-replay")
    )
    if trainable and named is None:
        return None
    what = "Leave --policies out to train SAC here, which takes hours, or" if trainable else "Please"
    raise DatasetNotFoundError(
        f"{name} not found; searched {', '.join(map(str, folders)) or 'nowhere'}",
        where=f"recipe of {job.recipe.dataset.id}",
        hint=f"{what} give the {job.recipe.source} itself (--{job.recipe.source}), or the folder it is in (--policies, or "
        f"${POLICIES_VARIABLE}).",
        key=job.recipe.dataset.id,
    )


def _train(job: _Job) -> Path:
    run = _sac_run(job)
    return run.medium() if job.recipe.kind == "medium" else run.expert()


def _sac_run(job: _Job) -> Any:
    from sb3_dce.recording.sac_run import SACRun, SACSettings

    task = job.recipe.task
    # named by the task: the medium, replay and expert sets are stages of one run
    folder = job.folder / "training" / f"{task}-sac-seed{job.seed}"
    target = MEDIUM_TARGETS[task] if job.training.target is None else job.training.target
    job.note(f"no {job.recipe.source} given or found: that of the SAC run in {folder}")
    return SACRun(
        f"{task}-medium-sb3",
        target,
        job.seed,
        folder,
        SACSettings(**job.training.settings),
        progress=lambda done, total: job.progress(f"training SAC for {task}", done, total),
        note=job.note,
    )
