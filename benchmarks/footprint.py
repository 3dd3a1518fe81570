"""
What the package adds: seconds of importing, seconds until the first update, memory of a model with its data, size of its zip.

    python benchmarks/footprint.py                      # a million rows, 5 repeats, about five minutes
    python benchmarks/footprint.py --rows 100000 --repeats 3

Each measurement is a process of its own; the ways take turns. Stable-Baselines3's SAC with a replay buffer of as many rows
stands beside the agents. Files lie in a temporary folder and are in the page cache. Writes ``results/footprint.json`` and
``results/footprint.md`` beside this file and prints the latter. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from loading import ACT_DIM, OBS_DIM, RESULTS, WIDTH, machine, make_arrays, memory

# Aims: seconds that importing adds, and seconds from the import to the first eager update.
IMPORT_AIM, FIRST_UPDATE_AIM = 0.3, 2.0

Measured = dict[str, float]


def import_package(folder: Path) -> Measured:
    """Importing the package after Stable-Baselines3, and then its agents."""
    sb3 = timed(lambda: __import__("stable_baselines3"))
    package = timed(lambda: __import__("sb3_dce"))
    agent = timed(lambda: __import__("sb3_dce").OfflineDCE)
    return {**named("sb3", sb3), **named("package", package), **named("agent", agent)}


def first_update(folder: Path) -> Measured:
    """From a Python with Stable-Baselines3 to the end of one eager update on a whole dataset."""
    sb3 = timed(lambda: __import__("stable_baselines3"))

    def train() -> None:
        from sb3_dce import OfflineDCE

        path = str(folder / "contiguous.hdf5")
        OfflineDCE("MlpPolicy", make_env(), path, execution="eager", seed=0, device="cpu").learn(1)

    return {**named("sb3", sb3), **named("first_update", timed(train))}


def first_online_update(folder: Path) -> Measured:
    """The same for SAC of Stable-Baselines3 with a single transition, so without reading data."""
    sb3 = timed(lambda: __import__("stable_baselines3"))
    env = make_env()

    def train() -> None:
        import numpy as np
        from stable_baselines3 import SAC
        from stable_baselines3.common.logger import Logger

        model = SAC("MlpPolicy", env, buffer_size=1, seed=0, device="cpu")
        obs, actions = np.zeros((1, OBS_DIM)), np.zeros((1, ACT_DIM))
        assert model.replay_buffer is not None
        model.replay_buffer.add(obs, obs, actions, np.zeros(1), np.zeros(1), [{}])
        model.set_logger(Logger(None, []))
        model.train(1, 256)

    return {**named("sb3", sb3), **named("first_update", timed(train))}


def offline(folder: Path) -> Measured:
    """An agent with its data: resident memory before and after, and the file it saves."""
    from sb3_dce import OfflineDCE

    env, before = make_env(), memory("VmRSS")
    model = OfflineDCE("MlpPolicy", env, str(folder / "contiguous.hdf5"), execution="eager", seed=0, device="cpu")
    without = memory("VmRSS")
    model.learn(100)
    zip_path = folder / "offline.zip"
    model.save(zip_path)
    return {"networks": without - before, "all": memory("VmRSS") - before, "zip": zip_path.stat().st_size}


def online(folder: Path) -> Measured:
    """SAC of Stable-Baselines3 with a full replay buffer."""
    from speed import filled_sac
    from stable_baselines3 import SAC

    from sb3_dce import Transitions

    transitions = Transitions.from_hdf5(folder / "contiguous.hdf5")
    env, before = make_env(), memory("VmRSS")
    small = SAC("MlpPolicy", env, buffer_size=1, seed=0, device="cpu")
    without = memory("VmRSS")
    model = filled_sac(transitions, "cpu")
    model.train(100, 256)
    zip_path = folder / "online.zip"
    model.save(zip_path)
    del small
    return {"networks": without - before, "all": memory("VmRSS") - before, "zip": zip_path.stat().st_size}


def worker(folder: Path) -> Measured:
    """A worker process of an evaluation, after ten episodes of HalfCheetah side by side."""
    from sb3_dce import OfflineDCE
    from sb3_dce.envs import make_env_if_possible
    from sb3_dce.evaluation_pool import EvaluationPool
    from sb3_dce.rollouts import make_rollouts

    dataset_id = "halfcheetah-medium-v2"
    rollouts = make_rollouts(dataset_id, 10)
    assert rollouts is not None
    model = OfflineDCE("MlpPolicy", make_env_if_possible(dataset_id), seed=0, device="cpu")
    with EvaluationPool(1) as pool:
        started = time.perf_counter()
        pool.submit(model, rollouts, 0).result()
        seconds = time.perf_counter() - started
        assert pool._executor is not None
        (pid,) = pool._executor._processes
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    own = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))
    return {"worker": own, "first_result_s": seconds}


def make_env() -> Any:
    """
    :return: spaces of HalfCheetah
    """
    import numpy as np
    from gymnasium import spaces

    from sb3_dce.envs import SpacesEnv

    return SpacesEnv(spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float64), spaces.Box(-1, 1, (ACT_DIM,), np.float32))


WAYS: dict[str, Callable[[Path], Measured]] = {
    "import": import_package,
    "first update": first_update,
    "first online update": first_online_update,
    "offline": offline,
    "online": online,
    "worker": worker,
}


def timed(function: Callable[[], Any]) -> tuple[float, float]:
    """
    :param function: what is timed
    :return: wall-clock and processor seconds
    """
    wall, cpu = time.perf_counter(), time.process_time()
    function()
    return time.perf_counter() - wall, time.process_time() - cpu


def named(name: str, seconds: tuple[float, float]) -> Measured:
    """
    :param name: of what was timed
    :param seconds: from :func:`timed`
    :return: the same with names
    """
    return {f"{name}_wall_s": seconds[0], f"{name}_cpu_s": seconds[1]}


def measure_all(folder: Path, repeats: int) -> dict[str, list[Measured]]:
    """
    :param folder: of the files
    :param repeats: rounds that count; one more comes first, which fills the caches
    :return: way to measurements
    """
    results: dict[str, list[Measured]] = {way: [] for way in WAYS}
    for number in range(repeats + 1):
        for way in WAYS:
            command = [sys.executable, __file__, "--measure", way, "--folder", str(folder)]
            output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
            if number:
                results[way].append(json.loads(output.splitlines()[-1]))
            print(f"round {number} of {repeats}: {way}", file=sys.stderr)
    return results


def report(results: dict[str, list[Measured]], facts: dict[str, Any]) -> str:
    """
    :param results: from :func:`measure_all`
    :param facts: rows, repeats, machine and load
    :return: Markdown
    """

    def seconds(way: str, name: str) -> str:
        wall, cpu = ([sample[f"{name}_{kind}_s"] for sample in results[way]] for kind in ("wall", "cpu"))
        return f"{statistics.median(cpu):.2f} ({min(cpu):.2f} to {max(cpu):.2f}) | {statistics.median(wall):.2f}"

    def megabytes(way: str, name: str) -> str:
        return f"{statistics.median(sample[name] for sample in results[way]) / 1e6:,.1f}"

    rows = facts["rows"]
    lines = [
        "# Start-up, memory and files",
        "",
        f"Median (smallest to largest) of {facts['repeats']} processes each, one thread, files and modules in the page cache. "
        f"Data: {rows:,} rows of HalfCheetah's width ({rows * WIDTH * 4 / 1e6:.0f} MB as rows of float32), random numbers.",
        "",
        "| | processor s | wall-clock s | aim |",
        "|---|---|---|---|",
        f"| `import stable_baselines3` | {seconds('import', 'sb3')} | |",
        f"| `import sb3_dce` after it | {seconds('import', 'package')} | {IMPORT_AIM} |",
        f"| `sb3_dce.OfflineDCE` after that | {seconds('import', 'agent')} | |",
        "| after importing Stable-Baselines3: `OfflineDCE` imported and made, the file read and checked, one eager update | "
        f"{seconds('first update', 'first_update')} | {FIRST_UPDATE_AIM} |",
        "| the same with SAC of Stable-Baselines3 and a single transition | "
        f"{seconds('first online update', 'first_update')} | |",
        "",
        "Most of a first update is PyTorch's: the first optimizer of a process imports its compiler, for SAC as well.",
        "",
        "| | OfflineDCE | SAC of Stable-Baselines3 |",
        "|---|---|---|",
        f"| resident memory of a model without data, MB | {megabytes('offline', 'networks')} | "
        f"{megabytes('online', 'networks')} |",
        f"| with {rows:,} rows, after 100 updates, MB | {megabytes('offline', 'all')} | {megabytes('online', 'all')} |",
        f"| saved zip, MB | {megabytes('offline', 'zip')} | {megabytes('online', 'zip')} |",
        "",
        f"A worker process of an evaluation (ten HalfCheetahs side by side) has {megabytes('worker', 'worker')} MB of its "
        "own, its share of common pages included; its first result was there after "
        f"{statistics.median(sample['first_result_s'] for sample in results['worker']):.1f} s.",
        "",
        f"Load averages before: {facts['load_before']}, after: {facts['load_after']}. "
        + ", ".join(f"{name} {value}" for name, value in facts["machine"].items())
        + f". `python benchmarks/footprint.py --rows {rows} --repeats {facts['repeats']}`",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure and write the report; as a child, one measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--measure", choices=WAYS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        warnings.simplefilter("ignore")
        print(json.dumps(WAYS[arguments.measure](arguments.folder)))
        return
    facts: dict[str, Any] = {"rows": arguments.rows, "repeats": arguments.repeats}
    facts |= {"load_before": [round(x, 1) for x in os.getloadavg()], "machine": machine()}
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as name:
        write_contiguous(Path(name), arguments.rows)
        results = measure_all(Path(name), arguments.repeats)
    facts["load_after"] = [round(x, 1) for x in os.getloadavg()]
    text = report(results, facts)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "footprint.json").write_text(json.dumps({**facts, "measurements": results}, indent=1) + "\n")
    (arguments.output / "footprint.md").write_text(text)
    print(text)


def write_contiguous(folder: Path, n_rows: int) -> None:
    """
    :param folder: where ``contiguous.hdf5`` is written
    :param n_rows: its rows
    """
    import h5py

    with h5py.File(folder / "contiguous.hdf5", "w") as file:
        for key, array in make_arrays(n_rows).items():
            file.create_dataset(key, data=array)


if __name__ == "__main__":
    main()
