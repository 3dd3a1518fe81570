"""
Microseconds per environment step of an evaluation, against ``evaluate_policy`` and against the physics alone.

    python benchmarks/evaluation.py --policies <folder of .npz policies>     # about five minutes
    python benchmarks/evaluation.py                                          # untrained actors, which fall at once

Part one: all ways take turns in one process pinned to one core, ratios are formed within a turn, and what counts is processor
time. Each way's returns are compared with those of ``evaluate_policy`` on as many environments, to the last digit; a
difference ends the measurement. "Physics" replays the actions of the ten episodes with nothing but MuJoCo's step: no way of
evaluating in these environments on one core can be faster. Part two: many policies in worker processes, not pinned.

A policy's file name ends in the name of the task, such as ``sac-400k-Hopper.npz`` or ``sac-Hopper-400k.npz``. Writes
``results/evaluation.json`` and ``results/evaluation.md`` beside this file and prints the latter. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from loading import RESULTS, machine
from recording import find_policies
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dce import OfflineDCE
from sb3_dce.data.hashes import file_sha256
from sb3_dce.envs import make_env_if_possible, without_bookkeeping
from sb3_dce.evaluation import evaluation_seed
from sb3_dce.evaluation_pool import EvaluationPool
from sb3_dce.numpy_policy import MLPPolicy
from sb3_dce.recording.policy_files import load_policy
from sb3_dce.rollouts import Act, Rollouts, deterministic_act, make_rollouts

DATASETS = {"HalfCheetah-v4": "halfcheetah-medium-v2", "Hopper-v4": "hopper-medium-v2", "Walker2d-v4": "walker2d-medium-v2"}
N_SIDE_BY_SIDE, N_IN_TURN = 10, 2
ONE, DUMMY, OURS, OURS_ONE, PHYSICS = (
    "evaluate_policy, 1 environment",
    f"evaluate_policy, DummyVecEnv of {N_SIDE_BY_SIDE}",
    f"sb3_dce, {N_SIDE_BY_SIDE} environments",
    "sb3_dce, 1 environment",
    "physics alone",
)
WAYS = (ONE, DUMMY, OURS, OURS_ONE, PHYSICS)
N_POLICIES = 8

Sample = dict[str, float]
# Plays whole episodes and returns steps and, but for the physics, returns.
Play = Callable[[], tuple[int, Any]]


def make_model(dataset_id: str, policy: str | None) -> OfflineDCE:
    """
    :param dataset_id: of the catalogue
    :param policy: file of an actor with two layers of 256 units and ReLU; ``None`` for random weights
    :return: agent
    """
    model = OfflineDCE("MlpPolicy", make_env_if_possible(dataset_id), seed=0, device="cpu")
    if policy is None:
        return model
    assert isinstance(model.observation_space, spaces.Box) and isinstance(model.action_space, spaces.Box)
    loaded, _ = load_policy(policy, model.observation_space, model.action_space)
    assert isinstance(loaded, MLPPolicy) and loaded.activation == "relu" and loaded.normalizer is None
    actor: Any = model.policy.actor
    with th.no_grad():
        for linear, (weight, bias) in zip((actor.latent_pi[0], actor.latent_pi[2], actor.mu), loaded.layers, strict=True):
            linear.weight.copy_(th.from_numpy(weight.T))
            linear.bias.copy_(th.from_numpy(bias))
    return model


def make_ways(dataset_id: str, model: OfflineDCE, seed: int) -> dict[str, Play]:
    """
    :param dataset_id: of the catalogue
    :param model: what is evaluated
    :param seed: of the first environment
    :return: what is measured
    """

    def stable_baselines3(n_envs: int, n_episodes: int) -> Play:
        env = DummyVecEnv([lambda: Monitor(make_env_if_possible(dataset_id)) for _ in range(n_envs)])

        def play() -> tuple[int, Any]:
            env.seed(seed)
            returns, lengths = evaluate_policy(model, env, n_episodes, return_episode_rewards=True)
            assert isinstance(returns, list) and isinstance(lengths, list)
            return sum(lengths), (returns, lengths)

        return play

    def ours(n_envs: int, n_episodes: int) -> Play:
        rollouts = make_rollouts(dataset_id, n_episodes, n_envs)
        assert rollouts is not None

        def play() -> tuple[int, Any]:
            episodes = rollouts.play(deterministic_act(model), seed)
            return sum(episodes.lengths), (list(episodes.returns), list(episodes.lengths))

        return play

    return {
        ONE: stable_baselines3(1, N_IN_TURN),
        DUMMY: stable_baselines3(N_SIDE_BY_SIDE, N_SIDE_BY_SIDE),
        OURS: ours(N_SIDE_BY_SIDE, N_SIDE_BY_SIDE),
        OURS_ONE: ours(1, N_IN_TURN),
        PHYSICS: physics(dataset_id, deterministic_act(model), seed),
    }


def physics(dataset_id: str, act: Act, seed: int) -> Play:
    """
    The episodes of :data:`OURS` again, with MuJoCo's step alone.

    :param dataset_id: of the catalogue
    :param act: the policy, asked once, before anything is measured
    :param seed: of the first environment
    :return: what is measured
    """
    import mujoco

    taken: list[np.ndarray] = []

    def recorded(obs: np.ndarray) -> np.ndarray:
        taken.append(act(obs))
        return taken[-1]

    rollouts = make_rollouts(dataset_id, N_SIDE_BY_SIDE)
    assert rollouts is not None
    endings = rollouts.play_rows(recorded, seed, range(N_SIDE_BY_SIDE))
    lengths = {ending.row: ending.length for ending in endings}
    envs: list[Any] = [without_bookkeeping(make_env_if_possible(dataset_id))[0] for _ in range(N_SIDE_BY_SIDE)]
    simulators = [(env.model, env.data, env.data.ctrl) for env in envs]
    running = [[row for row in range(N_SIDE_BY_SIDE) if lengths[row] > t] for t in range(len(taken))]
    mj_step, frame_skip = mujoco.mj_step, envs[0].frame_skip

    def play() -> tuple[int, Any]:
        for row, env in enumerate(envs):
            env.reset(seed=seed + row)
        for rows, actions in zip(running, taken, strict=True):
            for row in rows:
                model, data, ctrl = simulators[row]
                ctrl[:] = actions[row]
                mj_step(model, data, frame_skip)
        return sum(lengths.values()), None

    return play


def measure(ways: dict[str, Play], turns: int) -> dict[str, list[Sample]]:
    """
    :param ways: what is measured
    :param turns: of each, after one that is not counted
    :return: by way and turn, microseconds of processor and wall-clock time per step
    :raises SystemExit: if a way's returns are not those of ``evaluate_policy``
    """
    samples: dict[str, list[Sample]] = {name: [] for name in ways}
    for turn in range(turns + 1):
        outcomes = {}
        for name, play in ways.items():
            wall, cpu = time.perf_counter(), time.process_time()
            n_steps, outcomes[name] = play()
            spent = (time.perf_counter() - wall, time.process_time() - cpu)
            if turn:
                samples[name].append({"cpu_us": 1e6 * spent[1] / n_steps, "wall_us": 1e6 * spent[0] / n_steps})
        if outcomes[OURS] != outcomes[DUMMY] or outcomes[OURS_ONE] != outcomes[ONE]:
            sys.exit(f"other returns than evaluate_policy: {outcomes}")
    return samples


def measure_workers(datasets: list[str], models: list[OfflineDCE]) -> list[dict[str, float]]:
    """
    :param datasets: one for each model
    :param models: what is evaluated, in turn, :data:`N_POLICIES` times
    :return: by number of workers (0: this process), seconds to the first result and steps per wall-clock second afterwards
    """
    all_rollouts = [make_rollouts(dataset, N_SIDE_BY_SIDE) for dataset in datasets]
    rows = []
    for n_workers in range((os.cpu_count() or 1) + 1):
        with EvaluationPool(n_workers) as pool:

            def play(seed: int, pool: EvaluationPool = pool, parts: int = 1) -> int:
                jobs = list(zip(models, all_rollouts, strict=True)) * -(-N_POLICIES // len(models))
                pending = [pool.submit(model, some, seed, parts) for model, some in jobs if isinstance(some, Rollouts)]
                return sum(sum(episodes.result().lengths) for episodes in pending)

            started = time.perf_counter()
            play(0)  # starts the workers and makes their environments
            first = time.perf_counter() - started
            started = time.perf_counter()
            n_steps = sum(play(evaluation_seed(0, index)) for index in (1, 2))
            seconds = time.perf_counter() - started
        rows.append({"workers": n_workers, "first_seconds": first, "steps_per_second": n_steps / seconds})
        print(f"  {n_workers} workers: {n_steps / seconds:,.0f} steps per second", file=sys.stderr)
    return rows


def report(results: dict[str, dict[str, list[Sample]]], workers: list[dict[str, float]], facts: dict[str, Any]) -> str:
    """
    :param results: environment to way to samples
    :param workers: from :func:`measure_workers`
    :param facts: what else belongs into the report
    :return: Markdown
    """
    lines = [
        "# Evaluation",
        "",
        "Microseconds of processor time per environment step, one core, median (smallest to largest) of "
        f"{facts['turns']} turns; {N_SIDE_BY_SIDE} episodes side by side, {N_IN_TURN} in turn where there is one environment."
        " The returns of both "
        "packages were equal to the last digit in every turn.",
        "",
        f"| environment | way | CPU us per step | wall / CPU | times `{ONE}` | of the physics |",
        "|---|---|---|---|---|---|",
    ]
    for env, samples in results.items():
        for name in WAYS:
            cpu = [sample["cpu_us"] for sample in samples[name]]
            waits = statistics.median(sample["wall_us"] / sample["cpu_us"] for sample in samples[name])
            faster, floor = (
                statistics.median(a["cpu_us"] / b["cpu_us"] for a, b in zip(*pair, strict=True))
                for pair in ((samples[ONE], samples[name]), (samples[name], samples[PHYSICS]))
            )
            lines.append(
                f"| {env} | {name} | {statistics.median(cpu):.1f} ({min(cpu):.1f} to {max(cpu):.1f}) | {waits:.2f} "
                f"| {faster:.1f} | {floor:.2f} |"
            )
    lines += [
        "",
        '"times" of the physics is the limit on one core: where it is below 7, no evaluation in MuJoCo can be 7 times as fast '
        "as `evaluate_policy`.",
        "",
        f"Policies: {facts['policies']}.",
        "",
        "## Worker processes",
        "",
        f"{N_POLICIES} policies or more, {N_SIDE_BY_SIDE} episodes each, wall-clock time, not pinned; 0 workers is this "
        f"process. {os.cpu_count()} cores, on which other programs may run (load averages below).",
        "",
        "| workers | first results after, s | steps per second afterwards |",
        "|---|---|---|",
        *(f"| {row['workers']} | {row['first_seconds']:.1f} | {row['steps_per_second']:,.0f} |" for row in workers),
        "",
        f"Load averages before: {facts['load_before']}, after: {facts['load_after']}. "
        + ", ".join(f"{name} {value}" for name, value in machine().items())
        + f". `{facts['command']}`, seed 0.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", type=Path, help="folder of policies (.npz) with the name of their task")
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the results")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    th.set_num_threads(1)
    found = {} if arguments.policies is None else {env: path for path, env in find_policies(arguments.policies).items()}
    models = {env: make_model(dataset_id, found.get(env)) for env, dataset_id in DATASETS.items()}
    described = [f"{Path(path).name} (sha256 {file_sha256(Path(path))[:8]})" for path in found.values()]
    command = f"python benchmarks/evaluation.py --turns {arguments.turns}" + (" --policies <folder>" if found else "")
    facts: dict[str, Any] = {
        "turns": arguments.turns,
        "policies": ", ".join(described) or "random weights",
        "command": command,
    }
    facts["load_before"] = [round(x, 1) for x in os.getloadavg()]
    workers = measure_workers(list(DATASETS.values()), list(models.values()))
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    results = {}
    for env, dataset_id in DATASETS.items():
        results[env] = measure(make_ways(dataset_id, models[env], evaluation_seed(0, 0)), arguments.turns)
        print(f"  {env} measured", file=sys.stderr)
    facts["load_after"] = [round(x, 1) for x in os.getloadavg()]
    text = report(results, workers, facts)
    arguments.output.mkdir(parents=True, exist_ok=True)
    content = {**facts, "machine": machine(), "measurements": results, "workers": workers}
    (arguments.output / "evaluation.json").write_text(json.dumps(content, indent=1) + "\n")
    (arguments.output / "evaluation.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
