"""
Updates per second on a CUDA device: one model in every way of running it, and populations of 5, 20 and 60.

    python benchmarks/gpu.py            # one table in under ten minutes

Data are random numbers of HalfCheetah's shape: speed only, no statement about returns. Writes ``results/gpu.json`` and
``results/gpu.md`` beside this file and prints the latter.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch as th
from loading import RESULTS, machine, make_arrays
from speed import BATCH, filled_sac, make_env

from sb3_dce import OfflineDCE, Transitions
from sb3_dce.population import Population


def updates_per_second(train: Callable[[int], None], device: th.device, seconds: float) -> list[float]:
    """
    :param train: runs so many updates
    :param device: where they run
    :param seconds: about how long each of three repeats lasts
    :return: updates per second of each
    """

    def run(n: int) -> None:
        train(n)
        if device.type == "cuda":
            th.cuda.synchronize(device)

    run(30)  # compiling, capturing, tuning
    started = time.perf_counter()
    run(30)
    n = max(30, round(30 * seconds / (time.perf_counter() - started)))
    rates = []
    for _ in range(3):
        started = time.perf_counter()
        run(n)
        rates.append(n / (time.perf_counter() - started))
    return rates


def main() -> None:
    """Measure, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--members", default="5,20,60")
    parser.add_argument("--device", default="cuda", help="only to try the script: 'cpu' says nothing")
    parser.add_argument("--out", type=Path, default=RESULTS / "gpu")
    options = parser.parse_args()
    device = th.device(options.device)
    if device.type == "cuda" and not th.cuda.is_available():
        sys.exit("This measures a CUDA device, and PyTorch finds none.")

    name_of_device = th.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
    facts = {**machine(), "device": name_of_device, "date": time.strftime("%Y-%m-%d"), "rows": options.rows, "run as": {}}
    transitions = Transitions.from_arrays(**make_arrays(options.rows))
    common: dict[str, Any] = {"env": make_env(), "dataset": transitions, "batch_size": BATCH, "seed": 0}
    results: dict[str, list[float]] = {}

    def measured(name: str, train: Callable[[int], None], trained: Any = None, members: int = 1) -> None:
        results[name] = [members * rate for rate in updates_per_second(train, device, options.seconds)]
        if trained is not None:  # the compiler may be missing or have failed
            engine = trained._engine
            uncompiled = engine.execution == "cudagraph" and not engine.is_compiled
            facts["run as"][name] = engine.execution + (", not compiled" if uncompiled else "")
        print(f"  {name}: {max(results[name]):,.0f} updates/s {facts['run as'].get(name, '')}", flush=True)
        write(options.out, facts, results)  # at once: the time on the device may end

    sac = filled_sac(transitions, options.device)
    measured("SAC.train of Stable-Baselines3", lambda n: sac.train(n, BATCH))
    for precision in ("float32", "tf32"):
        for execution in ("eager", "compile", "cudagraph") if precision == "float32" else ("cudagraph",):
            model = OfflineDCE("MlpPolicy", execution=execution, precision=precision, device=options.device, **common)
            name = f"DCE, {execution}, {precision}"
            measured(name, lambda n, model=model: model.train(n, BATCH), model)
        for k in map(int, options.members.split(",")):
            members = [
                OfflineDCE("MlpPolicy", precision=precision, device="cpu", **{**common, "seed": seed}) for seed in range(k)
            ]
            population = Population(members, options.device, "cudagraph")
            measured(f"{k} x DCE, cudagraph, {precision}", lambda n, p=population: p.train(n), population, k)
            del population, members
    print(write(options.out, facts, results))


def write(out: Path, facts: dict[str, Any], results: dict[str, list[float]]) -> str:
    """
    :param out: files without ending
    :param facts: machine, versions, settings
    :param results: member-updates per second of each repeat, by name
    :return: Markdown, also written
    """
    lines = [
        f"# Updates per second on {facts['device']}",
        "",
        f"PyTorch {facts['torch']}, {facts['date']}; batch {BATCH}, 256-256 networks, random numbers of HalfCheetah's shape. "
        "Best of three repeats; a population counts the updates of all members.",
        "",
        "| | run as | member-updates/s | least - most |",
        "|---|---|---|---|",
    ]
    for name, rates in results.items():
        way = facts["run as"].get(name, "-")
        lines.append(f"| {name} | {way} | {max(rates):,.0f} | {min(rates):,.0f} - {max(rates):,.0f} |")
    text = "\n".join(lines) + "\n"
    out.parent.mkdir(parents=True, exist_ok=True)
    document = json.dumps({"facts": facts, "rates": results}, indent=1)
    out.with_suffix(".json").write_text(document + "\n", encoding="utf-8")
    out.with_suffix(".md").write_text(text, encoding="utf-8")
    return text


if __name__ == "__main__":
    main()
