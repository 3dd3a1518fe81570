"""The lines of a figure's panels, from rows: steps by seeds, and what theory expects of them."""

from __future__ import annotations

import pandas as pd

from sb3_dce.dce_probe import PROBE_BETAS
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.grid import Panel, Variant


def variants_of(evidence: Evidence, panel: Panel) -> tuple[str, ...]:
    """
    Lines of a panel that draws variants: those it names, or all of the experiment if it names none.

    :param evidence: rows
    :param panel: picture
    :return: names of the variants that belong into it
    """
    return panel.variants or tuple(v.name for v in evidence.experiment.variants)


def view_of(evidence: Evidence, panel: Panel) -> Evidence:
    """
    Rows that a panel is drawn from: of its variants and its reference, at the length that most of these have.

    :param evidence: rows
    :param panel: picture
    :return: rows of its variants alone, which may have longer runs than all of the figure; of one length over all its data
    """
    names = [*variants_of(evidence, panel), *([panel.reference] if panel.reference else [])]
    return evidence.of_one_length(names, panel.over or (panel.dataset,))


def panel_curves(evidence: Evidence, panel: Panel) -> dict[str, tuple[pd.DataFrame, pd.Series | None]]:
    """
    All lines of a panel: one per dataset, per beta of the probe, or per variant, as the panel says.

    :param evidence: rows
    :param panel: picture
    :return: by line its curves (steps by seeds) and, where there is one, what theory expects; lines without data are left out
    """
    evidence = view_of(evidence, panel)
    experiment = evidence.experiment
    names = variants_of(evidence, panel)
    curves: dict[str, tuple[pd.DataFrame, pd.Series | None]] = {}
    if panel.over:
        for paper in panel.over:
            dataset_id = evidence.id_of(paper)
            if dataset_id is not None:
                curves[dataset_id] = (evidence.curve(experiment.variant(names[0]), dataset_id, panel.metric), None)
    else:
        dataset_id = evidence.id_of(panel.dataset)
        if dataset_id is None:
            return {}
        if panel.lines:
            probe = experiment.variant(names[0])
            curves = {f"beta {b}": (probe_curve(evidence, probe, dataset_id, panel.metric, b), None) for b in panel.lines}
        else:
            for name in names:
                curves[name] = _line(evidence, panel, experiment.variant(name), dataset_id)
    return {name: (curve, theory) for name, (curve, theory) in curves.items() if curve.notna().any(axis=None)}


def probe_curve(evidence: Evidence, probe: Variant, dataset_id: str, metric: str, beta: int) -> pd.DataFrame:
    """
    What a panel shows of the critics of one beta: mostly Q of the probed actions, less the Q it is compared with.

    :param evidence: rows of the probe
    :param probe: its variant
    :param dataset_id: data
    :param metric: "probe_policy" (against the critics with beta 0), "probe_max" or "probe_min" (against the data's actions);
        "probe_rank" is shown as logged: how alike a critic of beta and another one of beta 0 order the data's actions
    :param beta: of the critics, one of ``PROBE_BETAS`` or 0
    :return: reward units, or a correlation; steps by seeds
    """
    assert beta in (0, *PROBE_BETAS)
    if metric == "probe_rank":
        return evidence.curve(probe, dataset_id, f"probe{beta}_rank")
    if metric == "probe_policy":
        return evidence.curve(probe, dataset_id, f"probe{beta}_policy") - evidence.curve(probe, dataset_id, "probe0_policy")
    kind = metric.removeprefix("probe_")
    return evidence.curve(probe, dataset_id, f"probe{beta}_{kind}") - evidence.curve(probe, dataset_id, f"probe{beta}_data")


def _line(evidence: Evidence, panel: Panel, variant: Variant, dataset_id: str) -> tuple[pd.DataFrame, pd.Series | None]:
    if panel.reference is None:
        return evidence.curve(variant, dataset_id, panel.metric), None
    reference = evidence.experiment.variant(panel.reference)
    of = "value" if panel.metric == "v_shift" else "q_data"
    lowered, theory = evidence.shift(variant, reference, dataset_id, of)
    if panel.metric == "gap_ref":
        return -lowered.sub(theory, axis=0), None
    return lowered, theory
