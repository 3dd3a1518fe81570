"""
Where the time of one compiled update goes.

    python benchmarks/profile_update.py                          # DCE, float32; two minutes
    python benchmarks/profile_update.py --algo offline_iql --precision bf16-matmul

Groups what PyTorch's profiler sees, in microseconds of self time per update, and lists the matrix products by shape with
their speed. The profiler itself costs some ten per cent, so the shares count, not the sum. CQL and UWAC are profiled after
their first phases, which are cheaper. Data are random numbers of HalfCheetah's shape. Writes ``results/profile.json`` and
``results/profile.md`` beside this file and prints the latter.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from pathlib import Path
from typing import Any

from loading import RESULTS, machine, make_arrays
from speed import BATCH, keep_to_one_core, make_agent
from torch.profiler import ProfilerActivity, profile

from sb3_dce import Transitions
from sb3_dce.agents import agent_class

PRODUCTS = ("aten::mm", "aten::addmm", "aten::bmm", "aten::baddbmm")
SAMPLING = ("aten::index_select", "aten::randint", "aten::random_", "aten::normal_", "aten::randn", "aten::uniform_")


def group_of(name: str) -> str:
    """
    :param name: of an event
    :return: what it is counted as
    """
    if name in PRODUCTS or name in ("aten::copy_", "aten::expand"):  # a product with bias first copies the bias
        return "matrix products"
    if name.startswith("graph_"):
        return "everything fused between them (activations, losses, gradients of both, Adam, Polyak, diagnostics)"
    if name in SAMPLING:
        return "drawing rows and noise, gathering rows"
    if "Cache Lookup" in name:
        return "asking whether the graph still fits"
    return "calling all this from Python"


def measure(model: Any, n_updates: int) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """
    :param model: agent whose update is compiled already
    :param n_updates: updates
    :return: microseconds per update by group, and a row for each shape of product
    """
    with profile(activities=[ProfilerActivity.CPU], record_shapes=True) as profiled:
        model.train(n_updates, BATCH)
    groups: dict[str, float] = {}
    products = []
    for event in profiled.key_averages(group_by_input_shape=True):
        spent = event.self_cpu_time_total / n_updates
        groups[group_of(event.key)] = groups.get(group_of(event.key), 0.0) + spent
        if event.key in PRODUCTS[:2]:
            # of a product with bias the first input is the bias
            left, right = event.input_shapes[1:3] if event.key == "aten::addmm" else event.input_shapes[:2]
            work = 2 * left[0] * left[1] * right[1]
            rate = work * event.count / event.self_cpu_time_total / 1e3
            row = {"product": f"{left[0]}x{left[1]} . {right[0]}x{right[1]}", "with_bias": event.key == "aten::addmm"}
            products.append({**row, "per_update": event.count / n_updates, "us_per_update": spent, "gflops": rate})
    return groups, sorted(products, key=lambda row: -row["us_per_update"])


def report(groups: dict[str, float], products: list[dict[str, Any]], facts: dict[str, Any]) -> str:
    """
    :param groups: from :func:`measure`
    :param products: from :func:`measure`
    :param facts: machine, versions, settings
    :return: Markdown
    """
    total = sum(groups.values())
    lines = [
        f"# One compiled update of {facts['algo']}, {facts['precision']}",
        "",
        f"{facts['processor']}, one core; PyTorch {facts['torch']}, {facts['date']}; batch {BATCH}, random numbers of "
        f"HalfCheetah's shape. {facts['ms_per_update']:.2f} ms of CPU time per update without the profiler. "
        f"`{facts['command']}`",
        "",
        "| | us per update | share |",
        "|---|---|---|",
        *(f"| {name} | {spent:.0f} | {spent / total:.0%} |" for name, spent in sorted(groups.items(), key=lambda i: -i[1])),
        "",
        "| matrix product | times per update | us per update | GFLOP/s |",
        "|---|---|---|---|",
    ]
    for row in products[:12]:
        name = row["product"] + (" + bias" if row["with_bias"] else "")
        lines.append(f"| {name} | {row['per_update']:.0f} | {row['us_per_update']:.0f} | {row['gflops']:.0f} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", default="dce")
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--updates", type=int, default=200)
    parser.add_argument("--core", type=int, default=None, help="core to run on; default: the last one")
    parser.add_argument("--out", type=Path, default=RESULTS / "profile")
    options = parser.parse_args()

    import torch._inductor.config as inductor

    inductor.cpp.enable_kernel_profile = True  # gives the fused kernels names in the profile
    keep_to_one_core(options.core)
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    transitions = Transitions.from_arrays(**make_arrays(200_000))
    model = make_agent(agent_class(options.algo), transitions, "compile", options.precision)
    model.train(10, BATCH)
    started = time.process_time()
    model.train(options.updates, BATCH)
    seconds = time.process_time() - started
    groups, products = measure(model, options.updates)
    facts = {
        **machine(),
        "algo": options.algo,
        "precision": options.precision,
        "date": time.strftime("%Y-%m-%d"),
        "ms_per_update": 1000 * seconds / options.updates,
        "command": f"python benchmarks/profile_update.py --algo {options.algo} --precision {options.precision}",
    }
    text = report(groups, products, facts)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    document = json.dumps({"facts": facts, "us_per_update": groups, "products": products}, indent=1)
    options.out.with_suffix(".json").write_text(document + "\n", encoding="utf-8")
    options.out.with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
