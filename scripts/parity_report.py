"""
Do two ways of running one agent learn the same? Scores of two sets of runs on the same data, side by side.

    python scripts/parity_report.py float32=runs/a bf16-matmul=runs/b docs/results/precision.md

Each set is one or more folders (joined by ``+``) with one sub-folder per seed, as ``sb3-dce train`` writes them. The interval
of the difference is that of Welch's test over seeds, which are not paired: the same seed in two precisions is two different
trainings, since their numbers part within a few thousand updates. Writes the page and, beside it, a picture.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from sb3_dce.data.locate import catalogue_id
from sb3_dce.evaluation import Evaluation
from sb3_dce.plots import plot_learning_curves
from sb3_dce.student import sample_std, student_quantile, welch_freedom

# Evaluations whose mean is the second measure: one last evaluation is a noisy thing.
N_LAST = 5


def read_set(text: str) -> tuple[str, list[dict], list[list[Evaluation]]]:
    """
    :param text: ``name=folder[+folder...]``
    :return: name, configurations and evaluations of its runs, in the order of their seeds
    """
    name, _, folders = text.partition("=")
    runs = []
    for path in (path for folder in folders.split("+") for path in Path(folder).glob("seed_*/config.yml")):
        config = yaml.safe_load(path.read_text(encoding="utf-8"))
        # the small file, which is kept with published results
        table = pd.read_csv(path.parent / "evaluations.csv")
        dataset_id = catalogue_id(config["dataset"]["name"])
        curve = [Evaluation(row.n_updates, (row.mean_return,), (), dataset_id) for row in table.itertuples()]
        runs.append((config["run"]["seed"], config, curve))
    runs.sort(key=lambda run: run[0])
    return name, [config for _, config, _ in runs], [evaluations for _, _, evaluations in runs]


def interval_of_difference(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """
    :param one: a score per seed
    :param other: a score per seed
    :return: 95 % interval of the mean of ``other`` minus that of ``one``, by Welch's test
    """
    errors = [float(sample_std(scores)) / math.sqrt(len(scores)) for scores in (one, other)]
    freedom = welch_freedom(errors, [len(one) - 1, len(other) - 1])
    difference, reach = float(other.mean() - one.mean()), student_quantile(freedom) * math.hypot(*errors)
    return difference - reach, difference + reach


def main() -> None:
    """Read, compare, write."""
    if len(sys.argv) != 4 or not all("=" in text for text in sys.argv[1:3]):
        sys.exit(__doc__)
    *sets, out = sys.argv[1:]
    (name_a, configs_a, curves_a), (name_b, configs_b, curves_b) = map(read_set, sets)
    configs = [*configs_a, *configs_b]
    for text, own in zip(sets, (configs_a, configs_b), strict=True):
        if len(own) < 2:
            sys.exit(f"{len(own)} run(s) in {text}: an interval needs two seeds or more in each set")
    hashes = {config["dataset"]["sha256"] for config in configs}
    lengths = {curve[-1].n_updates for curve in (*curves_a, *curves_b)}
    if len(hashes) != 1 or len(lengths) != 1:
        sys.exit(f"not comparable: data {hashes}, lengths {lengths}")
    run = configs[0]["run"]
    last = [np.array([curve[-1].score for curve in curves]) for curves in (curves_a, curves_b)]
    late = [np.array([np.mean([e.score for e in curve[-N_LAST:]]) for curve in curves]) for curves in (curves_a, curves_b)]
    lines = [
        f"# {name_b} against {name_a}",
        "",
        f"{run['algo']} on {Path(configs[0]['dataset']['name']).stem}, {lengths.pop():,} updates, "
        f"{run['n_eval_episodes']} deterministic episodes at each evaluation, v4 environment; data sha256 "
        f"`{hashes.pop()}`. Scores of the last policies.",
        "",
        "| seed | " + " | ".join((name_a, name_b)) + " |",
        "|---|---|---|",
    ]
    by_seed = [
        {c["run"]["seed"]: s for c, s in zip(cs, ss, strict=True)} for cs, ss in zip((configs_a, configs_b), last, strict=True)
    ]
    for seed in sorted(set(by_seed[0]) | set(by_seed[1])):
        lines.append(
            f"| {seed} | " + " | ".join(f"{scores[seed]:.1f}" if seed in scores else "-" for scores in by_seed) + " |"
        )
    for title, (one, other) in (("last evaluation", last), (f"mean of the last {N_LAST} evaluations", late)):
        low, high = interval_of_difference(one, other)
        lines += [
            "",
            f"{title[0].upper()}{title[1:]}: {name_a} {one.mean():.2f} ± {one.std(ddof=1):.2f}, {name_b} {other.mean():.2f} ± "
            f"{other.std(ddof=1):.2f} (sample standard deviation over seeds); difference {other.mean() - one.mean():+.2f}, "
            f"95 % interval of Welch's test {low:+.2f} to {high:+.2f}.",
        ]
    picture = plot_learning_curves(
        {name_a: curves_a, name_b: curves_b}, Path(out).with_suffix(".png"), run["algo"], None, True
    )
    if picture is not None:
        lines += ["", f"![learning curves]({picture.name})"]
    Path(out).write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
