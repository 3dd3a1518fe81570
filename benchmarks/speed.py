"""
Seconds per 1000 updates of every agent and way of running it, against Stable-Baselines3's SAC on the same core.

    python benchmarks/speed.py                           # everything; about twenty minutes
    python benchmarks/speed.py --only dce,offline_sac --repeats 9

CQL and UWAC are measured after their first phases, in which the actor ignores the critics, which is cheaper and 4 % of a run.
All entries take turns in one process pinned to one core, so that whatever else the machine does hits all of them alike;
ratios are formed within a turn. Data are random numbers of HalfCheetah's shape: speed only, no statement about returns.
Writes ``results/speed.json`` and ``results/speed.md`` beside this file and prints the latter.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
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
from loading import ACT_DIM, OBS_DIM, RESULTS, machine, make_arrays
from sb3_manner import SB3MannerDCE
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

from sb3_dce import Transitions
from sb3_dce.agents import AGENTS
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.envs import SpacesEnv
from sb3_dce.warm_up import ActorWarmUp

BATCH = 256
SAC_NAME = "SAC.train of Stable-Baselines3"
MANNER_NAME = "DCE in Stable-Baselines3's manner"
# One entry's turn should last about this long (s): long against the clock, short against changes of the machine's load.
TURN_SECONDS = 0.7
# What is compiled is what a run of this many updates would compile.
LONG_RUN = 1_000_000
# A turn in which the process waited for the core is counted in the report; its processor time is what counts.
MAX_WALL_PER_CPU = 1.05
# Multiply-adds of one DCE update per row of the batch, 256-256 networks (sum over its matrix products).
DCE_MACS = 1_748_736

Train = Callable[[int], None]


def make_env() -> SpacesEnv:
    """
    :return: spaces of HalfCheetah
    """
    return SpacesEnv(spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float64), spaces.Box(-1, 1, (ACT_DIM,), np.float32))


def filled_sac(transitions: Transitions, device: str) -> SAC:
    """
    :param transitions: data
    :param device: where the networks lie
    :return: SAC of Stable-Baselines3 with the data in its replay buffer
    """
    sac = SAC("MlpPolicy", make_env(), buffer_size=len(transitions), batch_size=BATCH, seed=0, device=device)
    buffer = sac.replay_buffer
    assert buffer is not None
    for name in ("observations", "next_observations", "actions"):
        getattr(buffer, name)[:, 0] = getattr(transitions, name)
    buffer.rewards[:, 0], buffer.full = transitions.rewards, True
    sac.set_logger(Logger(None, []))
    return sac


def make_agent(agent: type[OfflineAlgorithm], transitions: Transitions, execution: str, precision: str) -> OfflineAlgorithm:
    """
    :param agent: class
    :param transitions: data
    :param execution: "eager", "compile"
    :param precision: of the matrix products
    :return: agent on the processor, after its first phase if it has one
    """
    settings: dict[str, Any] = {"policy_eval_start": 0} if issubclass(agent, ActorWarmUp) else {}
    settings.update(execution=execution, precision=precision, batch_size=BATCH, seed=0, device="cpu")
    return agent("MlpPolicy", make_env(), transitions, **settings)


def make_entries(transitions: Transitions, only: list[str], executions: list[str], precision: str) -> dict[str, Train]:
    """
    :param transitions: data of all
    :param only: names of agents, empty for all
    :param executions: "eager", "compile"
    :param precision: of the agents' matrix products
    :return: by name, a function that runs so many updates
    """
    sac = filled_sac(transitions, "cpu")
    buffer = sac.replay_buffer
    assert buffer is not None
    entries: dict[str, Train] = {SAC_NAME: lambda n: sac.train(n, BATCH)}
    for algo, agent in AGENTS.items():
        if only and algo not in only:
            continue
        for execution in executions:
            model = make_agent(agent, transitions, execution, precision)
            model._total_timesteps = LONG_RUN
            entries[f"{algo}, {execution}"] = lambda n, model=model: model.train(n, BATCH)
            if algo == "dce" and MANNER_NAME not in entries:
                policy = make_agent(agent, transitions, "eager", "float32").policy
                entries[MANNER_NAME] = SB3MannerDCE(policy, buffer, BATCH).train
    return entries


def warm_up(entries: dict[str, Train]) -> tuple[dict[str, int], dict[str, float]]:
    """
    :param entries: what will be measured
    :return: by name, updates that fill one turn, and seconds of the first update (with compiling, if there is any)
    """
    updates, first = {}, {}
    for name, train in entries.items():
        started = time.perf_counter()
        train(1)
        first[name] = time.perf_counter() - started
        train(1)  # the second variant of agents with a delayed actor is compiled here
        started = time.process_time()
        train(4)
        seconds = (time.process_time() - started) / 4
        updates[name] = max(2, 2 * round(TURN_SECONDS / seconds / 2))
        print(f"  {name}: first update {first[name]:.1f} s, then {1000 * seconds:.1f} ms", flush=True)
    return updates, first


def measure(entries: dict[str, Train], updates: dict[str, int], repeats: int) -> dict[str, list[tuple[float, float]]]:
    """
    :param entries: what is measured
    :param updates: of each turn
    :param repeats: turns of each
    :return: by name and turn, wall and CPU seconds per 1000 updates
    """
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in entries}
    for turn in range(repeats):
        for name, train in entries.items():
            wall, cpu = time.perf_counter(), time.process_time()
            train(updates[name])
            spent = (time.perf_counter() - wall, time.process_time() - cpu)
            times[name].append((1000 * spent[0] / updates[name], 1000 * spent[1] / updates[name]))
        print(f"  turn {turn + 1} of {repeats}", flush=True)
    return times


def primitives() -> dict[str, float]:
    """
    :return: float32 matrix products of 256x256x256, GFLOP/s, and the least seconds 1000 updates of DCE can take with them
    """
    a, b = th.randn(256, 256), th.randn(256, 256)
    best = min(_timed(lambda: a @ b, 200) for _ in range(7))
    gflops = 2 * 256**3 / best / 1e9
    return {"sgemm256_gflops": gflops, "dce_floor_s_per_1000": 1000 * 2 * DCE_MACS * BATCH / gflops / 1e9}


def _timed(function: Callable[[], Any], n: int) -> float:
    started = time.process_time()
    for _ in range(n):
        function()
    return (time.process_time() - started) / n


def report(times: dict[str, list[tuple[float, float]]], first: dict[str, float], facts: dict[str, Any]) -> str:
    """
    :param times: from :func:`measure`
    :param first: seconds of each first update
    :param facts: machine, versions, settings
    :return: Markdown
    """
    # the second reference is measured with DCE only
    against = {SAC_NAME: "times SB3 SAC", MANNER_NAME: "times SB3-manner DCE"}
    references = {title: [cpu for _, cpu in times[name]] for name, title in against.items() if name in times}
    lines = [
        f"# Speed of updates, {facts['precision']}",
        "",
        f"{facts['processor']}, one core; Python {facts['python']}, PyTorch {facts['torch']}, {facts['date']}. "
        f"Batch {BATCH}, observations {OBS_DIM}, actions {ACT_DIM}, {facts['rows']:,} rows of random numbers: speed only, no "
        f"statement about returns. Each agent with its own default networks, CQL and UWAC after their first phases. "
        f"Medians over {facts['repeats']} turns; CPU "
        f"seconds, since other programs may run (wall/CPU in the last column but one). `{facts['command']}`",
        "",
        f"| | CPU s per 1000 updates | least - most | {' | '.join(references)} | wall/CPU | first update, s |",
        "|---|---|---|---|---|" + "---|" * len(references),
    ]
    for name, pairs in times.items():
        cpu = [pair[1] for pair in pairs]
        waits = statistics.median(wall / used for wall, used in pairs)
        ratios = [statistics.median(r / c for r, c in zip(theirs, cpu, strict=True)) for theirs in references.values()]
        lines.append(
            f"| {name} | {statistics.median(cpu):.2f} | {min(cpu):.2f} - {max(cpu):.2f} | "
            f"{' | '.join(f'{ratio:.2f}' for ratio in ratios)} | {waits:.2f} | {first[name]:.1f} |"
        )
    contended = sum(wall / cpu > MAX_WALL_PER_CPU for pairs in times.values() for wall, cpu in pairs)
    total = sum(len(pairs) for pairs in times.values())
    lines += [
        "",
        f"Matrix products of 256x256x256 reach {facts['sgemm256_gflops']:.0f} GFLOP/s here, so that 1000 updates of DCE "
        f"cannot take less than {facts['dce_floor_s_per_1000']:.2f} s. In {contended} of {total} turns the process waited for "
        f"the core (wall/CPU above {MAX_WALL_PER_CPU}).",
    ]
    return "\n".join(lines) + "\n"


def keep_to_one_core(core: int | None) -> None:
    """
    Run this process, with one thread, on one core from now on.

    :param core: its number; ``None`` for the last one
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0)) if core is None else core})
    th.set_num_threads(1)


