"""``sb3-dce demo``: the main job, from data to a compared and saved policy, on the data that come with the package."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from rich.console import Console
from rich.table import Table

from sb3_dce.data import load_transitions
from sb3_dce.data.catalog import normalized_score, resolve
from sb3_dce.envs import dataset_spaces, missing_simulator
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.evaluation import read_evaluations
from sb3_dce.execution import choose_execution
from sb3_dce.files import quoted, write_text
from sb3_dce.launch import launch
from sb3_dce.plots import plot_learning_curves
from sb3_dce.processes import usable_cores
from sb3_dce.rollouts import Rollouts, make_rollouts
from sb3_dce.run_files import RunSpec, read_config
from sb3_dce.runs import alone

DATASET = "halfcheetah-demo-sb3"
N_UPDATES = 20_000
EVAL_FREQ = 5_000
N_EVAL_EPISODES = 10
# In results.json, which is told by them from a file of another program.
ROWS = {"random", "data", "BC", "DCE"}

# Small networks and a larger step than the paper's, so that a few minutes on two cores are enough; both agents get them.
# The values were chosen on seeds 100 and up, not on those the demo runs.
SHARED: dict[str, Any] = {"learning_rate": 1e-3, "policy_kwargs": {"net_arch": [64, 64]}, "execution": "auto"}
DCE_ONLY: dict[str, Any] = {"beta": 1.0, "beta_final": None, "beta_rate": 0.0, "tau": 0.02}


def demo_spec(algo: str, seed: int, folder: Path) -> RunSpec:
    """
    One run of the demo: small networks and a large step for both agents, for DCE also a constant beta and a larger ``tau``.

    :param algo: "dce" or "offline_bc"
    :param seed: seed of the run
    :param folder: folder of the demo
    :return: the run with this agent and seed, in the folder ``<algo>_<seed>`` below that of the demo
    """
    overrides = {**SHARED, **(DCE_ONLY if algo == "dce" else {})}
    return RunSpec(algo, DATASET, seed, N_UPDATES, str(folder / f"{algo}_{seed}"), EVAL_FREQ, N_EVAL_EPISODES, overrides)


def run_demo(folder: Path, n_seeds: int, fresh: bool, console: Console) -> dict[str, Any]:
    """
    Train DCE and behavioural cloning the same way, show how they compare with random actions and with the data.

    :param folder: where everything is written; a run that is complete there is not repeated
    :param n_seeds: seeds of each agent
    :param fresh: delete earlier results in the folder first
    :param console: where to print
    :return: the table, by agent
    :raises ConfigError: if the simulator is not installed, or files are in the way that no demo wrote
    """
    missing = missing_simulator(resolve(DATASET))
    if missing is not None:
        raise ConfigError(missing.reason, key=missing.package, hint=missing.remedy)
    _refuse_other_files(folder)
    if fresh and folder.exists():
        _delete_demo(folder)
    transitions = load_transitions(DATASET)
    for line in transitions.summary():
        console.print(line, markup=False)
    rollouts = make_rollouts(DATASET, N_EVAL_EPISODES)
    assert rollouts is not None
    if choose_execution("auto", N_UPDATES, th.device("cpu")) == "eager":
        n_seeds = 1
        console.print("No C++ compiler, or no Python.h: updates run uncompiled, four times slower, so with one seed only.")
    specs = [demo_spec(algo, seed, folder) for seed in range(n_seeds) for algo in ("dce", "offline_bc")]
    setting = f"networks {SHARED['policy_kwargs']['net_arch']}   learning rate {SHARED['learning_rate']:g}"
    console.print(
        f"\nDCE and BC   {n_seeds} seeds each   {N_UPDATES:,} gradient steps   {setting}   beta {DCE_ONLY['beta']:g}\n"
    )
    results = launch(sorted(specs, key=lambda s: s.algo), usable_cores(), console)
    table = {
        "random": _random_returns(rollouts),
        "data": transitions.info.episode_returns.tolist(),
        **{name: _means(results, algo) for name, algo in (("BC", "offline_bc"), ("DCE", "dce"))},
    }
    seconds = {name: _seconds(results, algo) for name, algo in (("BC", "offline_bc"), ("DCE", "dce"))}
    _print_table(table, seconds, n_seeds, console)
    _write_results(folder, table)
    curves = {
        name: [read_evaluations(Path(s.folder), DATASET) for s in specs if s.algo == algo]
        for name, algo in (("DCE", "dce"), ("BC", "offline_bc"))
    }
    levels = {name: float(normalized_score(DATASET, np.mean(table[name]))) for name in ("data", "random")}
    picture = plot_learning_curves(curves, folder / "learning_curve.png", DATASET, levels)
    console.print(
        f"\nsaved  {folder}/dce_0/model.zip  config.yml  evaluations.csv  evaluations.npz", markup=False, soft_wrap=True
    )
    plot = picture.name if picture else "(no plot: pip install matplotlib)"
    console.print(f"       {folder}/results.json  {plot}", markup=False, soft_wrap=True)
    model = quoted(f"{folder}/dce_0/model.zip")
    console.print(f"next   sb3-dce evaluate {model}", markup=False, soft_wrap=True)
    return table


def _refuse_other_files(folder: Path) -> None:
    """Files that a demo would replace or delete, though another program wrote them."""
    table, picture = (folder / name for name in ("results.json", "learning_curve.png"))
    try:
        has_table = set(json.loads(table.read_bytes())) == ROWS
    except (OSError, ValueError, TypeError):
        has_table = False
    ours = {table: has_table, picture: has_table or any(_is_run_of_demo(path) for path in folder.glob("*_*"))}
    for path, is_ours in ours.items():
        if path.exists() and not is_ours:
            hint = "Choose another folder with --out, or move the file away."
            raise ConfigError("a demo would replace this file, and none wrote it", where=str(path), key="--out", hint=hint)


def _delete_demo(folder: Path) -> None:
    """Delete what a demo wrote, and nothing else that may lie in the folder."""
    for path in folder.iterdir():
        if _is_run_of_demo(path):
            with alone(path):
                # what says that it is a demo's goes last: whoever is interrupted can delete the rest with the same command
                for inner in sorted(path.iterdir(), key=lambda inner: inner.name == "config.yml"):
                    if inner.name == ".lock":  # it is open, which some systems do not let one delete
                        continue
                    shutil.rmtree(inner) if inner.is_dir() else inner.unlink()
            shutil.rmtree(path, ignore_errors=True)
    for name in ("learning_curve.png", "results.json"):
        (folder / name).unlink(missing_ok=True)


def _is_run_of_demo(path: Path) -> bool:
    """By what is recorded there: the name alone may be that of a folder of the user's own."""
    try:
        config = read_config(path)
    except CheckpointError:
        return False
    run = {} if config is None else config["run"]
    is_ours = run.get("dataset") == DATASET and run.get("algo") in ("dce", "offline_bc")
    return is_ours and path.name == f"{run['algo']}_{run.get('seed')}"


