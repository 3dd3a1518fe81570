"""
Critics of an ensemble one after the other or as batched matrix products: milliseconds of forward and backward.

    python benchmarks/ensembles.py                 # CQL's and PBRL's sizes on one core, about five minutes
    python benchmarks/ensembles.py --device cuda

The ways take turns in one process. Writes ``results/ensembles.json`` and ``results/ensembles.md`` beside this file
(``ensembles-cuda`` on a CUDA device) and prints the latter. :func:`sb3_dce.ensembles.batched_products_pay` follows these
figures.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch as th
from gymnasium import spaces
from loading import ACT_DIM, OBS_DIM, RESULTS, machine
from torch.func import grad_and_value

from sb3_dce import ensembles
from sb3_dce.networks import OfflineCritic
from sb3_dce.policies import OfflineSACPolicy
from sb3_dce.state import Storage

# critics and rows of the largest call in an update: CQL's 31 and PBRL's 21 rows per sample, and PBRL's actor loss
SIZES = {"CQL, critics": (2, 31 * 256), "PBRL, critics": (10, 21 * 256), "PBRL, actor": (10, 256)}


def make_ways(n_critics: int, n_rows: int, device: th.device) -> dict[str, Callable[[], object]]:
    """
    :param n_critics: members
    :param n_rows: rows of the batch
    :param device: where it runs
    :return: gradient of a mean square by each way
    """
    observation_space = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float64)
    action_space = spaces.Box(-1, 1, (ACT_DIM,), np.float32)
    kwargs = {"net_arch": [256, 256, 256], "n_critics": n_critics}
    critic = OfflineSACPolicy(observation_space, action_space, lambda _: 3e-4, **kwargs).to(device).critic
    assert isinstance(critic, OfflineCritic)
    params = Storage.of(critic).params
    obs, actions = th.randn(n_rows, OBS_DIM, device=device), th.rand(n_rows, ACT_DIM, device=device) * 2 - 1
    ways: dict[str, Callable[[], object]] = {}
    for name, batched in (("one by one", False), ("batched", True)):
        net = ensembles.EnsembleNet(critic)
        net.is_batched = lambda device, batched=batched: batched  # type: ignore[method-assign]

        def loss(flat: th.Tensor, net: ensembles.EnsembleNet = net) -> th.Tensor:
            return net(flat, obs, actions).square().mean()

        def eager(loss: Callable[[th.Tensor], th.Tensor] = loss) -> object:
            leaf = params.detach().requires_grad_(True)
            return th.autograd.grad(loss(leaf), leaf)

        compiled = th.compile(grad_and_value(loss), fullgraph=True, dynamic=False)
        ways[f"{name}, eager"] = eager
        ways[f"{name}, compile"] = lambda compiled=compiled: compiled(params)
    return ways


def measure(ways: dict[str, Callable[[], object]], repeats: int, device: th.device) -> dict[str, list[float]]:
    """
    :param ways: what is measured
    :param repeats: turns of each
    :param device: where it runs
    :return: milliseconds of each turn; CPU time on a processor, since other programs may run
    """
    cuda = device.type == "cuda"
    clock = time.perf_counter if cuda else time.process_time
    for way in ways.values():
        way(), way()
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, way in ways.items():
            if cuda:
                th.cuda.synchronize(device)
            started = clock()
            for _ in range(4):
                way()
            if cuda:
                th.cuda.synchronize(device)
            times[name].append(1000 * (clock() - started) / 4)
    return times


def main() -> None:
    """Measure, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path, default=None, help="files without ending; default: by the device")
    options = parser.parse_args()
    th.set_num_threads(1)
    device = th.device(options.device)
    on_cuda = device.type == "cuda"
    name = th.cuda.get_device_name(device) if on_cuda else "cpu"
    facts = {**machine(), "device": name, "date": time.strftime("%Y-%m-%d")}
    times = {name: measure(make_ways(*size, device), options.repeats, device) for name, size in SIZES.items()}
    ways = list(next(iter(times.values())))
    lines = [
        "# Critics of an ensemble, one by one or batched",
        "",
        f"{facts['processor']}, device {facts['device']}, one thread, PyTorch {facts['torch']}, {facts['date']}. Three hidden "
        f"layers of 256, float32; milliseconds of forward and backward, medians of {options.repeats} (least).",
        "",
        f"| | critics | rows | {' | '.join(ways)} |",
        "|---|---|---|" + "---|" * len(ways),
    ]
    for name, size in SIZES.items():
        cells = [f"{statistics.median(times[name][way]):.1f} ({min(times[name][way]):.1f})" for way in ways]
        lines.append(f"| {name} | {size[0]} | {size[1]} | {' | '.join(cells)} |")
    text = "\n".join(lines) + "\n"
    out = options.out or RESULTS / ("ensembles-cuda" if on_cuda else "ensembles")
    out.parent.mkdir(parents=True, exist_ok=True)
    document = json.dumps({"facts": facts, "milliseconds": times}, indent=1)
    out.with_suffix(".json").write_text(document + "\n", encoding="utf-8")
    out.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
