"""A policy recorded into a dataset file, in as many processes as wished, always with the same rows."""

from __future__ import annotations

import os
import platform
import re
import shutil
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

import sb3_dce
from sb3_dce.data.catalog import normalized_score, spec_of_file
from sb3_dce.data.hashes import content_hash
from sb3_dce.data.hdf5 import write_hdf5
from sb3_dce.data.locate import known_dataset
from sb3_dce.data.records import bounds_attribute
from sb3_dce.envs import dataset_of_env
from sb3_dce.errors import ConfigError, SB3DCEError
from sb3_dce.files import check_writable
from sb3_dce.numpy_policy import NumpyPolicy
from sb3_dce.processes import end_workers, prepare_worker, starting_workers, worker_pool
from sb3_dce.recording.episodes import Arrays, EpisodeRunner, RecordingSpec
from sb3_dce.recording.parts import Parts

# Rows of one task of a worker: some tenths of a second, so that sending them costs little and the progress moves.
_TASK_ROWS = 5000
_PROGRESS_SECONDS = 0.1
_NAME = re.compile(r"[a-z0-9][a-z0-9._-]*-sb3")

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Recorded:
    """
    A dataset that has been written.

    :param path: file
    :param attrs: root attributes of the file
    :param seconds: wall time of this call, writing included
    :param new_rows: rows recorded by this call; the others were there from an interrupted one
    :param score: D4RL's normalised score of the mean return, ``None`` without whole episodes or reference values
    :param notes: what the user should know
    """

    path: Path
    attrs: dict[str, Any]
    seconds: float
    new_rows: int
    score: float | None = None
    notes: tuple[str, ...] = ()


