"""Implicit Q-learning: V by expectile regression, Q on V, and a policy by advantage-weighted regression."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples, Schedule

from sb3_dce import losses
from sb3_dce.actors import GaussianActor
from sb3_dce.attaching import DatasetLike
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.checks import check_choice, check_number
from sb3_dce.execution import Update, UpdateOptions, bound_update
from sb3_dce.networks import OfflineCritic, ValueNet
from sb3_dce.noise import NoiseSpec
from sb3_dce.policies import OfflineIQLPolicy
from sb3_dce.state import PureNet, Storage
from sb3_dce.steps import descend, polyak, q_data_metrics

# Actions of the data are kept this far inside of [-1, 1], as the authors' loader does.
ACTION_LIMIT = 1.0 - 1e-5


@dataclass(frozen=True)
class IQLOptions(UpdateOptions):
    """
    What an update of IQL fixes when it is traced, beside the options of every agent.

    :param n_masks: hidden layers of the actor with dropout; 0 without dropout
    """

    n_masks: int


class OfflineIQL(OfflineAlgorithm):
    """
    Implicit Q-learning (Kostrikov, Nair & Levine, 2021). Defaults are the authors' for the gym sets but for the scale of the
    rewards, ``reward_normalization="iql"``, which needs whole episodes; ``load_dataset`` takes all of them from the set's row.

    No value of an action outside of the data is ever asked for. V(s) is an expectile of Q over the actions of the data,
    Q is trained on V, and the policy clones actions with the weight ``min(exp(temperature * (Q - V)), max_weight)``.
    The policy is a Gaussian with mean ``tanh(mu(s))`` and one deviation for all states, not squashed; ``predict`` clips.

    Names: the paper's tau is ``expectile`` and its beta ``temperature`` (an *inverse* temperature; other code means the
    inverse by "beta"); ``tau`` is the Polyak coefficient. Parameters not listed here are described in
    :class:`~sb3_dce.base.OfflineAlgorithm`.

    :param expectile: level of V in (0, 1): 0.7, on AntMaze 0.9. Raising it follows the better actions more closely
    :param temperature: 0 clones the behaviour, larger values prefer the better actions: gym 3, Adroit and Kitchen 0.5,
        AntMaze 10
    :param max_weight: largest weight of a row in the policy's regression
    :param actor_dropout: dropout after each hidden activation of the actor while training: 0.1 on Adroit and Kitchen
    :param actor_lr_schedule: ``"cosine"`` lowers the actor's learning rate from ``learning_rate`` to 0 over the
        ``total_timesteps`` of ``learn()``; ``"constant"`` leaves it
    """

    algo_name: ClassVar[str] = "offline_iql"
    networks = ("actor", "critic", "critic_target", "value_net")
    population_scalars = frozenset({"expectile", "temperature", "max_weight", "actor_lr_schedule"})
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": OfflineIQLPolicy}
    policy: OfflineIQLPolicy
    actor: GaussianActor
    critic: OfflineCritic
    critic_target: OfflineCritic
    value_net: ValueNet

    def __init__(
        self,
        policy: str | type[OfflineIQLPolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        gradient_steps: int = 1,
        expectile: float = 0.7,
        temperature: float = 3.0,
        max_weight: float = 100.0,
        actor_dropout: float = 0.0,
        actor_lr_schedule: str = "cosine",
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
        self.expectile = expectile
        self.temperature = temperature
        self.max_weight = max_weight
        self.actor_dropout = actor_dropout
        self.actor_lr_schedule = actor_lr_schedule
        if _init_setup_model:
            self._setup_model()

    def check_parameters(self) -> None:
        super().check_parameters()
        check_number("expectile", self.expectile, 0, 1, open_low=True, open_high=True, hint="The authors use 0.7 or 0.9.")
        check_number("temperature", self.temperature, 0, hint="The authors use 3 (gym), 0.5 (Adroit, Kitchen), 10 (AntMaze).")
        check_number("max_weight", self.max_weight, 0, open_low=True)
        check_number("actor_dropout", self.actor_dropout, 0, 1, open_high=True)
        check_choice("actor_lr_schedule", self.actor_lr_schedule, ("cosine", "constant"))

    def policy_settings(self) -> dict[str, Any]:
        return {**super().policy_settings(), "use_v": True}

    def make_update(self, storages: dict[str, Storage]) -> Update:
        nets = {
            "actor": PureNet(self.actor, "get_action_dist_params"),
            "critic": PureNet(self.critic),
            "critic_target": PureNet(self.critic_target),
            "value_net": PureNet(self.value_net),
        }
        options = IQLOptions(max_grad_norm=self.max_grad_norm, n_masks=len(self._dropout_widths()))
        return bound_update(update, options, nets, storages)

    def noise_specs(self, batch_size: int) -> dict[str, NoiseSpec]:
        widths = self._dropout_widths()
        return {f"dropout_{i}": NoiseSpec("dropout", (batch_size, w), self.actor_dropout) for i, w in enumerate(widths)}

    def _dropout_widths(self) -> list[int]:
        return self.actor.net_arch if self.actor_dropout > 0 else []

    def learning_rates(self) -> dict[str, float]:
        rates = super().learning_rates()
        done = 1.0 - self._current_progress_remaining if self.actor_lr_schedule == "cosine" else 0.0
        return {**rates, "actor_learning_rate": rates["learning_rate"] * 0.5 * (1.0 + math.cos(math.pi * done))}

    def coefficients(self, n_updates: int) -> dict[str, float]:
        return {
            **super().coefficients(n_updates),
            "expectile": self.expectile,
            "temperature": self.temperature,
            "max_weight": self.max_weight,
        }


def update(
    options: IQLOptions,
    nets: dict[str, PureNet],
    settings: dict[str, Any],
    state: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
    coef: dict[str, th.Tensor],
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    One gradient step of IQL, in the order of the authors' code: V, actor on the new V, critics on the new V, targets.

    :param options: choices fixed at trace time
    :param nets: networks as functions of their flat parameters
    :param settings: optimizer constants of each learner
    :param state: learners "actor", "critic", "value_net" and the flat target
    :param batch: tensors of shape (batch, ...); actions scaled to [-1, 1]
    :param noise: dropout masks of this update
    :param coef: 0-dimensional coefficients
    :return: changed parts of the state, metrics
    """
    s, s2, d = batch.observations, batch.next_observations, batch.dones
    a = batch.actions.clamp(-ACTION_LIMIT, ACTION_LIMIT)
    r = coef["reward_scale"] * batch.rewards + coef["reward_shift"]
    lr, clip = coef["learning_rate"], options.max_grad_norm
    new: dict[str, Any] = {}

    # 1 value
    q_t = losses.reduce_critics(nets["critic_target"](state["critic_target"], s, a), "min")

    def v_loss(params: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        v = nets["value_net"](params, s)
        return losses.value_loss(q_t, v, coef["expectile"]), v

    new["value_net"], loss, values, norm = descend(v_loss, state["value_net"], lr, settings["value_net"], clip)
    metrics = {"value_loss": loss, "grad_norm_v": norm, "value": values.mean()}

    # 2 actor
    advantages = q_t - nets["value_net"](new["value_net"].params, s)
    weights = losses.advantage_weights(advantages, coef["temperature"], coef["max_weight"])

    def pi_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor]]:
        masks = [noise[f"dropout_{i}"] for i in range(options.n_masks)] if options.n_masks else None
        mean, log_std = nets["actor"](params, s, masks)
        return losses.awr_loss(losses.gaussian_log_prob(mean, log_std, a), weights), (mean, log_std)

    new["actor"], loss, (mean, log_std), norm = descend(
        pi_loss, state["actor"], coef["actor_learning_rate"], settings["actor"], clip
    )
    metrics.update(actor_loss=loss, grad_norm_actor=norm, log_std=log_std.mean(), action_dist=(mean - a).abs().mean())
    metrics.update(adv=advantages.mean(), adv_pos_frac=(advantages > 0).to(a.dtype).mean(), weight=weights.mean())
    metrics.update(weight_max_frac=(weights >= coef["max_weight"]).to(a.dtype).mean())
    metrics["entropy"] = (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
    metrics["actor_learning_rate"] = coef["actor_learning_rate"]

    # 3 critics
    next_values = nets["value_net"](new["value_net"].params, s2)
    y = losses.td_target(r, d, next_values, coef["gamma"])

    def q_loss(params: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        q_data = nets["critic"](params, s, a)
        return losses.critic_loss(q_data, y, 1.0), th.cat(list(q_data), dim=-1)

    new["critic"], loss, q_data, norm = descend(q_loss, state["critic"], lr, settings["critic"], clip)
    metrics.update(critic_loss=loss, grad_norm_q=norm, td_target=y.mean(), value_next=next_values.mean())
    metrics.update(q_data_metrics(q_data))
    metrics["td_mse"] = (q_data - y).square().mean()

    # 4 targets
    new["critic_target"] = polyak(new["critic"].params, state["critic_target"], coef["tau"])
    return new, metrics
