"""What ``sb3-dce compare`` does: several agents on one dataset, one protocol, one table made from the result files."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_dce.agents import agent_class
from sb3_dce.configuration import config_hash
from sb3_dce.data import find_file, load_transitions
from sb3_dce.data.catalog import DatasetSpec, normalized_score
from sb3_dce.data.hashes import sha256_once
from sb3_dce.data.locate import short_name
from sb3_dce.errors import ConfigError, DivergenceError
from sb3_dce.evaluation import read_evaluations
from sb3_dce.files import write_text
from sb3_dce.hyperparams import check_keys, constructor_parameters, full_name
from sb3_dce.launch import launch_all, raise_first
from sb3_dce.plots import plot_learning_curves
from sb3_dce.run_files import RunSpec, last_metrics, read_config, read_divergence, read_result, spec_from
from sb3_dce.runs import check_before_running
from sb3_dce.student import sample_std

BANDS = (
    "Thick: mean over seeds; thin: each seed; bands: 95 % confidence interval of the mean (Student's t) from three seeds on, "
    "the range of two."
)
COLUMNS = ("agent", "seed", "n_updates", "mean_return", "normalized_score", "seconds", "seconds_per_1000", "overrides")


# What is shown of agents that cannot be evaluated: how far their actions are from the data's, and what they expect.
DIAGNOSTICS = ("action_dist", "action_sat", "q_data", "q_policy", "gap_td")


class Row(NamedTuple):
    """
    One agent over its seeds.

    :param agent: name
    :param n_seeds: complete runs
    :param n_updates: gradient steps of each
    :param mean: mean over the seeds of the last evaluation, score, or return without reference values
    :param std: sample standard deviation over the seeds, NaN for one
    :param seconds_per_1000: mean training seconds of 1000 updates, evaluations included
    :param overrides: what was set instead of the dataset's row
    :param diagnostics: last logged values by name (:data:`DIAGNOSTICS`), means over the seeds
    """

    agent: str
    n_seeds: int
    n_updates: int
    mean: float
    std: float
    seconds_per_1000: float
    overrides: dict[str, Any]
    diagnostics: dict[str, float]


def compare(
    dataset: str,
    algos: Sequence[str],
    n_updates: int,
    seeds: Sequence[int],
    eval_freq: int,
    n_eval_episodes: int,
    workers: int,
    out: Path | None,
    console: Console,
    overrides: Mapping[str, Any] | None = None,
    updates_of: Mapping[str, int] | None = None,
) -> list[Row]:
    """
    Train every agent with every seed, each with the dataset's row of its own file; show and write the comparison.

    :param dataset: id or file
    :param algos: names of agents, with or without ``offline_``
    :param n_updates: gradient steps of each run
    :param seeds: seeds
    :param eval_freq: gradient steps between two evaluations
    :param n_eval_episodes: episodes of each
    :param workers: processes
    :param out: folder of the results, default ``runs/compare-<dataset>``
    :param console: where to print
    :param overrides: constructor arguments that replace those of the rows: ``{"beta": 2.0}`` for all agents that have it,
        ``{"dce.beta": 2.0}`` for one
    :param updates_of: gradient steps of single agents, instead of ``n_updates``
    :return: the table
    :raises ConfigError: for an unknown agent, a setting that none of them has, or a length without an evaluation at its end
    :raises SB3DCEError: the first error of a run, after all others; the same call goes on. A run that diverges is no error
    """
    algos = [full_name(algo) for algo in algos]
    if len(set(algos)) != len(algos) or not algos:
        raise ConfigError(
            f"name each agent once, got {', '.join(algos)}", key="--algos", hint="For example --algos dce,offline_bc."
        )
    settings = settings_of(algos, overrides or {})
    named = {_one_of(algos, algo, "--updates-of"): length for algo, length in (updates_of or {}).items()}
    path, _ = find_file(dataset)
    name, folder = short_name(dataset), out or default_folder(dataset)
    console.print(
        f"[b]{', '.join(algos)}[/b] on [b]{escape(name)}[/b] ({escape(str(path))}), {n_updates:,} gradient steps, "
        f"{escape(f'seeds {list(seeds)}')}, last policy"
    )
    specs = [
        RunSpec(
            *(algo, dataset, seed, named.get(algo, n_updates), str(folder / algo / f"seed_{seed}")),
            *(eval_freq, n_eval_episodes, settings[algo]),
        )
        for seed in seeds  # all agents of a seed before the next seed: an interrupted comparison is a smaller one
        for algo in algos
    ]
    check_before_running(specs)
    outcomes = launch_all(specs, workers, console)
    # What diverges is a result. Other errors are said below the table of what is complete.
    errors = [o for o in outcomes if isinstance(o, BaseException) and not isinstance(o, DivergenceError)]
    rows = _summarize(dataset, folder, specs, console) if len(errors) < len(specs) else []
    raise_first(errors, console)
    return rows


def default_folder(dataset: str) -> Path:
    """
    ``runs/compare-<dataset>`` below the current folder, where a comparison goes without ``--out``.

    :param dataset: id or file
    :return: folder of its comparison, need not exist
    """
    return Path("runs") / f"compare-{short_name(dataset)}"


def report(dataset: str, algos: Sequence[str], out: Path | None, console: Console) -> list[Row]:
    """
    Show and write the comparison of all complete runs there are, as they were run; nothing is trained.

    :param dataset: id or file
    :param algos: names of agents; empty for all in the folder
    :param out: folder of the results, default ``runs/compare-<dataset>``
    :param console: where to print
    :return: the table
    :raises ConfigError: without a complete run, or if one was trained on another file
    """
    here = sha256_once(find_file(dataset)[0])
    folder, wanted = out or default_folder(dataset), {full_name(algo) for algo in algos}
    runs: dict[str, dict[tuple[str, str], list[RunSpec]]] = {}
    for path in sorted(folder.glob("*/seed_*"), key=lambda path: (path.parent.name, len(path.name), path.name)):
        config = read_config(path)
        if config is None or (wanted and config["run"]["algo"] not in wanted):
            continue
        result, divergence = read_result(path), read_divergence(path)
        if result is None and divergence is None:
            continue
        # a complete run may be on its way to become a longer one, which is the one that diverged if one has
        spec = spec_from(config["run"] if result is None or divergence is not None else result["config"], path)
        if config["dataset"]["sha256"] != here:
            what = f"trained on another file ({config['dataset']['name']}) than {dataset}"
            raise ConfigError(what, where=str(path), hint="Name that one, or another folder with --out.")
        how = f"{spec.n_updates:,} updates{''.join(f', {k}={v}' for k, v in sorted(spec.overrides.items()))}"
        how += f", evaluated over {spec.n_eval_episodes} episodes every {spec.eval_freq:,}"
        # another version of the row of hyperparameters is another agent
        row = config_hash(spec.algo, config["hyperparameters"])
        runs.setdefault(spec.algo, {}).setdefault((how, row), []).append(spec)
    chosen = []
    for algo, kinds in runs.items():
        shown = max(kinds, key=lambda kind: len(kinds[kind]))
        chosen += kinds[shown]
        for (how, row), others in kinds.items():
            if (how, row) != shown:
                other = ", with another row of hyperparameters" if how == shown[0] else ""
                console.print(f"left out: {len(others)} of {algo} with {how}{other}", markup=False)
    if not chosen:
        raise ConfigError("no complete run", where=str(folder), hint="Run the comparison first, without --report-only.")
    return _summarize(dataset, folder, chosen, console)


def _summarize(dataset: str, folder: Path, specs: Sequence[RunSpec], console: Console) -> list[Row]:
    info = load_transitions(dataset).info
    level = float(info.episode_returns.mean()) if len(info.episode_returns) else None
    return summarize(folder, specs, find_file(dataset)[1], level, console)


def settings_of(algos: Sequence[str], overrides: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """
    Divide the overrides among the agents; one that names its agent wins over one for all.

    :param algos: full names of agents
    :param overrides: as in :func:`compare`
    :return: constructor arguments that are set for each agent
    :raises ConfigError: for an unknown agent, or a setting that none of them has
    """
    classes = {algo: agent_class(algo) for algo in algos}
    settings: dict[str, dict[str, Any]] = {algo: {} for algo in algos}
    for name, value in overrides.items():
        prefix, _, key = name.rpartition(".")
        if prefix:
            algo = _one_of(algos, prefix, "--set")
            check_keys(classes[algo], [key], where="--set", zoo_keys=False)
            settings[algo][key] = value
            continue
        having = [algo for algo, cls in classes.items() if key in constructor_parameters(cls)]
        if not having:
            check_keys(classes[algos[0]], [key], where="--set", zoo_keys=False)
        for algo in having:
            settings[algo].setdefault(key, value)  # what is set for one agent alone counts more
    return settings


def _one_of(algos: Sequence[str], name: str, key: str) -> str:
    full = full_name(name)
    if full not in algos:
        raise ConfigError(f"{name!r} is not compared here", key=key, hint=f"Compared are {', '.join(algos)}.")
    return full


def summarize(
    folder: Path, specs: Sequence[RunSpec], spec: DatasetSpec | None, data_return: float | None, console: Console
) -> list[Row]:
    """
    Make table and picture from the result files of a comparison, complete or not.

    :param folder: of the comparison
    :param specs: its runs
    :param spec: catalogue entry of the dataset, if there is one
    :param data_return: mean return of the data's episodes, if there are any
    :param console: where to print
    :return: one row per agent that has a complete run
    :raises ConfigError: if no run is complete or has diverged
    """
    dataset_id = None if spec is None else spec.id
    runs: dict[str, dict[Path, dict[str, Any]]] = {}
    lost: dict[str, str] = {}
    for run in specs:
        path = Path(run.folder)
        if (divergence := read_divergence(path)) is not None:
            lost[run.name] = str(divergence["reason"])
        elif (result := read_result(path)) is not None and result["n_updates"] == run.n_updates:
            runs.setdefault(run.algo, {})[path] = result
    if not runs and not lost:
        raise ConfigError("no complete run", where=str(folder), hint="Run the comparison first; it goes on where it stopped.")
    results = {algo: list(found.values()) for algo, found in runs.items()}
    _write_csv(folder / "comparison.csv", results)
    scored = dataset_id is not None
    rows = [_row(algo, found, scored) for algo, found in runs.items()]
    level = data_return
    if level is not None and dataset_id is not None:
        level = float(normalized_score(dataset_id, level))
    table = _cells(rows, level, scored)
    notes = [f"Diverged, and in no mean: {name} ({reason})." for name, reason in lost.items()]
    if rows and _unevaluated(rows):
        notes.append(
            "Nothing was evaluated: no environment is known for these data, or its simulator is not installed. action_dist is "
            "the mean distance of the policy's actions from the data's (scaled to [-1, 1]; BC's and IQL's are means, TD3+BC's "
            "have no spread, so that these are nearer by themselves), q_data what the critics expect. "
            "They say which agents stay near the data and which critics diverge, not which policy is best."
        )
    elif without := [row.agent for row in rows if np.isnan(row.mean)]:
        notes.append(f"Not evaluated, since there was no simulator when they were trained: {', '.join(without)}.")
    _show(table, console)
    for note in notes:
        console.print(note, markup=False)
    curves = {algo: [read_evaluations(run, dataset_id) for run in found] for algo, found in runs.items()}
    levels = {} if level is None else {"mean of the data": level}
    title = short_name(specs[0].dataset) if dataset_id is None else dataset_id
    picture = plot_learning_curves(curves, folder / "comparison.png", title, levels, confidence=True)
    _write_markdown(folder / "comparison.md", title, table, notes, picture)
    drawn = f", {picture.name}" if picture else ""
    console.print(f"saved  {folder}/comparison.md, comparison.csv{drawn}", markup=False, soft_wrap=True)
    return rows


def _row(algo: str, runs: dict[Path, dict[str, Any]], scored: bool) -> Row:
    folders, results = list(runs), list(runs.values())
    values = [r["normalized_score"] if scored else r["mean_return"] for r in results]
    known = np.array([np.nan if value is None else value for value in values], dtype=float)
    std = float(sample_std(known))
    seconds = float(np.mean([1000 * r["seconds"] / r["n_updates"] for r in results]))
    overrides = results[0]["config"].get("overrides", {})
    logged = [last_metrics(folder) for folder in folders]
    diagnostics = {
        name: float(np.mean([metrics[name] for metrics in logged]))
        for name in DIAGNOSTICS
        if all(name in metrics for metrics in logged)
    }
    return Row(algo, len(results), results[0]["n_updates"], float(known.mean()), std, seconds, overrides, diagnostics)


def _unevaluated(rows: list[Row]) -> bool:
    return all(np.isnan(row.mean) for row in rows)


def _cells(rows: list[Row], data_level: float | None, scored: bool) -> list[list[str]]:
    """Heading and lines of the table, the best first."""
    heading = ["normalised score" if scored else "return", "± over seeds"]
    unevaluated = bool(rows) and _unevaluated(rows)
    if unevaluated:
        heading = [name for name in DIAGNOSTICS if any(name in row.diagnostics for row in rows)]
    lines = [["agent", "set", *heading, "seeds", "updates", "s per 1000 updates"]]
    for row in sorted(rows, key=lambda row: (np.isnan(row.mean), -row.mean)):
        changed = ", ".join(f"{name}={value}" for name, value in row.overrides.items())
        values = ["-" if np.isnan(value) else f"{value:.1f}" for value in (row.mean, row.std)]
        if unevaluated:
            values = [f"{row.diagnostics[name]:.3g}" if name in row.diagnostics else "-" for name in heading]
        numbers = [*values, str(row.n_seeds), f"{row.n_updates:,}", f"{row.seconds_per_1000:.1f}"]
        lines.append([row.agent, changed, *numbers])
    if data_level is not None and not unevaluated:
        lines.append(["mean of the data", "", f"{data_level:.1f}", "", "", "", ""])
    if not any(line[1] for line in lines[1:]):
        lines = [[line[0], *line[2:]] for line in lines]
    return lines


def _show(lines: list[list[str]], console: Console) -> None:
    table = Table(box=None, header_style="bold")
    # what was set stands below: a column of it would leave no room in a terminal
    shown = [place for place, title in enumerate(lines[0]) if title != "set"]
    for place in shown:
        whole = max(len(line[place]) for line in lines[1:]) if place == 0 else None  # names are not cut
        table.add_column(lines[0][place], justify="right" if place else "left", min_width=whole)
    for line in lines[1:]:
        table.add_row(*(escape(line[place]) for place in shown))
    console.print(table)
    for line in lines[1:]:
        if "set" in lines[0] and line[1]:
            console.print(f" {line[0]} with {line[1]}", markup=False)


def _write_markdown(path: Path, title: str, lines: list[list[str]], notes: list[str], picture: Path | None) -> None:
    rule = ["---"] * len(lines[0])
    text = [f"# Agents on {title}", "", *(f"| {' | '.join(line)} |" for line in (lines[0], rule, *lines[1:])), ""]
    text += [" ".join(["Last evaluation of each run; the seconds are wall time, evaluations included.", *notes]), ""]
    if picture is not None:
        text += [f"![Learning curves]({picture.name})", "", BANDS, ""]
    write_text(path, "\n".join(text))


def _write_csv(path: Path, results: dict[str, list[dict[str, Any]]]) -> None:
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(COLUMNS)
    for algo, found in results.items():
        for r in found:
            rate = round(1000 * r["seconds"] / r["n_updates"], 3)
            values = (r["n_updates"], r["mean_return"], r["normalized_score"], r["seconds"], rate)
            writer.writerow([algo, r["config"]["seed"], *values, json.dumps(r["config"].get("overrides", {}))])
    write_text(path, text.getvalue())