def record(
    spec: RecordingSpec,
    out: Path,
    n_rows: int | None = None,
    n_episodes: int | None = None,
    name: str | None = None,
    workers: int = 1,
    force: bool = False,
    progress: Progress = lambda done, total: None,
    extra: Mapping[str, Any] | None = None,
) -> Recorded:
    """
    Record whole episodes in the order of their numbers, cut to exactly ``n_rows``, and write them in D4RL's layout.

    Interrupted, it keeps what it has in ``<out>.parts``; the same call goes on from there. The rows, and the file, are the
    same for any number of workers.

    :param spec: policy, environment, seeds, noise
    :param out: HDF5 file to write
    :param n_rows: rows; the last episode may be cut, it then has no flag at its end
    :param n_episodes: whole episodes, instead of ``n_rows``
    :param name: dataset id, ends in ``-sb3``; default: the file's name
    :param workers: processes; 1 uses this one
    :param force: replace an existing file, and drop an interrupted recording
    :param progress: called with the rows (or episodes) there are, and the number wanted
    :param extra: further root attributes
    :return: what was written
    :raises ConfigError: if a parameter is wrong, the file exists, or the policy does not fit the environment
    :raises CheckpointError: if the policy cannot be read or the file cannot be written
    """
    started = time.monotonic()
    sizes = [size for size in (n_rows, n_episodes) if size is not None]
    if len(sizes) != 1 or min(*sizes, workers) < 1:
        raise ConfigError(
            f"give either rows or episodes, each and the workers at least 1, got {n_rows}, {n_episodes} and {workers}",
            key="steps",
            hint="For example --steps 1000000.",
        )
    name = check_target(out, name, spec.env, force)
    workers = min(workers, n_episodes or workers)
    runner = EpisodeRunner(spec)
    # no more episodes side by side than a small recording has at least
    runner.width = min(runner.width, n_episodes or -(-int(n_rows or 0) // runner.limit))
    folder = out.with_name(f"{out.name}.parts")
    if force:
        shutil.rmtree(folder, ignore_errors=True)
    parts = Parts(folder, _settings(spec, runner))
    rows_before = parts.n_rows

    def done() -> int:
        return parts.n_rows if n_rows is not None else parts.n_episodes

    total = n_rows if n_rows is not None else int(n_episodes or 0)
    reported = 0.0
    try:
        with closing(_chunks(runner, parts.n_episodes, workers)) as chunks:
            while done() < total:
                if time.monotonic() - reported > _PROGRESS_SECONDS:
                    reported = time.monotonic()
                    progress(done(), total)
                arrays, lengths = next(chunks)
                parts.add(arrays, len(lengths))
        progress(total, total)
        arrays = parts.rows(n_rows) if n_rows is not None else parts.first_episodes(total)
        bounds = bounds_attribute(runner.action_space.low.reshape(-1), runner.action_space.high.reshape(-1))
        attrs = {**describe(name, spec.env, arrays), **bounds, **_origin(spec, runner), **(extra or {})}
        write_hdf5(out, arrays, attrs)
    except BaseException:
        parts.flush()  # nothing is lost by Ctrl-C
        raise
    parts.remove()
    seconds, new_rows = time.monotonic() - started, parts.n_rows - rows_before
    return Recorded(out, attrs, seconds, new_rows, score_of(spec.env, attrs), runner.notes())


def check_target(out: Path, name: str | None, env: str | None, force: bool) -> str:
    """
    Refuse a file or a name that must not be written, before any work is done.

    :param out: file to write
    :param name: dataset id, default the file's name
    :param env: environment that is recorded, must be that of the id
    :param force: replace an existing file
    :return: dataset id
    :raises ConfigError: if the name belongs to another dataset, or the file exists
    :raises CheckpointError: if the folder cannot be written
    """
    stem = out.stem.lower().replace("_", "-")
    name = name or (stem if stem.endswith("-sb3") else f"{stem}-sb3")
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{name!r} cannot be the id of generated data: small letters, digits, '.', '_' and '-', and '-sb3' at the end",
            key="name",
            hint="For example --name hopper-mine-sb3.",
        )
    claimed, known = spec_of_file(out), known_dataset(name)
    for spec in (claimed, known):
        if spec is not None and (spec.embedded or not spec.generated):
            owner = "the file that comes with the package" if spec.embedded else "an official D4RL dataset"
            raise ConfigError(f"{spec.id} is {owner}", where=str(out), key="out", hint="Choose another name, ending in -sb3.")
    if claimed is not None and claimed.id != name:
        raise ConfigError(
            f"the file name says {claimed.id}, the name is {name}", where=str(out), key="name", hint="Use one of both."
        )
    if known is not None and env is not None and getattr(dataset_of_env(env), "env_id", None) != known.env_id:
        raise ConfigError(
            f"{name} is recorded in {known.env_id}, not in {env}",
            key="env",
            hint="Choose another name, or that environment; for Adroit give the dataset id, which adds the corrections.",
        )
    check_writable(out)
    if out.exists() and not force:
        raise ConfigError("the file exists", where=str(out), path=out, key="out", hint="Choose another, or pass --force.")
    return name


def describe(name: str, env: str, arrays: Arrays) -> dict[str, Any]:
    """
    The root attributes every generated dataset has.

    :param name: dataset id
    :param env: id of the environment, or of a dataset recorded in it
    :param arrays: rows
    :return: name to number or text
    """
    returns = whole_returns(arrays)
    lengths = np.diff(_stops(arrays), prepend=0)
    attrs: dict[str, Any] = {
        "dataset_id": name,
        "generated": True,
        "env_id": _env_id(env),
        "rows": len(arrays["rewards"]),
        "episodes": len(returns),
        "terminals": int(arrays["terminals"].sum()),
        "timeouts": int(arrays["timeouts"].sum()),
        "reward_mean": float(arrays["rewards"].mean(dtype=np.float64)),
        "content_hash": content_hash(arrays),
        "versions": versions(),
        "cpu_features": cpu_features(),
    }
    if len(returns):
        attrs.update(
            return_mean=float(returns.mean()),
            return_std=float(returns.std()),
            return_min=float(returns.min()),
            return_max=float(returns.max()),
            length_mean=float(lengths.mean()),
        )
    return attrs


def score_of(env: str, attrs: Mapping[str, Any]) -> float | None:
    """
    D4RL's normalised score (100 = expert) of the mean return that the attributes of a recording name.

    :param env: id of the environment, or of a dataset recorded in it
    :param attrs: root attributes
    :return: score, ``None`` without whole episodes or reference values
    """
    spec = dataset_of_env(env)
    return float(normalized_score(spec.id, attrs["return_mean"])) if spec is not None and "return_mean" in attrs else None


def whole_returns(arrays: Arrays) -> np.ndarray:
    """
    Undiscounted return of each episode that has an end; rows after the last terminal or timeout count for none.

    :param arrays: rows
    :return: shape (whole episodes,), reward units, float64
    """
    stops = _stops(arrays)
    sums = np.concatenate([[0.0], np.cumsum(arrays["rewards"], dtype=np.float64)])
    return sums[stops] - sums[np.concatenate([[0], stops[:-1]]).astype(int)]


def versions() -> str:
    """Releases the recorded bits depend on, as one text for people and for comparison with an interrupted recording."""
    found = [f"sb3_dce {sb3_dce.__version__}", f"python {platform.python_version()}"]
    for package in ("numpy", "gymnasium", "gymnasium-robotics", "mujoco"):
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


def cpu_features() -> str:
    """Architecture and vector instructions NumPy uses here; others may change the last bit of the simulation."""
    shown: Any = np.show_config(mode="dicts")
    extensions = shown.get("SIMD Extensions", {})
    return " ".join([platform.machine(), *extensions.get("baseline", []), *extensions.get("found", [])])


def _stops(arrays: Arrays) -> np.ndarray:
    return np.flatnonzero(arrays["terminals"] | arrays["timeouts"]) + 1


def _origin(spec: RecordingSpec, runner: EpisodeRunner) -> dict[str, Any]:
    facts = runner.facts
    if spec.policy == "random":
        behaviour = facts.name
    else:
        behaviour = f"{facts.name}, {'deterministic' if spec.deterministic else 'stochastic'}"
    attrs = {
        "environment": spec.env,
        "behaviour_policy": behaviour,
        "behaviour_sha256": facts.sha256,
        "behaviour_source": facts.source,
        "behaviour_licence": facts.licence,
        "normalization_sha256": facts.normalization_sha256,
        "seed": spec.seed,
        "seeds": "episode k: reset(seed=seed+k), noise of default_rng([seed, k])",
        "deterministic": spec.deterministic,
        "action_noise": spec.noise,
        "max_episode_steps": runner.limit,
    }
    return {key: value for key, value in attrs.items() if value is not None}


def _settings(spec: RecordingSpec, runner: EpisodeRunner) -> dict[str, Any]:
    """What the rows depend on. The same policy may lie elsewhere: its hash counts, not its path."""
    settings = {key: value for key, value in asdict(spec).items() if key not in ("policy", "vecnormalize")}
    facts = runner.facts
    return {
        **settings,
        "policy_sha256": facts.sha256,
        "normalization_sha256": facts.normalization_sha256,
        "versions": versions(),
        "cpu_features": cpu_features(),
    }


def _env_id(env: str) -> str:
    spec = dataset_of_env(env)
    return env if spec is None or spec.env_id is None else spec.env_id


def _chunks(runner: EpisodeRunner, first: int, workers: int) -> Generator[tuple[Arrays, list[int]], None, None]:
    """Endless: rows and lengths of the episodes from ``first`` on, in order, some at a time."""
    if workers == 1:
        while True:
            yield runner.run_many(first, runner.width)
            first += runner.width
    yield from _parallel_chunks(runner, first, workers)


def _parallel_chunks(runner: EpisodeRunner, first: int, workers: int) -> Iterator[tuple[Arrays, list[int]]]:
    size, rows, episodes = runner.width, 0, 0
    pool = worker_pool(workers, _prepare, runner.spec, runner.policy)
    pending: deque[Future[tuple[Arrays, list[int]]]] = deque()
    try:
        with _one_thread_each():
            while True:
                # twice as many tasks as workers: none waits while the oldest one is still running
                while len(pending) < 2 * workers:
                    with starting_workers():
                        pending.append(pool.submit(_run_many, first, size))
                    first += size
                arrays, lengths = pending.popleft().result()
                rows, episodes = rows + len(arrays["rewards"]), episodes + len(lengths)
                size = runner.width * max(1, round(_TASK_ROWS * episodes / rows / runner.width))
                yield arrays, lengths
    except BrokenProcessPool:
        raise SB3DCEError(
            "a worker process ended unexpectedly, perhaps for lack of memory",
            hint="The same command goes on from here; try a smaller --workers.",
        ) from None
    finally:
        end_workers(pool)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started inside use one BLAS thread, unless the user has set another number: the cores are taken already."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]


# The runner of a worker process; set when it starts.
_runner: EpisodeRunner | None = None


def _prepare(spec: RecordingSpec, policy: NumpyPolicy) -> None:
    global _runner
    prepare_worker()
    _runner = EpisodeRunner(spec, policy)


def _run_many(first: int, n: int) -> tuple[Arrays, list[int]]:
    assert _runner is not None
    return _runner.run_many(first, n)
