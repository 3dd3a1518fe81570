"""
Result rows: the one format between runs and tables.

A row is one number of one run at one step. Rows are kept in ``*.csv.gz`` files, small enough for a repository; models are
not needed to make a table again. A run is known by data, agent, configuration, length and seed: found twice, in a folder
and in a file or in two files, it counts once.
"""

from __future__ import annotations

import csv
import json
import re
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_dce.configuration import config_hash, differences
from sb3_dce.data.catalog import resolve
from sb3_dce.data.locate import catalogue_id, short_name
from sb3_dce.errors import CheckpointError, ConfigError, SB3DCEError
from sb3_dce.evaluation import Evaluation, read_evaluations
from sb3_dce.experiments.grid import PlannedRun
from sb3_dce.files import write_atomically
from sb3_dce.run_files import has_ended, progress_logs, read_config, read_divergence, read_result

COLUMNS = (
    "experiment",
    "dataset",
    "dataset_sha256",
    "agent",
    "hyperparameters",
    "config_hash",
    "n_updates",
    "seed",
    "step",
    "metric",
    "value",
    "code_version",
    "device",
)
# What makes a run the same run.
RUN_KEY = ["dataset", "dataset_sha256", "agent", "config_hash", "n_updates", "seed"]
PLAN_KEY = ["dataset", "agent", "config_hash", "n_updates", "seed"]
# Its runs are too short, or evaluated too little, to say anything about scores.
TIMING = "run-times"
# Diagnostics that figures, verdicts and the search for causes read, by their names in the log.
CURVES = (
    *("q_data", "q_policy", "value", "gap_td", "ent_coef", "beta_eff", "survival_margin", "action_dist", "entropy", "adv"),
    *("mmd", "alpha"),  # UWAC's distance from its model of the data, and the weight it has in the actor's loss
)
PROBE_CURVE = re.compile(r"probe\d+_(data|policy|init|best|max|min|rank)")
DATA_FACTS = ("rows", "reward_mean", "reward_abs_max", "n_terminals")
# A curve of diagnostics has at most POINTS points, each the mean since the last; a short run has wider gaps than FINEST steps
# only for FEWEST_POINTS.
POINTS, FEWEST_POINTS, FINEST = 100, 25, 2000
AGAIN = "Make the file again from the run folders, or take it anew from where it came."
# Episodes of the paper's evaluation: four in its Gym table, five in the text for the others.
PAPER_EPISODES = {"gym": 4, "adroit": 5, "kitchen": 5}


class ResultsError(SB3DCEError, ValueError):
    """Result rows are damaged or contradict each other."""


def rows_of_run(folder: Path, experiment: str) -> pd.DataFrame | None:
    """
    All that is kept of a run, once it has ended: scores, diagnostics, time and facts about its data, to six digits.

    :param folder: of one run, as :func:`sb3_dce.runs.run` writes it
    :param experiment: id of the experiment it is run for
    :return: its rows; ``None`` unless it is complete or has diverged; one that diverged while it was made longer has diverged
    :raises CheckpointError: if a file is damaged
    :raises ConfigError: if it is of an agent that this version does not have
    """
    config, result, divergence = read_config(folder), read_result(folder), read_divergence(folder)
    if config is None or (result is None and divergence is None):
        return None
    try:
        run, data = config["run"], config["dataset"]
        dataset_id = catalogue_id(data["name"])
        # a complete run may be on its way to become a longer one
        n_updates = int(run["n_updates"] if result is None or divergence is not None else result["n_updates"])
        commit = config["versions"].get("commit")
        common = {
            "experiment": experiment,
            "dataset": dataset_id or short_name(data["name"]),
            "dataset_sha256": data["sha256"],
            "agent": run["algo"],
            "hyperparameters": differences(run["algo"], dataset_id, run["overrides"]),
            "config_hash": config_hash(run["algo"], config["hyperparameters"]),
            "n_updates": n_updates,
            "seed": int(run["seed"]),
            "code_version": config["versions"]["sb3_dce"] + (f"+{commit}" if commit else ""),
            "device": _device(config),
        }
        values = [*_facts(data, result, divergence, n_updates), *_curves(folder, n_updates)]
        values += _evaluations(folder, dataset_id, n_updates)
    except ConfigError as error:
        raise ConfigError(error.what, where=str(folder), hint=error.hint, key=error.key) from error
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"the folder is not that of a run of this package: {error!r}",
            where=str(folder),
            path=folder,
            hint="Name folders that sb3-dce train, compare or reproduce wrote.",
        ) from error
    finite = [(step, metric, float(f"{value:.6g}")) for step, metric, value in values if np.isfinite(value)]
    return _ordered(pd.DataFrame([{**common, "step": s, "metric": m, "value": v} for s, m, v in finite]))


