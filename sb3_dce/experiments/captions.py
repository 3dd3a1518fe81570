"""Where the numbers of a table or figure come from, in words: data with hash, length, seeds, code, and what is not shown."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pandas as pd

from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.grid import Scale, Variant, source_of
from sb3_dce.experiments.readings import devices_in, runs_in, span

LAST_POLICY = "last policy"


def caption(
    evidence: Evidence,
    dataset_ids: Iterable[str],
    variants: Iterable[Variant] | None = None,
    policy: str = LAST_POLICY,
) -> str:
    """
    Origin of the numbers in a table or figure, for the runs that stand there for these data and agents.

    :param evidence: rows
    :param dataset_ids: data shown
    :param variants: agents shown; ``None`` for all
    :param policy: which policy of a run the numbers are of
    :return: as :func:`caption_of`, of their runs
    """
    agents = list(evidence.experiment.variants if variants is None else variants)
    return caption_of(evidence, evidence.shown(dict.fromkeys(dataset_ids), agents), agents, policy)


def caption_of(evidence: Evidence, rows: pd.DataFrame, variants: list[Variant], policy: str = LAST_POLICY) -> str:
    """
    Origin of the numbers in words: files and hashes, gradient steps, seeds, episodes, code, settings, further runs.

    :param evidence: rows of an experiment
    :param rows: of these, of the runs shown
    :param variants: agents shown
    :param policy: which policy of a run the numbers are of
    :return: one paragraph, "No data." without rows; at smoke scale it begins with a warning
    """
    if rows.empty:
        return "No data."
    runs = runs_in(rows)
    alike = [column for column in runs.columns if column != "seed"]
    counts = sorted(runs.groupby(alike, observed=True).size().unique())
    episodes = sorted(rows[rows["metric"] == "n_episodes"]["value"].astype(int).unique())
    embedded = evidence.scale.source == "embedded"
    protocol = f"Gradient steps: {span(sorted(runs['n_updates'].unique()))}; seeds: {span(counts)}; {policy}"
    protocol += f", {span(episodes)} episode{'' if episodes[-1] == 1 else 's'}" if episodes else ""
    parts = ["Smoke scale, a test of the machinery: numbers and verdicts say nothing about the agents."] if embedded else []
    parts += [f"Data (sha256): {_data(rows)}.", f"{protocol}.", f"Code: {_versions(rows['code_version'].unique())}."]
    ran = [v for v in variants if (runs["agent"] == v.algo).any()]
    changed = [f"every agent has {_settings(evidence.scale.set)}"] if evidence.scale.set else []
    changed += [f"{v.name} has {known}" for v in ran if (known := _scale_settings(evidence.scale, v))]
    if changed and not embedded:
        parts.append(f"At this scale {'; '.join(changed)}.")
    if further := _further(evidence, runs, variants):
        parts.append(f"Further runs, of other lengths: {'; '.join(further)}.")
    return " ".join(parts)


def _data(rows: pd.DataFrame) -> str:
    """Files of one source, run on devices alike, stand together: a table of twelve sets says each thing once."""
    groups: dict[str, list[str]] = {}
    for name, of in rows.groupby("dataset", sort=False, observed=True):
        source = "of D4RL" if source_of(str(name)) == "D4RL" else "made with this package, not D4RL's"
        how = f"{source} (run on {devices_in(of)})"
        groups.setdefault(how, []).append(f"`{name}` {', '.join(h[:8] for h in of['dataset_sha256'].unique())}…")
    return "; ".join(f"{', '.join(names)}, {how}" for how, names in groups.items())


def _versions(versions: Iterable[str]) -> str:
    """As "0.1.0 (commits 0123456, 89abcde)"."""
    commits: dict[str, list[str]] = {}
    for version in sorted(versions):
        release, _, commit = version.partition("+")
        commits.setdefault(release, []).extend([commit[:7]] if commit else [])
    return ", ".join(
        release + (f" (commit{'s' if len(of) > 1 else ''} {', '.join(of)})" if of else "") for release, of in commits.items()
    )


def _scale_settings(scale: Scale, variant: Variant) -> str:
    settings = scale.set_for.get(variant.algo, {})
    return _settings({name: value for name, value in settings.items() if name not in variant.set})


def _settings(settings: dict[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in settings.items())


def _further(evidence: Evidence, runs: pd.DataFrame, variants: list[Variant]) -> list[str]:
    """Runs of these agents on the files shown that are not among those shown, one entry per length."""
    found: dict[int, dict[str, int]] = {}
    here = set(runs.itertuples(index=False, name=None))
    for name, sha in runs[["dataset", "dataset_sha256"]].drop_duplicates().itertuples(index=False, name=None):
        of = evidence.every_run(name, variants)
        of = of[of["dataset_sha256"] == sha]
        lengths = of["n_updates"][[run not in here for run in of.itertuples(index=False, name=None)]]
        for n, k in lengths.value_counts().items():
            on = found.setdefault(int(n), {})
            on[name] = on.get(name, 0) + int(k)
    return [
        f"{sum(on.values())} of {n:,} steps on {next(iter(on)) if len(on) == 1 else f'{len(on)} data sets'}"
        for n, on in sorted(found.items())
    ]
