"""
Seconds and memory of loading a million steps, against filling Stable-Baselines3's replay buffer with ``add``.

    python benchmarks/loading.py                      # a million rows, 5 repeats, about ten minutes
    python benchmarks/loading.py --rows 100000 --repeats 3

Writes ``results/loading.json`` and ``results/loading.md`` beside this file and prints the latter. Each measurement is a
process of its own; the ways take turns, so that another load of the machine hits all of them alike. The files lie in a
temporary folder and are read once before, so that they are in the page cache: the disk is not measured. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

OBS_DIM, ACT_DIM, EPISODE_LENGTH = 17, 6, 1000  # HalfCheetah
WIDTH = 2 * OBS_DIM + ACT_DIM + 2
RESULTS = Path(__file__).parent / "results"


def make_arrays(n_rows: int) -> dict[str, np.ndarray]:
    """
    Steps with the widths and the episodes of HalfCheetah; observations are random walks, since noise does not compress.

    :param n_rows: number of steps
    :return: the keys of D4RL
    """
    rng = np.random.default_rng(0)
    steps = rng.standard_normal((n_rows + 1, OBS_DIM), dtype=np.float32) / 10
    walk = np.tanh(np.cumsum(steps, axis=0, dtype=np.float64) / 10).astype(np.float32)
    return {
        "observations": walk[:-1],
        "next_observations": walk[1:],
        "actions": rng.uniform(-1, 1, (n_rows, ACT_DIM)).astype(np.float32),
        "rewards": rng.standard_normal(n_rows, dtype=np.float32),
        "terminals": np.zeros(n_rows, dtype=bool),
        "timeouts": np.arange(1, n_rows + 1) % EPISODE_LENGTH == 0,
    }


def write_files(folder: Path, n_rows: int, n_csv_rows: int) -> None:
    """
    Write the steps in each format, and keep the rows of one of them.

    :param folder: where to
    :param n_rows: number of steps
    :param n_csv_rows: number of steps of the text file
    """
    import h5py
    import pandas as pd

    from sb3_dce.data import Transitions, write_hdf5

    arrays = make_arrays(n_rows)
    for name, options in (("contiguous", {}), ("lzf", {"compression": "lzf", "chunks": True})):
        with h5py.File(folder / f"{name}.hdf5", "w") as file:
            for key, array in arrays.items():
                file.create_dataset(key, data=array, **options)
    write_hdf5(folder / "gzip.hdf5", arrays)
    write_hdf5(folder / "cached.hdf5", arrays)
    Transitions.from_hdf5(folder / "cached.hdf5", cache=True)
    np.savez(folder / "plain.npz", **arrays)
    columns: dict[str, np.ndarray] = {}
    for key, name in (("observations", "obs"), ("next_observations", "next_obs"), ("actions", "action")):
        columns |= {f"{name}_{i}": arrays[key][:n_csv_rows, i] for i in range(arrays[key].shape[1])}
    columns |= {name: arrays[f"{name}s"][:n_csv_rows] for name in ("reward", "terminal", "timeout")}
    pd.DataFrame(columns).to_csv(folder / "table.csv", index=False)


# -- what is measured: each function takes the folder of the files and returns a function that is timed ------------------


def load(name: str, **options: Any) -> Callable[[Path], Callable[[], Any]]:
    """Loading a file into ``Transitions``."""

    def prepare(folder: Path) -> Callable[[], Any]:
        import pandas  # noqa: F401  # needed by the CSV reader, loaded by Stable-Baselines3 in any case

        from sb3_dce.data import load_transitions

        return lambda: load_transitions(folder / name, **options)

    return prepare


def fill(folder: Path) -> Callable[[], Any]:
    """Loading the contiguous file and handing it to this package's replay buffer."""
    from gymnasium import spaces

    from sb3_dce.buffers import OfflineReplayBuffer
    from sb3_dce.data import load_transitions

    observation_space = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float32)
    buffer = OfflineReplayBuffer(1, observation_space, spaces.Box(-1.0, 1.0, (ACT_DIM,), np.float32), device="cpu")

    def run() -> Any:
        buffer.attach(load_transitions(folder / "contiguous.hdf5"))
        return buffer

    return run


def add(folder: Path) -> Callable[[], Any]:
    """Reading the contiguous file with h5py and filling Stable-Baselines3's buffer row by row."""
    import h5py
    from gymnasium import spaces
    from stable_baselines3.common.buffers import ReplayBuffer

    with h5py.File(folder / "contiguous.hdf5") as file:
        arrays = {key: file[key][:] for key in file}
    n_rows = len(arrays["rewards"])
    observation_space = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float32)
    buffer = ReplayBuffer(n_rows, observation_space, spaces.Box(-1.0, 1.0, (ACT_DIM,), np.float32), device="cpu")
    dones, rewards = arrays["terminals"] | arrays["timeouts"], arrays["rewards"]

    def run() -> Any:
        obs, following, actions, timeouts = (
            arrays[key] for key in ("observations", "next_observations", "actions", "timeouts")
        )
        for i in range(n_rows):
            info = [{"TimeLimit.truncated": bool(timeouts[i])}]
            buffer.add(obs[i], following[i], actions[i], rewards[i], dones[i], info)  # type: ignore[arg-type]
        return buffer

    return run


