"""Result rows made up for tests of tables, verdicts and pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from sb3_dce.configuration import differences
from sb3_dce.experiments import results
from sb3_dce.experiments.grid import Experiment, Scale, variant_hash

SHA = "ab" * 32


def run_rows(
    experiment: Experiment,
    variant: str,
    dataset: str,
    seed: int,
    score: float | None = None,
    curves: Mapping[str, Sequence[float]] | None = None,
    *,
    n_updates: int = 1000,
    seconds: float = 10.0,
    sha: str = SHA,
    scale: Scale | None = None,
) -> pd.DataFrame:
    """Rows of one complete run; curves have equally spaced points up to its end."""
    chosen, scale = experiment.variant(variant), scale or experiment.scales["cpu"]
    settings = {**scale.set, **scale.set_for.get(chosen.algo, {}), **chosen.set}
    common = {
        "experiment": experiment.id,
        "dataset": dataset,
        "dataset_sha256": sha,
        "agent": chosen.algo,
        "hyperparameters": differences(chosen.algo, dataset, settings),
        "config_hash": variant_hash(chosen, dataset, scale),
        "n_updates": n_updates,
        "seed": seed,
        "code_version": "0.1.0+0123456789",
        "device": "cpu",
    }
    values: list[tuple[int, str, float]] = [(n_updates, "seconds", seconds), (n_updates, "n_episodes", 10)]
    points = dict(curves or {})
    if score is not None:
        points["score"] = [score] * 2
    for metric, numbers in points.items():
        values += [((i + 1) * n_updates // len(numbers), metric, float(v)) for i, v in enumerate(numbers)]
    frame = pd.DataFrame([{**common, "step": s, "metric": m, "value": v} for s, m, v in values])
    return frame[list(results.COLUMNS)]


def table_rows(
    experiment: Experiment, scores: Mapping[str, Mapping[str, Sequence[float]]], **settings: object
) -> pd.DataFrame:
    """Rows of a table: scores by data, variant and seed."""
    return results.merge(
        run_rows(experiment, variant, dataset, seed, score, **settings)  # type: ignore[arg-type]
        for dataset, columns in scores.items()
        for variant, values in columns.items()
        for seed, score in enumerate(values)
    )


def keys_of(rows: pd.DataFrame) -> set[tuple[object, ...]]:
    """Dataset, agent, configuration, length and seed of every run."""
    return set(rows[results.PLAN_KEY].itertuples(index=False, name=None))
