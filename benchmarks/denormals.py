"""
What computing denormal numbers as zero saves: seconds per 1000 updates with it, as training has it, and without.

    python benchmarks/denormals.py                 # CQL and DCE on the embedded data; up to half an hour
    python benchmarks/denormals.py --only offline_cql --dataset pen-expert-sb3

Such numbers come with training, so of each agent there are two models with one seed, trained to the same length; then these
take turns on one core.
Writes ``results/denormals.json`` and ``results/denormals.md`` beside this file and prints the latter.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shlex
import statistics
import sys
import time
from pathlib import Path
from typing import Any
from unittest import mock

import torch as th
from loading import RESULTS, machine
from speed import keep_to_one_core, known_agents
from stable_baselines3.common.logger import Logger

from sb3_dce.agents import AGENTS
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.data import find_file
from sb3_dce.data.hashes import sha256_once
from sb3_dce.warm_up import ActorWarmUp

WAYS = ("without", "as zero")


def train(model: OfflineAlgorithm, n: int, way: str) -> tuple[float, float]:
    """
    :param model: agent
    :param n: updates
    :param way: one of ``WAYS``
    :return: CPU and wall seconds
    """
    patched = mock.patch("sb3_dce.base.denormals_as_zero", contextlib.nullcontext)
    with patched if way == "without" else contextlib.nullcontext():
        wall, cpu = time.perf_counter(), time.process_time()
        model.train(n, model.batch_size)
        return time.process_time() - cpu, time.perf_counter() - wall


def share_of_denormals(model: OfflineAlgorithm) -> float:
    """
    :param model: agent
    :return: share of Adam's first moments that are denormal, of all networks
    """
    tiny = th.finfo(th.float32).tiny
    modules = [getattr(model, name) for name in model.networks]
    optimizers = [module.optimizer for module in modules if hasattr(module, "optimizer")]
    moments = [state["exp_avg"] for optimizer in optimizers for state in optimizer.state.values()]
    denormal = sum(int(((m.abs() < tiny) & (m != 0)).sum()) for m in moments)
    return denormal / sum(m.numel() for m in moments)


def measure(algo: str, dataset: str, execution: str, n_before: int, n_turn: int, repeats: int) -> dict[str, Any]:
    """
    :param algo: agent
    :param dataset: id or file
    :param execution: "eager" or "compile"
    :param n_before: updates before the first turn
    :param n_turn: updates of each turn
    :param repeats: turns of each way
    :return: CPU and wall seconds per 1000 updates by way and turn, shares of denormal moments before the first turn
    """
    settings: dict[str, Any] = {"policy_eval_start": 0} if issubclass(AGENTS[algo], ActorWarmUp) else {}
    models, shares = {}, {}
    for way in WAYS:
        model = AGENTS[algo].load_dataset(dataset, seed=0, device="cpu", execution=execution, verbose=0, **settings)
        model.set_logger(Logger(None, []))
        model._total_timesteps = 1_000_000  # what is compiled is what a long run would compile
        train(model, n_before, way)
        models[way], shares[way] = model, share_of_denormals(model)
        print(f"  {algo}, {way}: {n_before} updates, denormal moments {100 * shares[way]:.1f} %", flush=True)
    times: dict[str, list[list[float]]] = {way: [] for way in WAYS}
    for _ in range(repeats):
        for way in WAYS:
            times[way].append([1000 * seconds / n_turn for seconds in train(models[way], n_turn, way)])
    return {"cpu_wall_s_per_1000": times, "denormal_moments": shares}


def report(found: dict[str, dict[str, Any]], facts: dict[str, Any]) -> str:
    """
    :param found: by agent, from :func:`measure`
    :param facts: machine, versions, settings
    :return: Markdown
    """
    lines = [
        "# Denormal numbers",
        "",
        f"{facts['processor']}, one core; Python {facts['python']}, PyTorch {facts['torch']}, {facts['date']}. "
        f"{facts['dataset']} (sha256 {facts['sha256'][:8]}), {facts['execution']}, seed 0, after {facts['before']:,} updates: "
        f"CPU seconds per 1000 of them, medians over {facts['repeats']} turns of {facts['turn']}. `{facts['command']}`",
        "",
        "| | without | as zero | without / as zero | least - most | denormal first moments without | wall/CPU |",
        "|---|---|---|---|---|---|---|",
    ]
    for algo, numbers in found.items():
        without, zero = (numbers["cpu_wall_s_per_1000"][way] for way in WAYS)
        ratios = [a[0] / b[0] for a, b in zip(without, zero, strict=True)]
        waits = statistics.median(wall / cpu for cpu, wall in [*without, *zero])
        medians = [statistics.median(cpu for cpu, _ in turns) for turns in (without, zero)]
        lines.append(
            f"| {algo} | {medians[0]:.2f} | {medians[1]:.2f} | {statistics.median(ratios):.2f} | "
            f"{min(ratios):.2f} - {max(ratios):.2f} | {100 * numbers['denormal_moments']['without']:.1f} % | {waits:.2f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="offline_cql,dce", help="agents, separated by commas")
    parser.add_argument("--dataset", default="halfcheetah-demo-sb3")
    parser.add_argument("--execution", default="compile", choices=("eager", "compile"))
    parser.add_argument("--before", type=int, default=1500, help="updates before the first turn")
    parser.add_argument("--turn", type=int, default=20, help="updates of each turn")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--core", type=int, default=None, help="core to run on; default: the last one")
    parser.add_argument("--out", type=Path, default=RESULTS / "denormals")
    options = parser.parse_args()
    algos = known_agents(parser, options.only)
    keep_to_one_core(options.core)
    numbers = (options.before, options.turn, options.repeats)
    found = {algo: measure(algo, options.dataset, options.execution, *numbers) for algo in algos}
    facts = {
        **machine(),
        "date": time.strftime("%Y-%m-%d"),
        "command": shlex.join(["python", "benchmarks/denormals.py", *sys.argv[1:]]),
        "sha256": sha256_once(find_file(options.dataset)[0]),
        **{name: getattr(options, name) for name in ("dataset", "execution", "before", "turn", "repeats")},
    }
    text = report(found, facts)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.with_suffix(".json").write_text(json.dumps({"facts": facts, **found}, indent=1) + "\n", encoding="utf-8")
    options.out.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
