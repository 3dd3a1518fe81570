"""What ``sb3-dce train`` and ``sb3-dce evaluate`` do: runs over seeds, a table, a plot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sb3_dce import hyperparams
from sb3_dce.agents import agent_class
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.data import find_file
from sb3_dce.data.catalog import resolve
from sb3_dce.data.locate import catalogue_id, short_name
from sb3_dce.envs import make_env, missing_simulator
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.evaluation import Evaluation, evaluate, read_evaluations
from sb3_dce.files import quoted
from sb3_dce.launch import launch_all, raise_first
from sb3_dce.plots import plot_learning_curves
from sb3_dce.rollouts import Rollouts, rollouts_of
from sb3_dce.run_files import RunSpec
from sb3_dce.runs import check_before_running
from sb3_dce.saving import existing_zip, saved_algo


def train_seeds(
    algo: str,
    dataset: str,
    n_updates: int | None,
    seeds: Sequence[int],
    eval_freq: int,
    n_eval_episodes: int,
    workers: int,
    out: Path | None,
    overrides: dict[str, Any],
    console: Console,
) -> list[dict[str, Any]]:
    """
    Train one agent with several seeds; show the progress, the results and where they are.

    :param algo: name of the agent, with or without ``offline_``
    :param dataset: id or file
    :param n_updates: gradient steps; ``None`` takes those of the dataset's row
    :param seeds: seeds
    :param eval_freq: gradient steps between two evaluations
    :param n_eval_episodes: episodes of each
    :param workers: processes
    :param out: folder of the results
    :param overrides: constructor arguments that replace those of the row
    :param console: where to print
    :return: results, one per seed
    :raises SB3DCEError: the first error of a run, a divergence, too, after all others; those that are complete are shown
    """
    algo = hyperparams.full_name(algo)
    agent = agent_class(algo)
    hyperparams.check_keys(agent, overrides, where="--set", zoo_keys=False)
    path, spec = find_file(dataset)
    row = hyperparams.load_row(algo, None if spec is None else spec.id)
    total = n_updates or hyperparams.split_row(row).n_timesteps
    name = short_name(dataset)
    folder = out or Path("runs") / f"{algo}-{name}"
    where = f"[b]{escape(name)}[/b] ({escape(str(path))})"
    console.print(f"[b]{algo}[/b] on {where}, {total:,} gradient steps, seeds {escape(str(list(seeds)))}")
    specs = [
        RunSpec(algo, dataset, seed, total, str(folder / f"seed_{seed}"), eval_freq, n_eval_episodes, overrides)
        for seed in seeds
    ]
    check_before_running(specs)
    outcomes = launch_all(specs, workers, console)
    errors = [outcome for outcome in outcomes if isinstance(outcome, BaseException)]
    results = [outcome for outcome in outcomes if not isinstance(outcome, BaseException)]
    if not results:
        raise_first(errors, console)
    show_results(algo, results, console)
    complete = [Path(s.folder) for s, outcome in zip(specs, outcomes, strict=True) if not isinstance(outcome, BaseException)]
    curves = {algo: [read_evaluations(run, None if spec is None else spec.id) for run in complete]}
    picture = plot_learning_curves(curves, folder / "learning_curve.png", title=name)
    evaluated = results[0]["returns"] is not None
    files = "model.zip, config.yml" + (", evaluations.csv" if evaluated else "")
    console.print(f"saved  {folder}/seed_*/{files}", markup=False, soft_wrap=True)
    if picture is not None:
        console.print(f"       {picture}", markup=False, soft_wrap=True)
    needs = "" if evaluated else " --env <id of its environment>"
    model = quoted(f"{folder}/seed_{results[0]['config']['seed']}/model.zip")
    console.print(f"next   sb3-dce evaluate {model}{needs}", markup=False, soft_wrap=True)
    raise_first(errors, console)
    return results


def show_results(algo: str, results: list[dict[str, Any]], console: Console) -> None:
    """
    Print a line per seed: return and normalised score of the last evaluation, and how long the run took, evaluations included.

    :param algo: name of the agent
    :param results: of its seeds
    :param console: where to print
    """
    table = Table(box=None, header_style="bold")
    for title in ("agent", "seed", "return (last evaluation)", "normalised score", "seconds"):
        table.add_column(title, justify="left" if title == "agent" else "right")
    for row in results:
        if row["returns"] is None:
            cells = ("no simulator", "-")
        else:
            score = row["normalized_score"]
            cells = (
                f"{np.mean(row['returns']):.1f} ± {np.std(row['returns']):.1f}",
                "-" if score is None else f"{score:.1f}",
            )
        table.add_row(algo, str(row["config"]["seed"]), *cells, f"{row['seconds']:.0f}")
    console.print(table)


def evaluate_file(model_path: Path, dataset: str | None, n_episodes: int, seed: int, env: str | None = None) -> Evaluation:
    """
    Play episodes with a saved agent, by default in the environment of the data that it was trained on.

    :param model_path: zip file of an agent
    :param dataset: id that names environment and score; ``None`` takes the model's own
    :param n_episodes: episodes
    :param seed: seed of the first episode
    :param env: id of an environment instead of that of a dataset; there is no score then
    :return: returns and lengths, and the score where there is one
    :raises CheckpointError: if the file is not a model of this package
    :raises ConfigError: if no environment is known or installed
    """
    model = load_any(model_path)
    if env is not None:
        if dataset is not None:
            hint = "Give one of them: a dataset's environment comes with its score."
            raise ConfigError("--env and --dataset both name an environment", key="--env", hint=hint)
        return evaluate(model, Rollouts(lambda: make_env(env), n_episodes), seed)
    dataset_id = resolve(dataset).id if dataset is not None else catalogue_id(model.dataset)
    missing = None if dataset_id is None else missing_simulator(resolve(dataset_id))
    if missing is not None:
        raise ConfigError(missing.reason, key="env", hint=missing.remedy)
    rollouts = rollouts_of(dataset or model.dataset, n_episodes)
    if rollouts is None:
        raise ConfigError(
            f"no environment is known for {model.dataset or 'data in memory'}, on which the model was trained",
            key="dataset",
            hint="Give its id with --env, or use evaluate_policy(model, env) of Stable-Baselines3. Where a known dataset has "
            "the same environment, --dataset adds the score.",
        )
    return evaluate(model, rollouts, seed, dataset_id)


def load_any(path: Path) -> OfflineAlgorithm:
    """
    Load a model of whichever agent it is.

    :param path: zip file
    :return: model
    :raises CheckpointError: if the file is not there, damaged, or no model of this package
    """
    path = existing_zip(path)
    algo = saved_algo(path)
    if algo is None:
        raise CheckpointError(
            "the file is a model of another package", where=str(path), path=path, hint="Load it with its own class."
        )
    return agent_class(algo).load(path)
