"""
One Markdown page about the runs of ``sb3-dce train`` with DCE: scores of every seed, and whether the critics obey the theory.

    python scripts/run_report.py <folder of the runs> > docs/results/<name>.md
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from sb3_dce.data.locate import catalogue_id
from sb3_dce.evaluation import read_evaluations

# Diagnostics shown, a mean over the last log rows of a run.
DIAGNOSTICS = ("q_data", "q_policy", "gap_td", "beta_eff", "beta_pred_shift", "ent_coef", "entropy", "action_dist")
LAST_ROWS = 10


def read_log(folder: Path) -> pd.DataFrame:
    """
    The log of a run, whose parts after an interruption replace what they repeat.

    :param folder: folder of one run
    :return: rows with training diagnostics, indexed by the number of updates
    """
    parts = [pd.read_csv(path) for path in sorted(folder.glob("progress_*.csv"), key=lambda p: int(p.stem.split("_")[1]))]
    rows = pd.concat([part.dropna(subset=["train/n_updates"]) for part in parts if "train/n_updates" in part])
    return rows.groupby("train/n_updates").last().sort_index()


def report(folder: Path) -> str:
    """
    :param folder: folder with one sub-folder per seed
    :return: Markdown
    """
    runs = sorted(path.parent for path in folder.glob("*/config.yml"))
    if not runs:
        sys.exit(f"no runs in {folder}: give the folder of `sb3-dce train`, which has one sub-folder per seed")
    configs = [yaml.safe_load((run / "config.yml").read_text()) for run in runs]
    first, settings = configs[0], configs[0]["run"]
    dataset_id = catalogue_id(first["dataset"]["name"])
    h = first["hyperparameters"]
    if "beta" not in h:
        sys.exit(f"the page is about the penalty of DCE, which {settings['algo']} does not have: use `sb3-dce compare`")
    lines = [
        f"# {settings['algo']} on {dataset_id}",
        "",
        f"{settings['n_updates']:,} gradient steps, {settings['n_eval_episodes']} deterministic episodes at each evaluation, "
        f"the last policy counts. Data sha256 `{first['dataset']['sha256']}`, {first['dataset']['rows']:,} transitions, mean "
        f"reward {first['dataset']['reward_mean']:.3f}. beta {h['beta']} to {h['beta_final']} by {h['beta_rate']} every "
        f"{h['beta_update_every']} epochs, expectile {h['expectile']}, ent_coef {h['ent_coef']}, learning rate "
        f"{h['learning_rate']}. "
        + ", ".join(f"{name} {value}" for name, value in first["versions"].items())
        + f"; one {first['machine']['processor']} core per seed. Returns in the v4 environment of Gymnasium.",
        "",
        "| seed | last return | last score | best score (not a result) | updates |",
        "|---|---|---|---|---|",
    ]
    last_scores = []
    for run, config in zip(runs, configs, strict=True):
        evaluations = read_evaluations(run, dataset_id)
        scores = [e.score if e.score is not None else float("nan") for e in evaluations]
        last = evaluations[-1]
        last_scores.append(scores[-1])
        lines.append(
            f"| {config['run']['seed']} | {last.mean:.0f} ± {last.std:.0f} | {scores[-1]:.1f} | {max(scores):.1f} "
            f"| {last.n_updates:,} |"
        )
    if any(read_evaluations(run, dataset_id)[-1].n_updates < settings["n_updates"] for run in runs):
        lines += ["", "**Not complete**: the last column is the state reached; the same command goes on from there."]
    spread = f" ± {np.std(last_scores, ddof=1):.1f} (sample standard deviation over seeds)" if len(runs) > 1 else ""
    lines += [
        "",
        f"Mean of the last scores: **{np.mean(last_scores):.1f}**{spread}.",
        "",
        f"Diagnostics, mean over the last {LAST_ROWS} log rows (1000 updates each). `gap_td` is `E_D[Q - y] + beta_eff`, "
        "which theory (bias identity of the linear penalty) puts at 0; `beta_pred_shift` is the predicted lowering of Q on "
        "the data.",
        "",
        "| seed | " + " | ".join(DIAGNOSTICS) + " |",
        "|---" * (len(DIAGNOSTICS) + 1) + "|",
    ]
    for run, config in zip(runs, configs, strict=True):
        tail = read_log(run).tail(LAST_ROWS)
        values = [f"{tail[f'train/{name}'].mean():.4g}" for name in DIAGNOSTICS]
        lines.append(f"| {config['run']['seed']} | " + " | ".join(values) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    print(report(Path(sys.argv[1])))
