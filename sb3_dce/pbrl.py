"""PBRL: pessimistic bootstrapping with an ensemble of critics (Bai et al., 2022)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples, Schedule

from sb3_dce import losses
from sb3_dce.actor_rate import ActorLearningRate
from sb3_dce.attaching import DatasetLike
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.checks import check_number, check_optional
from sb3_dce.ensembles import EnsembleNet, EnsemblePolicy
from sb3_dce.entropy import EntropyCoefficient, stepped_ent_coef
from sb3_dce.execution import Update, UpdateOptions, bound_update
from sb3_dce.networks import OfflineCritic
from sb3_dce.noise import NoiseSpec
from sb3_dce.ood_weight import OOD_Q, OODWeight
from sb3_dce.state import PureNet, Storage
from sb3_dce.steps import action_metrics, descend, polyak, q_data_metrics


@dataclass(frozen=True)
class PBRLOptions(UpdateOptions):
    """Choices of :func:`update` that are fixed when it is traced; see :class:`OfflinePBRL` for their meaning."""

    prior_scale: float
    pseudo_target_floor: float | None
    record: bool


class OfflinePBRL(ActorLearningRate, EntropyCoefficient, OODWeight, OfflineAlgorithm):
    """
    Pessimistic bootstrapping: ten critics, each with its own target, whose disagreement u(s, a) is subtracted.

    In the target: ``y_k = r + gamma (1 - d) (Q_k(s', a') - eta u(s', a'))``. For actions of the policy, at s and at s', each
    critic is drawn to its own value less a multiple of u, ``max(Q_k - w u, 0)``. The floor at 0 makes sense where returns
    are positive; see ``pseudo_target_floor`` for other data. All hidden layers have 256 units, three per network.

    Differences from the authors' code: one Adam over all critics, which is the same as one each; online and target critics
    share their random priors (the code draws them anew for the targets), and the actor's gradient passes through them; targets
    start as copies of the critics, with PyTorch's first weights; the actor's log standard deviation goes down to -20, as in
    Stable-Baselines3 (theirs to -5).

    Parameters not listed here are described in :class:`~sb3_dce.base.OfflineAlgorithm`.

    :param learning_rate: rate of the critics, or a schedule of the remaining progress
    :param actor_learning_rate: rate of actor and temperature; ``None`` takes ``learning_rate``
    :param ent_coef: temperature: a number, ``"auto"``, or ``"auto_0.1"`` to start at 0.1. A learned one is used after its
        step, as in the authors' code
    :param target_entropy: entropy aimed at, in nats, when ``ent_coef`` is learned; ``"auto"`` is minus the action dimension
    :param n_critics: members of the ensemble, at least 2
    :param uncertainty_coef: eta, weight of u in the target; raising it makes Q more conservative
    :param n_ood_actions: actions of the policy per state, at s and at s' (authors: 10), 2 * n_ood_actions + 1 critic rows
        per sample
    :param ood_weight: w_s, weight of u in the pseudo-targets at s, at the start
    :param ood_weight_final: its value after ``ood_weight_steps`` updates, reached linearly; ``None`` for a constant
    :param ood_weight_steps: gradient steps
    :param ood_weight_next: w_n, weight of u in the pseudo-targets at s'
    :param adaptive_ood_weight: after ``ood_weight_steps`` updates divide w_s by ``ood_weight_decay`` once per epoch while
        Q(s, a ~ pi) falls: mean of the last 5 recorded values below that of the (up to) 15 before. One value is recorded per
        epoch, at its first update, and takes part in the comparison from the next epoch on
    :param ood_weight_decay: divisor, above 1
    :param ood_weight_min: the adaptive rule stops once w_s is not above this value
    :param steps_per_epoch: gradient steps in one epoch
    :param pseudo_target_floor: smallest pseudo-target, reward units (authors: 0); ``None`` is off
    :param prior_scale: scale of a frozen random network added to each critic (PBRL-prior: 1); 0 is off
    """

    algo_name: ClassVar[str] = "offline_pbrl"
    networks = ("actor", "critic", "critic_target", "critic_prior")
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": EnsemblePolicy}
    population_scalars = frozenset({"uncertainty_coef"})
    policy: EnsemblePolicy
    critic: OfflineCritic
    critic_target: OfflineCritic
    critic_prior: OfflineCritic | None

    def __init__(
        self,
        policy: str | type[EnsemblePolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        actor_learning_rate: float | None = 1e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        gradient_steps: int = 1,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        n_critics: int = 10,
        uncertainty_coef: float = 0.01,
        n_ood_actions: int = 10,
        ood_weight: float = 5.0,
        ood_weight_final: float | None = 1.0,
        ood_weight_steps: int = 50_000,
        ood_weight_next: float = 0.1,
        adaptive_ood_weight: bool = False,
        ood_weight_decay: float = 1.01,
        ood_weight_min: float = 0.2,
        steps_per_epoch: int = 1000,
        pseudo_target_floor: float | None = 0.0,
        prior_scale: float = 0.0,
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
        self.actor_learning_rate = actor_learning_rate
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy
        self.n_critics = n_critics
        self.uncertainty_coef = uncertainty_coef
        self.n_ood_actions = n_ood_actions
        self.ood_weight = ood_weight
        self.ood_weight_final = ood_weight_final
        self.ood_weight_steps = ood_weight_steps
        self.ood_weight_next = ood_weight_next
        self.adaptive_ood_weight = adaptive_ood_weight
        self.ood_weight_decay = ood_weight_decay
        self.ood_weight_min = ood_weight_min
        self.steps_per_epoch = steps_per_epoch
        self.pseudo_target_floor = pseudo_target_floor
        self.prior_scale = prior_scale
        if _init_setup_model:
            self._setup_model()

    # -- set-up ----------------------------------------------------------------------------------------------------

    def check_parameters(self) -> None:
        super().check_parameters()
        check_number("n_critics", self.n_critics, 2, integer=True, hint="One critic cannot disagree; the authors use 10.")
        for name in ("uncertainty_coef", "prior_scale"):
            check_number(name, getattr(self, name), 0)
        check_number("n_ood_actions", self.n_ood_actions, 1, integer=True)
        check_optional("pseudo_target_floor", self.pseudo_target_floor, -float("inf"), open_low=True)

    def policy_settings(self) -> dict[str, Any]:
        return {
            **super().policy_settings(),
            "net_arch": [256, 256, 256],
            "n_critics": self.n_critics,
            "random_prior": self.prior_scale > 0,
        }

    # -- what the base class needs ---------------------------------------------------------------------------------

    def make_update(self, storages: dict[str, Storage]) -> Update:
        nets = {
            "actor": PureNet(self.actor, "get_action_dist_params"),
            "critic": EnsembleNet(self.critic),
            "critic_target": EnsembleNet(self.critic_target),
        }
        if self.critic_prior is not None:
            nets["critic_prior"] = EnsembleNet(self.critic_prior)
        options = PBRLOptions(
            prior_scale=self.prior_scale,
            pseudo_target_floor=self.pseudo_target_floor,
            record=OOD_Q in storages,
            max_grad_norm=self.max_grad_norm,
        )
        return bound_update(update, options, nets, storages)

    def noise_specs(self, batch_size: int) -> dict[str, NoiseSpec]:
        one = (batch_size, get_action_dim(self.action_space))
        several = (self.n_ood_actions, *one)
        return {
            "actor": NoiseSpec("normal", one),
            "next_actor": NoiseSpec("normal", one),
            "ood": NoiseSpec("normal", several),
            "next_ood": NoiseSpec("normal", several),
        }

    def learning_rates(self) -> dict[str, float]:
        rates = super().learning_rates()
        return {**rates, "log_ent_coef_learning_rate": rates["actor_learning_rate"]}

    def coefficients(self, n_updates: int) -> dict[str, float]:
        return {**super().coefficients(n_updates), "uncertainty_coef": self.uncertainty_coef}


def update(
    options: PBRLOptions,
    nets: dict[str, Any],
    settings: dict[str, Any],
    state: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
    coef: dict[str, th.Tensor],
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    One gradient step of PBRL, in the authors' order: temperature, critics, actor on the new critics, targets.

    :param options: choices fixed at trace time
    :param nets: networks as functions of their flat parameters, with priors "critic_prior" among them
    :param settings: optimizer constants of each learner
    :param state: learners "actor", "critic", "log_ent_coef", flat targets and priors, recorded value
    :param batch: tensors of shape (batch, ...); actions scaled to [-1, 1]
    :param noise: random numbers of this update; those of several actions have shape (n_ood_actions, batch, action_dim)
    :param coef: 0-dimensional coefficients
    :return: changed parts of the state, metrics
    """
    s, a, s2, d = batch.observations, batch.actions, batch.next_observations, batch.dones
    r = coef["reward_scale"] * batch.rewards + coef["reward_shift"]
    mean, log_std, _ = nets["actor"](state["actor"].params, s)
    mean2, log_std2, _ = nets["actor"](state["actor"].params, s2)

    def prior(obs: th.Tensor, actions: th.Tensor) -> th.Tensor | float:
        if options.prior_scale == 0:
            return 0.0
        return options.prior_scale * nets["critic_prior"](state["critic_prior"], obs, actions)

    # 1 temperature; alpha is the value after its step
    a_pi, log_prob = losses.squashed_gaussian(mean, log_std, noise["actor"])
    stepped, ent_coef, metrics = stepped_ent_coef(state, coef, log_prob, settings)
    new: dict[str, Any] = {**stepped}

    # 2 targets, one per critic
    a2, _ = losses.squashed_gaussian(mean2, log_std2, noise["next_actor"])
    q_next = nets["critic_target"](state["critic_target"], s2, a2) + prior(s2, a2)
    next_uncertainty = losses.ensemble_std(q_next)
    next_values = losses.pessimistic_values(q_next, next_uncertainty, coef["uncertainty_coef"])
    y = losses.td_target(r, d, next_values, coef["gamma"])

    # 3 critics: the data, the policy's actions at s, and those at s', in one call
    a_now, _ = losses.squashed_gaussian(mean, log_std, noise["ood"])
    a_next, _ = losses.squashed_gaussian(mean2, log_std2, noise["next_ood"])
    n, n_ood = a.shape[0], a_now.shape[0] * a.shape[0]
    states = th.cat([s, *(obs.expand(a_now.shape[0], *obs.shape).flatten(0, 1) for obs in (s, s2))])
    actions = th.cat([a, a_now.flatten(0, 1), a_next.flatten(0, 1)])
    q_prior = prior(states, actions)

    def q_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[th.Tensor, ...]]:
        q_all = nets["critic"](params, states, actions) + q_prior
        q_data, q_ood = q_all[..., :n, :], q_all[..., n:, :]
        pseudo_targets = _pseudo_targets(options, q_ood.detach(), n_ood, coef)
        td = losses.mean_square(q_data, y)
        ood = losses.mean_square(q_ood, pseudo_targets)
        return (td + ood).sum(), (q_data, q_ood, td, ood)

    clip = options.max_grad_norm
    new["critic"], loss, kept, norm = descend(q_loss, state["critic"], coef["learning_rate"], settings["critic"], clip)
    q_data, q_ood, td, ood = kept
    metrics.update(critic_loss=loss, grad_norm_q=norm, value_next=next_values.mean(), td_target=y.mean())
    metrics.update(td_mse=td.mean(), ood_loss=ood.mean(), uncertainty_next=next_uncertainty.mean())
    metrics.update(_critic_metrics(q_data, q_ood, n_ood))
    metrics["ood_weight"] = coef["ood_weight"]
    if options.record:
        new[OOD_Q] = metrics["q_policy"].reshape(1)

    # 4 actor on the new critics
    def pi_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[()]]:
        mean, log_std, _ = nets["actor"](params, s)
        actions, log_prob = losses.squashed_gaussian(mean, log_std, noise["actor"])
        q_pi = nets["critic"](new["critic"].params, s, actions) + prior(s, actions)
        return losses.sac_actor_loss(log_prob, q_pi.amin(dim=-3), ent_coef), ()

    rate = coef["actor_learning_rate"]
    new["actor"], loss, _, norm = descend(pi_loss, state["actor"], rate, settings["actor"], clip)
    metrics.update(actor_loss=loss, grad_norm_actor=norm, entropy=-log_prob.mean(), ent_coef=ent_coef.mean())
    metrics.update(action_metrics(a_pi, a))
    metrics["actor_learning_rate"] = rate

    # 5 targets
    new["critic_target"] = polyak(new["critic"].params, state["critic_target"], coef["tau"])
    return new, metrics


