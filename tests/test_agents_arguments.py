"""Every agent: a wrong argument is refused in words when the model is made."""

from __future__ import annotations

from typing import Any

import pytest
import torch as th
from agents_under_test import AGENTS, accepts, make

from sb3_dce import Transitions
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import ConfigError

WRONG: list[tuple[str, Any]] = [
    ("batch_size", 0),
    ("batch_size", 2.5),
    ("gradient_steps", 0),
    ("learning_rate", -1e-3),
    ("tau", 1.5),
    ("gamma", -0.1),
    ("execution", "jit"),
    ("reward_normalization", "max"),
    ("reward_scale", 0.0),
    ("bc_loss", "l1"),
    ("expectile", 1.0),
    ("expectile", float("nan")),
    ("beta", -1.0),
    ("beta", float("inf")),
    ("beta_rate", 0.5),
    ("beta_update_every", 0),
    ("td_loss_coef", 0.0),
    ("ent_coef", "automatic"),
    ("ent_coef", "auto_x"),
    ("ent_coef", -0.1),
    ("target_entropy", "small"),
    ("penalty_action_source", "data"),
    ("penalty_form", "quadratic"),
    ("n_penalty_actions", 0),
    ("v_target_reduction", "max"),
    ("v_target_timing", "later"),
    ("actor_q", "second"),
    ("policy_update_freq", 0),
    ("critic_dropout", 1.0),
    ("critic_weight_decay", -1.0),
    ("max_grad_norm", -1.0),
    ("max_grad_norm", 0.0),
    ("q_target_clip", -1.0),
    ("fraction", 0.0),
    ("fraction", 1.5),
    ("alpha", -1.0),
    ("target_policy_noise", -0.1),
    ("target_noise_clip", -0.1),
    ("temperature", -1.0),
    ("max_weight", 0.0),
    ("actor_dropout", 1.0),
    ("actor_lr_schedule", "linear"),
    ("actor_learning_rate", 0.0),
    ("alpha_learning_rate", -1e-3),
    ("n_mc_dropout", 1),
    ("uwac_beta", -0.5),
    ("n_target_actions", 0),
    ("n_mmd_actions", 0),
    ("mmd_sigma", 0.0),
    ("mmd_threshold", -0.1),
    ("policy_eval_start", -1),
    ("actor_q_timing", "later"),
    ("n_predict_actions", 0),
    ("vae_net_arch", [0]),
    ("cql_weight", -1.0),
    ("n_actions", 0),
    ("lagrange_threshold", -1.0),
    ("lagrange_form", "squared"),
    ("n_critics", 1),
    ("uncertainty_coef", -0.01),
    ("n_ood_actions", 0),
    ("ood_weight", -1.0),
    ("ood_weight_final", -1.0),
    ("ood_weight_steps", 0),
    ("ood_weight_next", -1.0),
    ("ood_weight_decay", 1.0),
    ("ood_weight_min", -1.0),
    ("steps_per_epoch", 0),
    ("pseudo_target_floor", float("nan")),
    ("prior_scale", -1.0),
    ("normalize_obs", "None"),
    ("d4rl_compat", "no"),
    ("max_q_backup", 1),
    ("adaptive_ood_weight", "yes"),
    ("ent_coef", float("inf")),
    ("target_entropy", float("nan")),
    ("vae_net_arch", 5),
    ("seed", -1),
    ("seed", 1.5),
    ("seed", 2**33),
    ("device", "cudaa"),
    ("device", None),
    ("device", "meta"),  # which PyTorch knows, but which holds no numbers
]


@pytest.mark.parametrize(
    ("key", "name", "value"),
    [
        (key, name, value)
        for key in ("DCE", "BC", "TD3BC", "IQL", "SAC", "CQL", "PBRL", "UWAC")
        for name, value in WRONG
        if accepts(AGENTS[key], name)
    ],
)
def test_wrong_argument_is_refused_by_the_constructor(key: str, name: str, value: Any, spaces_env: SpacesEnv) -> None:
    with pytest.raises(ConfigError, match=name):
        make(AGENTS[key], env=spaces_env, **{name: value})


def test_every_wrong_argument_is_one_of_some_agent() -> None:
    assert [name for name, _ in WRONG if not any(accepts(agent, name) for agent in AGENTS.values())] == []


def test_device_beyond_those_that_are_there_is_refused(spaces_env: SpacesEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "device_count", lambda: 1)
    with pytest.raises(ConfigError, match="device='cuda:1', but PyTorch finds 1 CUDA device here"):
        make(AGENTS["BC"], env=spaces_env, device="cuda:1")


@pytest.mark.parametrize(
    ("policy_kwargs", "message"),
    [
        (5, "policy_kwargs must be a dictionary"),
        ({"nonsense": 1}, "no parameter 'nonsense'. It has net_arch"),
        ({"net_arch": 8}, "net_arch must be a list"),
        ({"net_arch": [-3]}, "net_arch must be a list"),
        ({"net_arch": {"pi": [8.0], "qf": [8]}}, r"net_arch\['pi'\] must be a list"),
        ({"activation_fn": "tanh"}, "activation_fn must be a class"),
        ({"activation_fn": th.nn.ReLU()}, "activation_fn must be a class"),
        ({"activation_fn": th.nn.functional.relu}, "activation_fn must be a class"),
        ({"n_critics": 0}, "n_critics must be an integer"),
    ],
)
def test_wrong_policy_arguments_are_refused(policy_kwargs: Any, message: str, spaces_env: SpacesEnv) -> None:
    with pytest.raises(ConfigError, match=message):
        AGENTS["DCE"].cls("MlpPolicy", spaces_env, policy_kwargs=policy_kwargs)


@pytest.mark.parametrize(
    ("key", "policy_kwargs"),
    [
        ("UWAC", {"critic_dropout": 0.5}),
        ("UWAC", {"n_mc_dropout": 5}),
        ("PBRL", {"n_critics": 3}),
        ("PBRL", {"random_prior": True}),
        ("IQL", {"use_v": False}),
        ("DCE", {"critic_weight_decay": -1.0}),
    ],
)
def test_policy_arguments_that_the_agent_decides_are_refused(
    key: str, policy_kwargs: dict[str, Any], spaces_env: SpacesEnv
) -> None:
    with pytest.raises(ConfigError, match="would contradict the agent"):
        make(AGENTS[key], env=spaces_env, policy_kwargs=policy_kwargs)


@pytest.mark.parametrize("steps", [float("nan"), float("inf"), "abc", None, 0.5, 2.7, -1, True])
def test_number_of_steps_that_is_none_is_refused(steps: Any, transitions: Transitions) -> None:
    model = make(AGENTS["BC"], dataset=transitions)
    with pytest.raises(ConfigError, match="total_timesteps must be a whole number"):
        model.learn(steps)
