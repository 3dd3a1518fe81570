"""Offline SAC against Stable-Baselines3's own ``SAC.train``, given the same batches and the same noise, in float64."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from test_update import squashed
from torch import nn
from update_tools import (
    Step,
    all_tensors,
    check_changes_nothing_in_place,
    check_compiled_equals_eager,
    check_metrics,
    gradient_norm,
    largest_difference,
    needs_compiler,
    plain_action_metrics,
    plain_q_metrics,
    record_steps,
    to_float64,
)

from sb3_dce import OfflineSAC, Transitions, losses
from sb3_dce.envs import SpacesEnv

BATCH = 8
NETS = ("actor", "critic", "critic_target")


def make_model(data: Transitions, **kwargs: Any) -> OfflineSAC:
    """A small float64 agent whose critics are 1 on average over the data."""
    policy_kwargs = {"net_arch": [16, 16], **kwargs.pop("policy_kwargs", {})}
    settings = {"batch_size": BATCH, "seed": 0, "learning_rate": 1e-3, "tau": 0.05, "execution": "eager"}
    model = OfflineSAC("MlpPolicy", dataset=data, policy_kwargs=policy_kwargs, **{**settings, **kwargs})
    to_float64(model)
    model.attach_dataset()
    s, a = (th.as_tensor(array[:, 0]).double() for array in (model.replay_buffer.observations, model.replay_buffer.actions))
    with th.no_grad():
        for net in (model.critic, model.critic_target):
            for q_net, values in zip(net.q_networks, net(s, a), strict=True):
                q_net[-1].bias += 1.0 - values.mean()
    return model


# -- Stable-Baselines3's SAC as the reference --------------------------------------------------------------------------


class Replay:
    """Stands for the replay buffer: hands out the recorded batches one after the other."""

    def __init__(self, steps: list[Step], reward_scale: float, reward_shift: float) -> None:
        rewards = (reward_scale * step.batch.rewards + reward_shift for step in steps)
        self._batches = iter([step.batch._replace(rewards=r) for step, r in zip(steps, rewards, strict=True)])

    def sample(self, batch_size: int, env: None = None) -> Any:
        batch = next(self._batches)
        assert len(batch.observations) == batch_size
        return batch


def sb3_sac(model: OfflineSAC, env: SpacesEnv) -> SAC:
    """The real SAC of Stable-Baselines3 with the parameters of the model, in float64."""
    names = ("learning_rate", "tau", "gamma", "ent_coef", "target_entropy")
    settings = {name: getattr(model, name) for name in names}
    kwargs = {k: v for k, v in model.policy_kwargs.items() if k != "use_v"}
    sac = SAC("MlpPolicy", env, policy_kwargs=kwargs, buffer_size=1, device="cpu", **settings)
    sac.policy.double()
    for name in NETS:
        getattr(sac, name).load_state_dict(getattr(model, name).state_dict())
    if sac.log_ent_coef is not None:
        sac.log_ent_coef = model.log_ent_coef.detach().clone().requires_grad_()
        sac.ent_coef_optimizer = th.optim.Adam([sac.log_ent_coef], lr=model.learning_rate)
    else:
        sac.ent_coef_tensor = th.tensor(float(model.ent_coef), dtype=th.float64)
    sac.set_logger(Logger(folder=None, output_formats=[]))
    return sac


def train_sb3(sac: SAC, model: OfflineSAC, steps: list[Step], monkeypatch: pytest.MonkeyPatch) -> None:
    """Run ``SAC.train`` on the recorded steps: first it draws the policy's noise at s, then that at s'."""
    drawn: Iterator[th.Tensor] = iter([step.noise[name] for step in steps for name in ("actor", "next_actor")])
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda *args, **kwargs: next(drawn))
    # it casts every observation to float32
    monkeypatch.setattr("stable_baselines3.common.policies.preprocess_obs", lambda obs, *args, **kwargs: obs)
    sac.replay_buffer = Replay(steps, model.reward_scale, model.reward_shift)
    sac.train(len(steps), BATCH)
    assert next(drawn, None) is None, "all noise is used"


def tensors_of(sac: SAC) -> dict[str, th.Tensor]:
    found: dict[str, th.Tensor] = {}
    owners: list[tuple[str, dict[str, th.Tensor], th.optim.Optimizer | None]] = [
        (f"{name}.", dict(getattr(sac, name).named_parameters()), getattr(getattr(sac, name), "optimizer", None))
        for name in NETS
    ]
    if sac.log_ent_coef is not None:
        owners.append(("", {"log_ent_coef": sac.log_ent_coef}, sac.ent_coef_optimizer))
    for prefix, parameters, optimizer in owners:
        for key, parameter in parameters.items():
            found[prefix + key] = parameter.detach()
            if optimizer is not None:
                for moment in ("exp_avg", "exp_avg_sq"):
                    found[f"{prefix}{key}.{moment}"] = optimizer.state[parameter][moment]
    return found


CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "ent_coef_fixed": {"ent_coef": 0.2},
    "ent_coef_starts_low": {"ent_coef": "auto_0.1", "target_entropy": -1.5},
    "gamma_and_tau": {"gamma": 0.5, "tau": 0.3},
    "reward_transformed": {"reward_scale": 0.5, "reward_shift": -0.25},
    "one_critic": {"policy_kwargs": {"n_critics": 1}},
    "three_critics": {"policy_kwargs": {"n_critics": 3}},
    "tanh": {"policy_kwargs": {"activation_fn": nn.Tanh}},
    "adamw": {"policy_kwargs": {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.1}}},
}


@pytest.mark.parametrize("case", CASES)
def test_update_equals_stable_baselines3(
    case: str, transitions: Transitions, spaces_env: SpacesEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model(transitions, **CASES[case])
    sac, start = sb3_sac(model, spaces_env), copy.deepcopy(model.policy.state_dict())
    recorded = record_steps(monkeypatch)
    model.train(20, BATCH)
    train_sb3(sac, model, recorded, monkeypatch)
    assert largest_difference(all_tensors(model), tensors_of(sac)) <= 1e-10
    assert largest_difference(start, model.policy.state_dict()) > 1e-3


def test_metrics_are_those_of_stable_baselines3(
    transitions: Transitions, spaces_env: SpacesEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model(transitions)
    sac, recorded = sb3_sac(model, spaces_env), record_steps(monkeypatch)
    model.train(10, BATCH)
    train_sb3(sac, model, recorded, monkeypatch)
    ours, theirs = model.read_metrics(), sac.logger.name_to_value
    for name in ("critic_loss", "actor_loss", "ent_coef", "ent_coef_loss"):
        assert ours[name] == pytest.approx(float(theirs[f"train/{name}"]), abs=1e-10), name


def test_metrics_are_what_their_names_say(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of one update: Stable-Baselines3 logs a few only."""
    model = make_model(transitions, ent_coef="auto_0.5")
    policy, log_alpha = copy.deepcopy(model.policy), model.log_ent_coef.detach().clone()
    alpha, recorded = float(log_alpha.exp()), record_steps(monkeypatch)
    model.train(1, BATCH)
    batch, noise = recorded[0].batch, recorded[0].noise
    s, a, s2, d = batch.observations, batch.actions, batch.next_observations, batch.dones

    def pi(obs: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        mean, log_std, _ = policy.actor.get_action_dist_params(obs)
        return squashed(mean, log_std, noise)

    with th.no_grad():
        a2, next_log_prob = pi(s2, noise["next_actor"])
        next_values = th.stack(policy.critic_target(s2, a2)).min(dim=0).values
        y = batch.rewards + model.gamma * (1 - d) * (next_values - alpha * next_log_prob)
    q_data = policy.critic(s, a)
    critic_loss = 0.5 * sum(((q - y) ** 2).mean() for q in q_data)
    critic_loss.backward()
    a_pi, log_prob = pi(s, noise["actor"])
    q_pi = th.stack(model.critic(s, a_pi))  # critics after their step
    actor_loss = (alpha * log_prob - q_pi.min(dim=0).values).mean()
    actor_loss.backward()
    q_policy, log_prob = q_pi.detach().mean(), log_prob.detach()
    got = {**plain_q_metrics(q_data, [y] * 2), **plain_action_metrics(a_pi, a), "q_policy": q_policy, "ent_coef": alpha}
    got |= {"value_next": next_values.mean(), "td_target": y.mean(), "q_gap": q_policy - got["q_data"]}
    got |= {"critic_loss": critic_loss.detach(), "grad_norm_q": gradient_norm(policy.critic.parameters())}
    got |= {"actor_loss": actor_loss.detach(), "grad_norm_actor": gradient_norm(policy.actor.parameters())}
    got |= {"entropy": -log_prob.mean(), "ent_coef_loss": -(log_alpha * (log_prob - 2.0)).mean()}
    check_metrics(model, [got])


def test_max_grad_norm_clips_every_network(transitions: Transitions) -> None:
    model = make_model(transitions, max_grad_norm=1e-3)
    model.train(1, BATCH)
    metrics = model.read_metrics()
    for name, metric in (("actor", "grad_norm_actor"), ("critic", "grad_norm_q")):
        assert metrics[metric] > 1e-2, "clipping has something to do"
        first_moment = model._engine.state.storages[name].exp_avg
        assert float(th.linalg.vector_norm(first_moment)) == pytest.approx(0.1 * 1e-3, rel=1e-3)


# -- ways of running an update -----------------------------------------------------------------------------------------


@needs_compiler
def test_compiled_update_equals_the_eager_one(transitions: Transitions) -> None:
    check_compiled_equals_eager(lambda **kwargs: make_model(transitions, policy_kwargs={"net_arch": [8]}, **kwargs))


def test_update_changes_nothing_in_place(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    check_changes_nothing_in_place(make_model(transitions), monkeypatch)


# -- numbers -----------------------------------------------------------------------------------------------------------


def number(value: float) -> th.Tensor:
    return th.tensor([[value]], dtype=th.float64)


def test_target_has_the_entropy_of_the_next_action() -> None:
    # 1 + 0.99 (min(5, 4) - 0.2 * (-1)) = 1 + 0.99 * 4.2
    q = losses.reduce_critics([number(5.0), number(4.0)], "min")
    y = losses.entropy_td_target(number(1.0), number(0.0), q, number(-1.0), th.tensor(0.2, dtype=th.float64), 0.99)
    assert float(y) == pytest.approx(5.158, abs=1e-12)
    ended = losses.entropy_td_target(number(1.0), number(1.0), q, number(-1.0), th.tensor(0.2, dtype=th.float64), 0.99)
    assert float(ended) == 1.0


def test_temperature_falls_when_the_policy_is_too_random() -> None:
    # d/dlog_alpha of -log_alpha (log_pi + H) with log_pi = -1, H = -6
    log_ent_coef = th.zeros(1, dtype=th.float64, requires_grad=True)
    losses.ent_coef_loss(log_ent_coef, number(-1.0), -6.0).backward()
    assert float(log_ent_coef.grad) == 7.0


# -- saving ------------------------------------------------------------------------------------------------------------


def test_temperature_and_its_moments_survive_saving(transitions: Transitions, tmp_path: Path) -> None:
    model = OfflineSAC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}, seed=0).learn(5)
    model.save(tmp_path / "model")
    loaded = OfflineSAC.load(tmp_path / "model")
    assert loaded.log_ent_coef.item() == model.log_ent_coef.item() != 0.0
    one, other = (m.ent_coef_optimizer.state_dict()["state"][0] for m in (model, loaded))
    assert one.keys() == other.keys() and all(th.equal(one[key], other[key]) for key in one)