def _random_returns(rollouts: Rollouts) -> list[float]:
    """Return of one episode per environment with uniform actions."""
    space = dataset_spaces(resolve(DATASET))[1]
    space.seed(0)
    return list(rollouts.play(lambda obs: np.stack([space.sample() for _ in obs]), seed=0).returns)


def _means(results: list[dict[str, Any]], algo: str) -> list[float]:
    return [result["mean_return"] for result in results if result["config"]["algo"] == algo]


def _seconds(results: list[dict[str, Any]], algo: str) -> float:
    return float(np.mean([result["seconds"] for result in results if result["config"]["algo"] == algo]))


def _print_table(table: dict[str, list[float]], seconds: dict[str, float], n_seeds: int, console: Console) -> None:
    view = Table(box=None, header_style="bold")
    for title in ("agent", "return", "normalised score", "over", "seconds"):
        view.add_column(title, justify="left" if title in ("agent", "over") else "right")
    over = {"random": f"{N_EVAL_EPISODES} episodes", "data": f"{len(table['data'])} episodes of the data"}
    for name, values in table.items():
        scores = normalized_score(DATASET, np.asarray(values))
        view.add_row(
            name,
            f"{np.mean(values):.1f} ± {np.std(values):.1f}",
            f"{np.mean(scores):.1f}",
            over.get(name, f"{n_seeds} seeds x {N_EVAL_EPISODES} episodes (± over seeds)"),
            f"{seconds[name]:.0f}" if name in seconds else "-",
        )
    console.print()
    console.print(view)


def _write_results(folder: Path, table: dict[str, list[float]]) -> None:
    rows = {
        name: {"returns": values, "normalized_score": float(normalized_score(DATASET, np.mean(values)))}
        for name, values in table.items()
    }
    write_text(folder / "results.json", json.dumps(rows, indent=1))