def import_runs(folder: Path, experiment: str, planned: Iterable[PlannedRun] = ()) -> pd.DataFrame:
    """
    Rows of every run in a folder or below it, whichever command made it; what has not ended yet is passed over.

    :param folder: anywhere above folders of runs
    :param experiment: id of the experiment they are taken for
    :param planned: runs of grids, which are taken for these
    :return: rows of those that are complete or have diverged, each run once
    """
    of_plan = _experiments(planned)
    # a file of that name alone may be any other program's
    ended = [path.parent for path in sorted(folder.rglob("config.yml")) if has_ended(path.parent)]
    found = [rows_of_run(path, of_plan.get(path, experiment)) for path in ended]
    return merge(rows for rows in found if rows is not None)


def planned_rows(planned: Iterable[PlannedRun]) -> pd.DataFrame:
    """
    Rows of a plan from the folders of its runs, trained just now or by an earlier call.

    :param planned: runs of a grid
    :return: rows of those that are complete or have diverged, each run once
    """
    found = [rows_of_run(folder, experiment) for folder, experiment in _experiments(planned).items()]
    return merge(rows for rows in found if rows is not None)


def _experiments(planned: Iterable[PlannedRun]) -> dict[Path, str]:
    """By folder; a run of two experiments is one of scores, not of times alone."""
    last_counts = sorted(planned, key=lambda run: run.experiment != TIMING)
    return {Path(run.spec.folder): run.experiment for run in last_counts}


