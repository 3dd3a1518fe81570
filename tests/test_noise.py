"""
What is drawn for an update, and from which distribution.

The restatements of the updates take the numbers that were drawn, so a wrong distribution would show in none of them.
"""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch as th
from agents_under_test import AGENTS

from sb3_dce import OfflineCQL, OfflineDCE, OfflineIQL, OfflinePBRL, OfflineSAC, OfflineTD3BC, OfflineUWAC, Transitions
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.errors import ConfigError
from sb3_dce.noise import NoiseSpec

NORMAL, UNIFORM = ("normal", 0.0), ("uniform", 0.0)
SPECS: list[tuple[type[OfflineAlgorithm], dict[str, Any], dict[str, tuple[str, float]]]] = [
    (OfflineDCE, {}, {"actor": NORMAL}),
    (OfflineDCE, {"use_v": False, "n_penalty_actions": 2}, {"actor": NORMAL, "penalty": NORMAL, "next_actor": NORMAL}),
    (OfflineDCE, {"penalty_action_source": "uniform"}, {"actor": NORMAL, "penalty": UNIFORM}),
    (OfflineDCE, {"critic_dropout": 0.1}, {"actor": NORMAL, r"dropout_\d_\d": ("dropout", 0.1)}),
    (OfflineSAC, {}, {"actor": NORMAL, "next_actor": NORMAL}),
    (OfflineTD3BC, {}, {"target_actor": NORMAL}),
    (OfflineIQL, {"actor_dropout": 0.1}, {r"dropout_\d": ("dropout", 0.1)}),
    (OfflineCQL, {}, dict.fromkeys(("actor", "next_actor", "policy", "next_policy"), NORMAL) | {"uniform": UNIFORM}),
    (OfflinePBRL, {}, dict.fromkeys(("actor", "next_actor", "ood", "next_ood"), NORMAL)),
    (
        OfflineUWAC,
        {"n_mc_dropout": 2},
        dict.fromkeys(("vae", "next_actor", "mmd_actor", "mmd_vae"), NORMAL) | {r"\w*dropout_\d": ("dropout", 0.1)},
    ),
]


@pytest.mark.parametrize(("cls", "kwargs", "expected"), SPECS)
def test_random_numbers_have_the_distribution_they_should(
    cls: type[OfflineAlgorithm], kwargs: dict[str, Any], expected: dict[str, tuple[str, float]], transitions: Transitions
) -> None:
    specs = cls("MlpPolicy", dataset=transitions, **kwargs).noise_specs(4)
    for name, spec in specs.items():
        (pattern,) = (pattern for pattern in expected if re.fullmatch(pattern, name))
        assert (spec.kind, spec.rate) == expected[pattern], name
    assert all(any(re.fullmatch(pattern, name) for name in specs) for pattern in expected)


def test_unknown_kind_of_noise_is_refused() -> None:
    with pytest.raises(ConfigError, match="kind must be one of 'normal', 'uniform', 'dropout', got 'gaussian'"):
        NoiseSpec("gaussian", (2,))


def test_every_agent_is_listed() -> None:
    # sac_v and cql_eq18 are DCE with other defaults; BC draws nothing
    named = {agent.cls for agent in AGENTS.values()}
    assert {cls for cls in named if not issubclass(cls, OfflineDCE)} - {cls for cls, _, _ in SPECS} == {AGENTS["BC"].cls}


@pytest.mark.parametrize(
    ("spec", "mean", "std", "low", "high"),
    [
        (NoiseSpec("normal", (300, 300)), 0.0, 1.0, -7.0, 7.0),
        (NoiseSpec("uniform", (300, 300)), 0.5, 12**-0.5, 0.0, 1.0),
        (NoiseSpec("dropout", (300, 300), 0.2), 1.0, (0.25 * 0.8 / 0.8) ** 0.5, 0.0, 1.25),  # 0 or 1 / 0.8
    ],
)
def test_moments_of_what_is_drawn(spec: NoiseSpec, mean: float, std: float, low: float, high: float) -> None:
    drawn = spec.draw(th.Generator().manual_seed(0), th.device("cpu"), th.float64)
    assert drawn.shape == spec.shape and drawn.dtype == th.float64
    assert float(drawn.mean()) == pytest.approx(mean, abs=0.01) and float(drawn.std()) == pytest.approx(std, abs=0.01)
    assert low <= float(drawn.min()) and float(drawn.max()) <= high
    if spec.kind == "dropout":
        assert set(drawn.flatten().tolist()) == {0.0, 1.25}
        assert float((drawn == 0).double().mean()) == pytest.approx(0.2, abs=0.01)
