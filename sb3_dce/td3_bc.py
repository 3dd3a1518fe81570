"""TD3+BC: a deterministic actor that follows the critic and is held near the data by a clone term."""

from __future__ import annotations

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples, Schedule

from sb3_dce import losses
from sb3_dce.actors import DeterministicActor
from sb3_dce.attaching import DatasetLike
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.checks import check_number
from sb3_dce.execution import Update, UpdateOptions, bound_update
from sb3_dce.networks import OfflineCritic
from sb3_dce.noise import NoiseSpec
from sb3_dce.policies import OfflineTD3Policy
from sb3_dce.state import PureNet, Storage
from sb3_dce.steps import action_metrics, descend, polyak, q_data_metrics


class OfflineTD3BC(OfflineAlgorithm):
    """
    TD3 with behavioural cloning (Fujimoto & Gu, 2021), with the defaults of the authors' code.

    The actor maximises ``lambda * Q_1(s, pi(s)) - (pi(s) - a)^2`` with ``lambda = alpha / mean|Q_1(s, pi(s))|``. The clone
    term is a mean over batch *and* action entries. Actor and all targets move at every ``policy_update_freq``-th update
    only: 2, 4, 6, ...

    Parameters not listed here are described in :class:`~sb3_dce.base.OfflineAlgorithm`.

    :param alpha: weight of the critic against the clone; 0 is behavioural cloning, raising it trusts the critic more
    :param policy_update_freq: actor and targets step once every so many updates
    :param target_policy_noise: standard deviation of the noise on the target policy's actions, which lie in [-1, 1]
    :param target_noise_clip: largest absolute value of this noise
    :param normalize_obs: standardise observations, on by default as the method says
    """

    algo_name: ClassVar[str] = "offline_td3bc"
    networks = ("actor", "actor_target", "critic", "critic_target")
    population_scalars = frozenset({"alpha", "target_policy_noise", "target_noise_clip"})
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": OfflineTD3Policy}
    policy: OfflineTD3Policy
    actor: DeterministicActor
    actor_target: DeterministicActor
    critic: OfflineCritic
    critic_target: OfflineCritic

    def __init__(
        self,
        policy: str | type[OfflineTD3Policy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        gradient_steps: int = 1,
        alpha: float = 2.5,
        policy_update_freq: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        max_grad_norm: float | None = None,
        d4rl_compat: bool = False,
        normalize_obs: bool = True,
        reward_normalization: str | None = None,
        reward_scale: float = 1.0,
        reward_shift: float = 0.0,
        execution: str = "auto",
        precision: str = "float32",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            dataset,
            learning_rate,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            gradient_steps=gradient_steps,
            max_grad_norm=max_grad_norm,
            d4rl_compat=d4rl_compat,
            normalize_obs=normalize_obs,
            reward_normalization=reward_normalization,
            reward_scale=reward_scale,
            reward_shift=reward_shift,
            execution=execution,
            precision=precision,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            needs_env=_init_setup_model,
        )
        self.alpha = alpha
        self.policy_update_freq = policy_update_freq
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        if _init_setup_model:
            self._setup_model()

    def check_parameters(self) -> None:
        super().check_parameters()
        check_number("alpha", self.alpha, 0, hint="The authors use 2.5 for every dataset.")
        check_number("policy_update_freq", self.policy_update_freq, 1, integer=True)
        check_number("target_policy_noise", self.target_policy_noise, 0)
        check_number("target_noise_clip", self.target_noise_clip, 0)

    def make_update(self, storages: dict[str, Storage]) -> Update:
        nets = {
            "actor": PureNet(self.actor),
            "actor_target": PureNet(self.actor_target),
            "critic": PureNet(self.critic),
            "first_critic": PureNet(self.critic, "q1_forward"),
            "critic_target": PureNet(self.critic_target),
        }
        return bound_update(update, UpdateOptions(self.max_grad_norm), nets, storages)

    def update_variant(self, n_updates: int) -> dict[str, Any]:
        return {"with_actor": (n_updates + 1) % self.policy_update_freq == 0}

    def noise_specs(self, batch_size: int) -> dict[str, NoiseSpec]:
        return {"target_actor": NoiseSpec("normal", (batch_size, get_action_dim(self.action_space)))}

    def coefficients(self, n_updates: int) -> dict[str, float]:
        return {
            **super().coefficients(n_updates),
            "alpha": self.alpha,
            "target_policy_noise": self.target_policy_noise,
            "target_noise_clip": self.target_noise_clip,
        }


def update(
    options: UpdateOptions,
    nets: dict[str, PureNet],
    settings: dict[str, Any],
    state: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
    coef: dict[str, th.Tensor],
    with_actor: bool = True,
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    One gradient step of TD3+BC: critics; at every ``policy_update_freq``-th step also actor, then all targets.

    :param options: choices fixed at trace time
    :param nets: networks as functions of their flat parameters; "first_critic" is Q_1 of the parameters of "critic"
    :param settings: optimizer constants of each learner
    :param state: learners "actor", "critic" and flat targets
    :param batch: tensors of shape (batch, ...); actions scaled to [-1, 1]
    :param noise: random numbers of this update
    :param coef: 0-dimensional coefficients
    :param with_actor: whether actor and targets move
    :return: changed parts of the state, metrics
    """
    s, a, s2, d = batch.observations, batch.actions, batch.next_observations, batch.dones
    r = coef["reward_scale"] * batch.rewards + coef["reward_shift"]
    lr, clip = coef["learning_rate"], options.max_grad_norm
    new: dict[str, Any] = {}

    # 1 target
    a2 = losses.smoothed_actions(
        nets["actor_target"](state["actor_target"], s2),
        noise["target_actor"],
        coef["target_policy_noise"],
        coef["target_noise_clip"],
    )
    next_values = losses.reduce_critics(nets["critic_target"](state["critic_target"], s2, a2), "min")
    y = losses.td_target(r, d, next_values, coef["gamma"])

    # 2 critics
    def q_loss(params: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        q_data = nets["critic"](params, s, a)
        return losses.critic_loss(q_data, y, 1.0), th.cat(list(q_data), dim=-1)

    new["critic"], loss, q_data, norm = descend(q_loss, state["critic"], lr, settings["critic"], clip)
    metrics = {"critic_loss": loss, "grad_norm_q": norm, "td_target": y.mean(), "value_next": next_values.mean()}
    metrics.update(q_data_metrics(q_data))
    metrics["td_mse"] = (q_data - y).square().mean()
    if not with_actor:
        return new, metrics

    # 3 actor on the new first critic
    def pi_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor]]:
        actions = nets["actor"](params, s)
        q_pi = nets["first_critic"](new["critic"].params, s, actions)
        return losses.td3bc_actor_loss(q_pi, actions, a, coef["alpha"]), (actions, q_pi)

    new["actor"], loss, (actions, q_pi), norm = descend(pi_loss, state["actor"], lr, settings["actor"], clip)
    metrics.update(actor_loss=loss, grad_norm_actor=norm, bc_loss=losses.bc_mse(actions, a))
    metrics["lambda"] = losses.td3bc_lambda(q_pi, coef["alpha"])
    metrics.update(q_policy=q_pi.mean(), q_gap=q_pi.mean() - q_data.mean())
    metrics.update(action_metrics(actions, a))

    # 4 targets
    for name in ("critic", "actor"):
        new[f"{name}_target"] = polyak(new[name].params, state[f"{name}_target"], coef["tau"])
    return new, metrics