def merge(parts: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """
    Put rows of several files and folders together, so that no run counts twice.

    :param parts: rows; where several hold the same run, that with the most episodes at its end counts, one made for
        :data:`TIMING` only if there is no other, and of equals the first
    :return: all rows, each run once
    """
    filled = [part for part in parts if len(part)]
    if not filled:
        return empty()
    every = pd.concat(filled, ignore_index=True)
    runs, part_of = every.groupby(RUN_KEY, sort=False).ngroup(), np.repeat(np.arange(len(filled)), [len(p) for p in filled])
    copies = pd.DataFrame({"run": runs, "part": part_of, "timing": every["experiment"] == TIMING})
    copies["episodes"] = np.where(every["metric"] == "n_episodes", every["value"], 0.0)
    best = copies.groupby(["run", "part"], as_index=False).max()
    best = best.sort_values(["run", "timing", "episodes", "part"], ascending=[True, True, False, True])
    taken = best.drop_duplicates("run").set_index("run")["part"]
    return _ordered(every[runs.map(taken).to_numpy() == part_of])


def without(rows: pd.DataFrame, others: pd.DataFrame) -> pd.DataFrame:
    """
    What is left of rows without the runs that others hold, told by ``RUN_KEY`` whatever their numbers are.

    :param rows: rows
    :param others: rows of the runs to leave out
    :return: part of ``rows``
    """
    known = set(others[RUN_KEY].itertuples(index=False, name=None))
    keys = rows[RUN_KEY].itertuples(index=False, name=None)
    return rows[np.array([key not in known for key in keys], dtype=bool)]  # a list would choose columns if there are no rows


def changed(rows: pd.DataFrame, before: pd.DataFrame) -> pd.DataFrame:
    """
    Rows of the runs that are not among others just as they are: new runs, and those of which there is more to say now.

    :param rows: rows
    :param before: rows
    :return: part of ``rows``, whole runs
    """
    known = set(before.itertuples(index=False, name=None))
    other = np.array([row not in known for row in rows.itertuples(index=False, name=None)], dtype=bool)
    return without(rows, without(rows, rows[other]))


def done_runs(
    rows: pd.DataFrame, planned: Iterable[PlannedRun], hash_here: Callable[[str], str | None]
) -> set[tuple[Any, ...]]:
    """
    Which runs need no training; one that diverged, or that could not be evaluated, needs no episodes for that.

    :param rows: rows
    :param planned: runs of a grid
    :param hash_here: gives the SHA-256 by which rows name a dataset's file on this machine
    :return: keys of those that the rows hold, on the file that is here now and evaluated over at least as many episodes
    """
    lost = set(rows[rows["metric"] == "diverged"][RUN_KEY].itertuples(index=False, name=None))
    scored = set(rows[rows["metric"].isin(["score", "return"])][RUN_KEY].itertuples(index=False, name=None))
    counts = rows[rows["metric"] == "n_episodes"]
    episodes = dict(zip(counts[RUN_KEY].itertuples(index=False, name=None), counts["value"], strict=True))
    known = set(rows[RUN_KEY].itertuples(index=False, name=None))
    done = set()
    for run in planned:
        dataset, *others = run.key
        key = (dataset, hash_here(dataset), *others)
        # a run without a simulator has no evaluation, and one that diverged perhaps not the last
        if key in known and (key in lost or key not in scored or episodes.get(key, 0) >= run.spec.n_eval_episodes):
            done.add(run.key)
    return done


def empty() -> pd.DataFrame:
    """No rows, with the columns and types of all others, to merge with them or to compare against."""
    return _ordered(pd.DataFrame(columns=list(COLUMNS)))


def write_rows(path: Path, rows: pd.DataFrame) -> None:
    """
    Write rows in the order of their runs; what is wrong with them is found before the file is touched.

    :param path: ``.csv.gz`` file; the same rows give the same bytes
    :param rows: rows
    :raises ResultsError: if they are not what rows have to be
    """
    check_rows(rows, str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    ordered = rows.sort_values([*RUN_KEY, "metric", "step"], kind="stable")
    with write_atomically(path) as stream:
        ordered.to_csv(stream, index=False, compression={"method": "gzip", "mtime": 0}, quoting=csv.QUOTE_MINIMAL)


def read_rows(path: Path) -> pd.DataFrame:
    """
    Read a file of rows back, with the same checks as before it was written.

    :param path: file that :func:`write_rows` wrote
    :return: rows
    :raises ResultsError: if it is damaged or something else
    """
    text = {name: str for name in COLUMNS if name not in ("n_updates", "seed", "step", "value")}
    try:
        rows = pd.read_csv(path, dtype=text, compression="gzip", keep_default_na=False, na_values={"value": [""]})
    except (OSError, EOFError, ValueError, zlib.error) as error:
        raise ResultsError(f"the file cannot be read: {error}", where=str(path), hint=AGAIN) from error
    check_rows(rows, str(path))
    return _ordered(rows)


def has_rows(folder: Path) -> bool:
    """
    Whether :func:`read_folder` finds files there, asked without opening them.

    :param folder: any
    :return: true also where these files hold no rows
    """
    return bool(_row_files(folder))


def read_folder(folder: Path) -> pd.DataFrame:
    """
    All rows of a folder; the files in its ``rows/`` are read only if it has none of its own.

    :param folder: with ``.csv.gz`` files in it or in ``rows/``; need not exist
    :return: rows, each run once
    """
    return merge(read_rows(path) for path in _row_files(folder))


def _row_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.csv.gz")) or sorted((folder / "rows").glob("*.csv.gz"))


def check_rows(rows: pd.DataFrame, where: str) -> None:
    """
    Refuse what would make a table wrong without a word, on the way into a file and out of it.

    :param rows: rows
    :param where: for the message
    :raises ResultsError: for other columns, numbers that are none, a hash or hyperparameters that are none, a step twice, or
        a run with two sets of hyperparameters or two code versions
    """

    def refuse(what: str) -> None:
        raise ResultsError(what, where=where, hint=AGAIN)

    if tuple(rows.columns) != COLUMNS:
        refuse(f"columns are {', '.join(map(str, rows.columns))}; they must be {', '.join(COLUMNS)}")
    if rows.empty:
        return
    for name in ("n_updates", "seed", "step"):
        if not pd.api.types.is_integer_dtype(rows[name]) or (rows[name] < 0).any():
            refuse(f"{name} must be whole numbers from 0 up")
    if not pd.api.types.is_numeric_dtype(rows["value"]) or not np.isfinite(rows["value"].to_numpy(dtype=float)).all():
        refuse("value must be finite numbers")
    if not rows["dataset_sha256"].str.fullmatch(r"[0-9a-f]{64}").all():
        refuse("dataset_sha256 must be 64 hexadecimal digits")
    if (twice := rows.duplicated([*RUN_KEY, "step", "metric"])).any():
        first = rows[twice].iloc[0]
        refuse(f"{first['metric']} at step {first['step']} of {first['agent']} on {first['dataset']} is there twice")
    for text in rows["hyperparameters"].unique():
        try:
            valid = isinstance(json.loads(text), dict)
        except ValueError:
            valid = False
        if not valid:
            refuse(f"hyperparameters must be a JSON object, got {text[:60]!r}")
    if (rows.groupby(RUN_KEY)[["hyperparameters", "code_version"]].nunique() > 1).to_numpy().any():
        refuse("one run has two sets of hyperparameters or two code versions")


def _device(config: dict[str, Any]) -> str:
    # files of earlier versions say only which was asked for
    precision = config["machine"].get("precision") or config["hyperparameters"].get("precision", "float32")
    return f"{config['machine']['device']}{'' if precision == 'float32' else ' ' + precision}"


def _facts(
    data: dict[str, Any], result: dict[str, Any] | None, divergence: dict[str, Any] | None, n_updates: int
) -> list[tuple[int, str, float]]:
    """Numbers of the whole run, at its last step; of its data, at step 0."""
    facts = [(0, f"data_{name}", float(data[name])) for name in DATA_FACTS if name in data]
    if divergence is not None:
        facts.append((int(divergence["n_updates"]), "diverged", 1.0))
    elif result is not None:
        facts.append((n_updates, "seconds", float(result["seconds"])))
    return facts


def _evaluations(folder: Path, dataset_id: str | None, n_updates: int) -> list[tuple[int, str, float]]:
    values: list[tuple[int, str, float]] = []
    evaluations = [e for e in read_evaluations(folder, dataset_id) if e.n_updates <= n_updates]
    for e in evaluations:
        if e.score is not None:
            values.append((e.n_updates, "score", e.score))
        if e.score is None or e.n_updates == n_updates:  # elsewhere the score says it too
            values.append((e.n_updates, "return", e.mean))
    if evaluations and evaluations[-1].n_updates == n_updates:
        last = evaluations[-1]
        values += [(n_updates, "n_episodes", len(last.returns)), (n_updates, "mean_length", float(np.mean(last.lengths)))]
        family = None if dataset_id is None else resolve(dataset_id).family
        n_paper = PAPER_EPISODES.get(family or "")
        if n_paper is not None and last.score is not None and len(last.returns) >= n_paper:
            # the first episodes, which were fixed before anything was known about them
            first = Evaluation(last.n_updates, last.returns[:n_paper], last.lengths[:n_paper], dataset_id)
            assert first.score is not None
            values.append((n_updates, "score_paper_episodes", first.score))
    return values


def _curves(folder: Path, n_updates: int) -> list[tuple[int, str, float]]:
    """Diagnostics of the log, averaged over intervals that depend on the length of the run alone."""
    log = read_log(folder)
    log = log[log.index <= n_updates]  # a complete run may be on its way to become a longer one
    if log.empty:
        return []
    width = max(-(-n_updates // POINTS), min(FINEST, -(-n_updates // FEWEST_POINTS)))
    columns = [str(name).removeprefix("train/") for name in log if str(name).startswith("train/")]
    names = [name for name in columns if name in CURVES or PROBE_CURVE.fullmatch(name)]
    ends = (-(-log.index.to_numpy(dtype=int) // width) * width).clip(max=n_updates)
    means = log[[f"train/{name}" for name in names]].groupby(ends).mean()
    steps = [int(step) for step in means.index.to_numpy(dtype=int)]
    return [(s, name, float(v)) for name in names for s, v in zip(steps, means[f"train/{name}"].to_numpy(), strict=True)]


def read_log(folder: Path) -> pd.DataFrame:
    """
    Put the logs of a run together, one for each time that it was begun or gone on with.

    :param folder: of a run
    :return: its log by gradient steps; where it was killed and went on from a checkpoint, what the resumed run wrote counts
    """
    parts: list[pd.DataFrame] = []
    for first, path in progress_logs(folder):
        part = pd.read_csv(path, on_bad_lines="skip")  # the last line may have been cut by a kill
        if "time/total_timesteps" not in part:
            continue
        part = part.dropna(subset=["time/total_timesteps"]).groupby("time/total_timesteps").first()
        parts = [earlier[earlier.index <= first] for earlier in parts]
        parts.append(part[part.index > first])
    parts = [part for part in parts if len(part)]
    if not parts:
        return pd.DataFrame()
    log = pd.concat(parts).sort_index()
    log.index = log.index.astype(int)
    return log


def _ordered(rows: pd.DataFrame) -> pd.DataFrame:
    whole = {"n_updates": "int64", "seed": "int64", "step": "int64", "value": "float64"}
    return rows[list(COLUMNS)].reset_index(drop=True).astype(whole)
