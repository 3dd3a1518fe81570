"""SAC on a dataset: Stable-Baselines3's update without an environment, the baseline that offline RL has to beat."""

from __future__ import annotations

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples, Schedule

from sb3_dce import losses
from sb3_dce.attaching import DatasetLike
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.entropy import ENT_COEF, EntropyCoefficient, descend_ent_coef
from sb3_dce.execution import Update, UpdateOptions, bound_update
from sb3_dce.networks import OfflineCritic
from sb3_dce.noise import NoiseSpec
from sb3_dce.policies import OfflineSACPolicy
from sb3_dce.state import PureNet, Storage
from sb3_dce.steps import action_metrics, descend, polyak, q_data_metrics


class OfflineSAC(EntropyCoefficient, OfflineAlgorithm):
    """
    Soft actor-critic (Haarnoja et al., 2018) trained on a dataset only.

    The update is that of Stable-Baselines3's ``SAC.train``, in the same order. Nothing keeps the policy near the data: its
    actions there are valued too high, the target repeats the mistake, and Q grows far beyond what the rewards allow on
    narrow data. That is what the offline agents are compared with, not an error to be mended here.

    Parameters not listed here are described in :class:`~sb3_dce.base.OfflineAlgorithm`.

    :param ent_coef: temperature: a number, ``"auto"``, or ``"auto_0.1"`` to start at 0.1
    :param target_entropy: entropy aimed at, in nats, when ``ent_coef`` is learned; ``"auto"`` is minus the action dimension
    """

    algo_name: ClassVar[str] = "offline_sac"
    networks = ("actor", "critic", "critic_target")
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": OfflineSACPolicy}
    policy: OfflineSACPolicy
    critic: OfflineCritic
    critic_target: OfflineCritic

    def __init__(
        self,
        policy: str | type[OfflineSACPolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        gradient_steps: int = 1,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        max_grad_norm: float | None = None,
        d4rl_compat: bool = False,
        normalize_obs: bool = False,
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
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy
        if _init_setup_model:
            self._setup_model()

    def make_update(self, storages: dict[str, Storage]) -> Update:
        nets = {
            "actor": PureNet(self.actor, "get_action_dist_params"),
            "critic": PureNet(self.critic),
            "critic_target": PureNet(self.critic_target),
        }
        return bound_update(update, UpdateOptions(self.max_grad_norm), nets, storages)

    def noise_specs(self, batch_size: int) -> dict[str, NoiseSpec]:
        shape = (batch_size, get_action_dim(self.action_space))
        return {"actor": NoiseSpec("normal", shape), "next_actor": NoiseSpec("normal", shape)}


def update(
    options: UpdateOptions,
    nets: dict[str, PureNet],
    settings: dict[str, Any],
    state: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
    coef: dict[str, th.Tensor],
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    One gradient step of SAC, equal to that of Stable-Baselines3: target, critics, actor, temperature (used before its step, so
    that this may come last), moving average.

    :param options: choices fixed at trace time
    :param nets: networks as functions of their flat parameters
    :param settings: optimizer constants of each learner
    :param state: learners "actor", "critic", with a learned temperature "log_ent_coef", and the flat target
    :param batch: tensors of shape (batch, ...); actions scaled to [-1, 1]
    :param noise: random numbers of this update
    :param coef: 0-dimensional coefficients
    :return: changed parts of the state, metrics
    """
    s, a, s2, d = batch.observations, batch.actions, batch.next_observations, batch.dones
    r = coef["reward_scale"] * batch.rewards + coef["reward_shift"]
    lr, clip = coef["learning_rate"], options.max_grad_norm
    learned = ENT_COEF in state
    # the value before the temperature's own step, in target and actor loss alike
    ent_coef = state[ENT_COEF].params.exp() if learned else coef["ent_coef"]
    new: dict[str, Any] = {}

    # 1 target: the policy and the temperature before their steps
    mean, log_std, _ = nets["actor"](state["actor"].params, s2)
    a2, next_log_prob = losses.squashed_gaussian(mean, log_std, noise["next_actor"])
    next_values = losses.reduce_critics(nets["critic_target"](state["critic_target"], s2, a2), "min")
    y = losses.entropy_td_target(r, d, next_values, next_log_prob, ent_coef, coef["gamma"])

    # 2 critics
    def q_loss(params: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        q_data = nets["critic"](params, s, a)
        return losses.critic_loss(q_data, y, 0.5), th.cat(list(q_data), dim=-1)

    new["critic"], loss, q_data, norm = descend(q_loss, state["critic"], lr, settings["critic"], clip)
    metrics = {"critic_loss": loss, "grad_norm_q": norm, "td_target": y.mean(), "value_next": next_values.mean()}
    metrics.update(q_data_metrics(q_data))
    metrics["td_mse"] = (q_data - y).square().mean()

    # 3 actor on the new critics
    def pi_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor, th.Tensor]]:
        mean, log_std, _ = nets["actor"](params, s)
        actions, log_prob = losses.squashed_gaussian(mean, log_std, noise["actor"])
        q_pi = nets["critic"](new["critic"].params, s, actions)
        loss = losses.sac_actor_loss(log_prob, losses.reduce_critics(q_pi, "min"), ent_coef)
        return loss, (actions, log_prob, losses.reduce_critics(q_pi, "mean"))

    new["actor"], loss, kept, norm = descend(pi_loss, state["actor"], lr, settings["actor"], clip)
    actions, log_prob, q_pi = kept
    metrics.update(actor_loss=loss, grad_norm_actor=norm, entropy=-log_prob.mean(), ent_coef=ent_coef.mean())
    metrics.update(q_policy=q_pi.mean(), q_gap=q_pi.mean() - q_data.mean())
    metrics.update(action_metrics(actions, a))

    # 4 temperature, from the log-probability of the policy before its step
    if learned:
        new[ENT_COEF], metrics["ent_coef_loss"] = descend_ent_coef(
            state[ENT_COEF], log_prob, coef["target_entropy"], lr, settings[ENT_COEF]
        )

    # 5 targets
    new["critic_target"] = polyak(new["critic"].params, state["critic_target"], coef["tau"])
    return new, metrics