WAYS: dict[str, Callable[[Path], Callable[[], Any]]] = {
    "HDF5, contiguous": load("contiguous.hdf5"),
    "HDF5, contiguous, into the replay buffer": fill,
    "HDF5, lzf": load("lzf.hdf5"),
    "HDF5, gzip + shuffle + fletcher32": load("gzip.hdf5"),
    "the same, rows kept (cache=True)": load("cached.hdf5", cache=True),
    "NPZ, not compressed": load("plain.npz"),
    "CSV": load("table.csv"),
    "`ReplayBuffer.add` of Stable-Baselines3, arrays in memory": add,
}
CSV, CACHED, BASELINE, FILL = "CSV", list(WAYS)[4], list(WAYS)[-1], list(WAYS)[1]


def measure(way: str, folder: Path) -> dict[str, float]:
    """
    Measure once, in this process.

    :param way: key of :data:`WAYS`
    :param folder: folder of the files
    :return: wall-clock and processor seconds, those without the system, and the growth of the largest resident memory in bytes
    """
    warnings.simplefilter("ignore")
    run = WAYS[way](folder)
    Path("/proc/self/clear_refs").write_text("5")  # forget the largest size so far
    before = memory("VmRSS")
    wall, processor, user = time.perf_counter(), time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_utime
    result = run()
    if way == CACHED and not isinstance(result._base_rows.base, np.memmap):
        raise RuntimeError("the kept rows were not used: has the package been changed meanwhile?")
    seconds = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - processor}
    seconds |= {"user_seconds": resource.getrusage(resource.RUSAGE_SELF).ru_utime - user}
    return {**seconds, "peak_bytes": memory("VmHWM") - before}


def memory(name: str) -> int:
    """
    :param name: ``VmRSS``, the resident memory of this process, or ``VmHWM``, the largest one
    :return: bytes
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))


def measure_all(folder: Path, repeats: int) -> dict[str, list[dict[str, float]]]:
    """
    Measure all ways in turn, each time in a new process, after one round that is not counted.

    :param folder: folder of the files
    :param repeats: rounds that count
    :return: way to measurements
    """
    results: dict[str, list[dict[str, float]]] = {way: [] for way in WAYS}
    for number in range(repeats + 1):
        for way in WAYS:
            if number == 0 and way == BASELINE:
                continue  # it reads no file that the others do not read
            command = [sys.executable, __file__, "--measure", way, "--folder", str(folder)]
            output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
            if number > 0:
                results[way].append(json.loads(output))
            print(f"round {number} of {repeats}: {way}", file=sys.stderr)
    return results


# -- the report --------------------------------------------------------------------------------------------------------


def machine() -> dict[str, Any]:
    """
    :return: what the figures depend on
    """
    from sb3_dce import __version__

    cpuinfo = Path("/proc/cpuinfo")
    names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": platform.system(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "h5py", "pandas", "torch", "stable_baselines3")},
        "sb3_dce": __version__,  # which need not be installed
    }


def report(results: dict[str, list[dict[str, float]]], facts: dict[str, Any]) -> str:
    """
    :param results: of :func:`measure_all`
    :param facts: rows, machine and load
    :return: Markdown
    """

    def median(way: str, name: str) -> float:
        return statistics.median(sample[name] for sample in results[way])

    lines = [
        f"# Loading {facts['rows']:,} steps of HalfCheetah's width",
        "",
        f"Median (smallest to largest) of {facts['repeats']} processes each, files in the page cache. Memory is the growth of "
        "the largest resident size while loading; the finished rows have "
        f"{facts['rows'] * WIDTH * 4 / 1e6:.0f} MB.",
        "",
        "| way | rows | wall-clock s | processor s (without the system) | memory, MB | memory / rows |",
        "|---|---|---|---|---|---|",
    ]
    for way, samples in results.items():
        rows = facts["csv_rows"] if way == CSV else facts["rows"]
        seconds = [sample["seconds"] for sample in samples]
        peak = median(way, "peak_bytes")
        lines.append(
            f"| {way} | {rows:,} | {median(way, 'seconds'):.3f} ({min(seconds):.3f} to {max(seconds):.3f}) "
            f"| {median(way, 'cpu_seconds'):.3f} ({median(way, 'user_seconds'):.3f}) "
            f"| {peak / 1e6:.0f} | {peak / (rows * WIDTH * 4):.2f} |"
        )
    ratio, own = (median(BASELINE, name) / median(FILL, name) for name in ("cpu_seconds", "user_seconds"))
    lines += [
        "",
        f"Loading a file into the replay buffer takes 1/{ratio:.0f} of the processor time that `add` takes for the same rows, "
        f"1/{own:.0f} without the time of the system, which provides the memory and takes the longer for it the more else is "
        "running. Rows that are kept are mapped: their pages are those of the page cache and can be given back at any time.",
        "",
        f"Load averages (1, 5, 15 minutes) before: {facts['load_before']}, after: {facts['load_after']}. "
        + ", ".join(f"{name} {value}" for name, value in facts["machine"].items())
        + ".",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure and write the report; as a child, one measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--csv-rows", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--measure", choices=WAYS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measure(arguments.measure, arguments.folder)))
        return
    facts: dict[str, Any] = {"rows": arguments.rows, "csv_rows": min(arguments.csv_rows, arguments.rows)}
    facts |= {"repeats": arguments.repeats, "load_before": [round(x, 1) for x in os.getloadavg()], "machine": machine()}
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as folder:
        write_files(Path(folder), facts["rows"], facts["csv_rows"])
        results = measure_all(Path(folder), arguments.repeats)
    facts["load_after"] = [round(x, 1) for x in os.getloadavg()]
    text = report(results, facts)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "loading.json").write_text(json.dumps({**facts, "measurements": results}, indent=1) + "\n")
    (arguments.output / "loading.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