def _pseudo_targets(options: PBRLOptions, q_ood: th.Tensor, n_ood: int, coef: dict[str, th.Tensor]) -> th.Tensor:
    """Each critic's own value less its share of the disagreement: first the rows at s, then those at s'."""
    uncertainty, floor = losses.ensemble_std(q_ood), options.pseudo_target_floor
    weights = ((slice(None, n_ood), coef["ood_weight"]), (slice(n_ood, None), coef["ood_weight_next"]))
    parts = [
        losses.pessimistic_values(q_ood[..., rows, :], uncertainty[..., rows, :], weight, floor) for rows, weight in weights
    ]
    return th.cat(parts, dim=-2)


def _critic_metrics(q_data: th.Tensor, q_ood: th.Tensor, n_ood: int) -> dict[str, th.Tensor]:
    """Diagnostics of the critics before their step."""
    q_policy = q_ood[..., :n_ood, :].mean()
    return {
        **q_data_metrics(q_data),
        "q_policy": q_policy,
        "q_next_policy": q_ood[..., n_ood:, :].mean(),
        "q_gap": q_policy - q_data.mean(),
        "uncertainty_data": losses.ensemble_std(q_data).mean(),
        "uncertainty_policy": losses.ensemble_std(q_ood[..., :n_ood, :]).mean(),
    }
