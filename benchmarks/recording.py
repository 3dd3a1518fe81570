"""
Environment steps per second of ``sb3-dce datasets record`` with one worker, writing included.

    python benchmarks/recording.py --policies <folder of .npz policies>     # about three minutes
    python benchmarks/recording.py                                          # random actions and an untrained actor only

The process is pinned to one core, and the ways take turns. What counts is processor time, so that a busy machine disturbs
less; its caches are still shared. A policy's file name ends in the name of the task, such as ``sac-Hopper.npz``. Writes
``results/recording.json`` and ``results/recording.md`` beside this file and prints the latter. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from loading import RESULTS, machine

from sb3_dce.numpy_policy import MLPPolicy
from sb3_dce.recording import RecordingSpec, record
from sb3_dce.recording.policy_files import write_npz_policy

TASKS = {"HalfCheetah": (17, 6), "Hopper": (11, 3), "Walker2d": (17, 6)}
WIDTH = 256


def untrained_actor(folder: Path) -> Path:
    """
    :param folder: where it is written
    :return: file of a SAC actor for HalfCheetah with two layers of 256 units and random weights
    """
    obs_dim, act_dim = TASKS["HalfCheetah"]
    rng, sizes = np.random.default_rng(0), (obs_dim, WIDTH, WIDTH, act_dim)
    layers = [(rng.normal(0, n**-0.5, (n, m)), np.zeros(m)) for n, m in pairwise(sizes)]
    log_std = (rng.normal(0, 0.1 * WIDTH**-0.5, (WIDTH, act_dim)), np.full(act_dim, -1.0))
    policy = MLPPolicy(layers, "relu", -np.ones(act_dim), np.ones(act_dim), squash="draw", log_std=log_std)
    path = folder / "untrained-HalfCheetah.npz"
    write_npz_policy(policy, path, {"algo": "sac", "source": "random weights"})
    return path


def find_policies(folder: Path) -> dict[str, str]:
    """
    :param folder: searched with its folders
    :return: path of each policy of a known task to the environment
    """
    found = {}
    for path in sorted(folder.glob("**/*.npz")):
        match = re.search("|".join(TASKS), path.stem)
        if match is not None:
            found[str(path)] = f"{match[0]}-v4"
    return found


def measure(policy: str, env: str, n_rows: int, folder: Path) -> dict[str, float]:
    """
    :param policy: file, or ``random``
    :param env: id
    :param n_rows: rows
    :param folder: where the file is written
    :return: steps per second of processor and of wall-clock time, and rows per episode
    """
    started, cpu_started = time.monotonic(), time.process_time()
    made = record(RecordingSpec(policy, env), folder / "x-sb3.hdf5", n_rows=n_rows, force=True)
    seconds, cpu_seconds = time.monotonic() - started, time.process_time() - cpu_started
    length = float(made.attrs.get("length_mean", n_rows))
    return {"per_cpu_second": n_rows / cpu_seconds, "per_second": n_rows / seconds, "episode_length": length}


def report(results: dict[str, list[dict[str, float]]], facts: dict[str, object]) -> str:
    """
    :param results: name of a way to its measurements
    :param facts: what else belongs into the report
    :return: Markdown
    """
    lines = [
        "# Recording with one worker",
        "",
        f"Environment steps per processor second, {facts['rows']:,} rows each time, median (smallest to largest) of "
        f"{facts['repeats']}; compressing and writing the file is included. Actors have two layers of 256 units unless their "
        "file says otherwise; resets count where episodes are short.",
        "",
        "| environment | policy | steps per processor second | rows per episode |",
        "|---|---|---|---|",
    ]
    for name, samples in results.items():
        rates = [sample["per_cpu_second"] for sample in samples]
        lines.append(
            f"| {name} | {statistics.median(rates):,.0f} ({min(rates):,.0f} to {max(rates):,.0f}) "
            f"| {samples[0]['episode_length']:.0f} |"
        )
    described = ", ".join(f"{key} {value}" for key, value in machine().items())
    lines += ["", f"One core; load averages before {facts['load_before']}, after {facts['load_after']}. {described}.", ""]
    return "\n".join(lines)


def main() -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", type=Path, help="folder of policies (.npz) with the name of their task")
    parser.add_argument("--rows", type=int, default=40_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the results")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    facts: dict[str, object] = {"rows": arguments.rows, "repeats": arguments.repeats}
    facts["load_before"] = [round(x, 1) for x in os.getloadavg()]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ways = {f"{task}-v4 | random actions": ("random", f"{task}-v4") for task in TASKS}
        ways["HalfCheetah-v4 | untrained actor"] = (str(untrained_actor(folder)), "HalfCheetah-v4")
        if arguments.policies is not None:
            found = find_policies(arguments.policies)
            ways |= {f"{env} | {Path(path).name}": (path, env) for path, env in found.items()}
        results: dict[str, list[dict[str, float]]] = {way: [] for way in sorted(ways)}
        for _ in range(arguments.repeats):
            for way, samples in results.items():
                samples.append(measure(*ways[way], arguments.rows, folder))
    facts["load_after"] = [round(x, 1) for x in os.getloadavg()]
    text = report(results, facts)
    arguments.output.mkdir(parents=True, exist_ok=True)
    content = {**facts, "machine": machine(), "measurements": results}
    (arguments.output / "recording.json").write_text(json.dumps(content, indent=1) + "\n")
    (arguments.output / "recording.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