def known_agents(parser: argparse.ArgumentParser, text: str) -> list[str]:
    """
    :param parser: ends the program if there is no such agent
    :param text: of ``--only``, names of agents separated by commas
    :return: names
    """
    names = [name for name in text.split(",") if name]
    if unknown := set(names) - set(AGENTS):
        parser.error(f"--only: no agent is called {', '.join(sorted(unknown))}; there are {', '.join(AGENTS)}")
    return names


def main() -> None:
    """Measure, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="agents, separated by commas; default: all")
    parser.add_argument("--executions", default="eager,compile")
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--core", type=int, default=None, help="core to run on; default: the last one")
    parser.add_argument("--out", type=Path, default=RESULTS / "speed")
    options = parser.parse_args()
    only = known_agents(parser, options.only)

    keep_to_one_core(options.core)
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    arrays = make_arrays(options.rows)
    transitions = Transitions.from_arrays(**arrays)
    del arrays
    entries = make_entries(transitions, only, options.executions.split(","), options.precision)
    updates, first = warm_up(entries)
    times = measure(entries, updates, options.repeats)
    facts = {
        **machine(),
        **primitives(),
        "date": time.strftime("%Y-%m-%d"),
        "command": shlex.join(["python", "benchmarks/speed.py", *sys.argv[1:]]),
        "rows": options.rows,
        "repeats": options.repeats,
        "precision": options.precision,
    }
    text = report(times, first, facts)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    document = {"facts": facts, "updates_per_turn": updates, "first_update_s": first, "wall_cpu_s_per_1000": times}
    options.out.with_suffix(".json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    options.out.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
