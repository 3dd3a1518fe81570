"""CQL(H): conservative Q-learning, entropy version with importance sampling (Kumar et al., 2020)."""

from __future__ import annotations

import math
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
from sb3_dce.checks import check_choice, check_number, check_optional
from sb3_dce.ensembles import EnsembleNet
from sb3_dce.entropy import EntropyCoefficient, stepped_ent_coef
from sb3_dce.execution import Update, UpdateOptions, bound_update
from sb3_dce.networks import OfflineCritic
from sb3_dce.noise import NoiseSpec
from sb3_dce.policies import OfflineSACPolicy
from sb3_dce.state import LearnedNumber, PureNet, Storage
from sb3_dce.steps import action_metrics, descend, polyak, q_data_metrics
from sb3_dce.warm_up import ActorWarmUp

LAGRANGE = "log_lagrange"  # name of the multiplier's learner in the state tree
LAGRANGE_FORMS = ("weighted_gap", "gap")
# The authors' code clips the multiplier here.
MAX_LAGRANGE = 1e6


@dataclass(frozen=True)
class CQLOptions(UpdateOptions):
    """Choices of :func:`update` that are fixed when it is traced; see :class:`OfflineCQL` for their meaning."""

    lagrange: bool
    lagrange_form: str
    actor_q_timing: str


class OfflineCQL(ActorLearningRate, ActorWarmUp, EntropyCoefficient, OfflineAlgorithm):
    """
    Conservative Q-learning: SAC's critics with ``w * (log sum_a' exp Q(s, a') - Q(s, a))`` added to their loss.

    The sum over actions is estimated from uniform actions, actions of the policy at s and actions of the policy at s' (all
    valued at s), each divided by its density. All hidden layers have 256 units, three per network. The target has no
    entropy term. Differences from the authors' code: none in the formulas of the critics; the actor is that of
    Stable-Baselines3, whose log standard deviation goes down to -20 (theirs to -5); the first phase takes one update more,
    bounds no mean (theirs: 9) and clips the data's actions 1e-5 inside of their bounds; one Adam over both critics, which is
    the same as one each; targets start as copies of the critics, with PyTorch's first weights.

    Parameters not listed here are described in :class:`~sb3_dce.base.OfflineAlgorithm`.

    :param learning_rate: rate of the critics and of the Lagrange multiplier, or a schedule of the remaining progress
    :param actor_learning_rate: rate of actor and temperature; ``None`` takes ``learning_rate``
    :param ent_coef: temperature: a number, ``"auto"``, or ``"auto_0.1"`` to start at 0.1. A learned one is used after its
        step, as in the authors' code
    :param target_entropy: entropy aimed at, in nats, when ``ent_coef`` is learned; ``"auto"`` is minus the action dimension
    :param cql_weight: w, the weight of the regulariser; raising it makes Q more conservative. The authors use 5 or 10
        without a Lagrange multiplier
    :param n_actions: actions of each of the three kinds per state (authors: 10), 3 * n_actions + 1 critic rows per sample
    :param lagrange_threshold: learn a multiplier of the regulariser that holds it at this value, reward units; ``None`` is
        off
    :param lagrange_form: with multiplier m and threshold t, ``"weighted_gap"`` is m (w gap - t), the authors' code,
        ``"gap"`` is m w (gap - t), as in the reimplementation by Geng
    :param max_q_backup: bootstrap on the best of ``n_actions`` policy actions at s' instead of on one (AntMaze)
    :param policy_eval_start: updates at the start in which the actor clones the data instead of following Q, for a run of a
        million; a training that ends before is pure cloning, which a warning says
    :param actor_q_timing: critics of the actor loss: ``"previous"`` (before their step of this update, authors) or
        ``"updated"``
    """

    algo_name: ClassVar[str] = "offline_cql"
    networks = ("actor", "critic", "critic_target")
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": OfflineSACPolicy}
    population_scalars = frozenset({"cql_weight", "lagrange_threshold"})
    policy: OfflineSACPolicy
    critic: OfflineCritic
    critic_target: OfflineCritic
    log_lagrange: th.Tensor | None
    lagrange_optimizer: th.optim.Optimizer | None

    def __init__(
        self,
        policy: str | type[OfflineSACPolicy],
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
        cql_weight: float = 10.0,
        n_actions: int = 10,
        lagrange_threshold: float | None = None,
        lagrange_form: str = "weighted_gap",
        max_q_backup: bool = False,
        policy_eval_start: int = 40_000,
        actor_q_timing: str = "previous",
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
        self.cql_weight = cql_weight
        self.n_actions = n_actions
        self.lagrange_threshold = lagrange_threshold
        self.lagrange_form = lagrange_form
        self.max_q_backup = max_q_backup
        self.policy_eval_start = policy_eval_start
        self.actor_q_timing = actor_q_timing
        if _init_setup_model:
            self._setup_model()

    # -- set-up ----------------------------------------------------------------------------------------------------

    def check_parameters(self) -> None:
        super().check_parameters()
        check_number("cql_weight", self.cql_weight, 0, hint="The authors use 5 or 10; 1 with a Lagrange multiplier.")
        check_number("n_actions", self.n_actions, 1, integer=True)
        check_optional("lagrange_threshold", self.lagrange_threshold, 0)
        check_choice("lagrange_form", self.lagrange_form, LAGRANGE_FORMS)

    def policy_settings(self) -> dict[str, Any]:
        return {**super().policy_settings(), "net_arch": [256, 256, 256]}

    def learned_numbers(self) -> dict[str, LearnedNumber]:
        start = None if self.lagrange_threshold is None else th.zeros(1)
        return {**super().learned_numbers(), LAGRANGE: LearnedNumber("lagrange_optimizer", start, self.lr_schedule(1))}

    # -- what the base class needs ---------------------------------------------------------------------------------

    def make_update(self, storages: dict[str, Storage]) -> Update:
        nets = {
            "actor": PureNet(self.actor, "get_action_dist_params"),
            "critic": EnsembleNet(self.critic),
            "critic_target": EnsembleNet(self.critic_target),
        }
        options = CQLOptions(
            lagrange=LAGRANGE in storages,
            lagrange_form=self.lagrange_form,
            actor_q_timing=self.actor_q_timing,
            max_grad_norm=self.max_grad_norm,
        )
        return bound_update(update, options, nets, storages)

    def update_variant(self, n_updates: int) -> dict[str, Any]:
        return {"clone": self.in_warm_up(n_updates)}

    def noise_specs(self, batch_size: int) -> dict[str, NoiseSpec]:
        action_dim = get_action_dim(self.action_space)
        several = (self.n_actions, batch_size, action_dim)
        return {
            "actor": NoiseSpec("normal", (batch_size, action_dim)),
            "next_actor": NoiseSpec("normal", several if self.max_q_backup else (1, batch_size, action_dim)),
            "uniform": NoiseSpec("uniform", several),
            "policy": NoiseSpec("normal", several),
            "next_policy": NoiseSpec("normal", several),
        }

    def learning_rates(self) -> dict[str, float]:
        rates = super().learning_rates()
        return {**rates, "log_ent_coef_learning_rate": rates["actor_learning_rate"]}

    def coefficients(self, n_updates: int) -> dict[str, float]:
        coefficients = {**super().coefficients(n_updates), "cql_weight": self.cql_weight}
        if self.lagrange_threshold is not None:
            coefficients["lagrange_threshold"] = self.lagrange_threshold
        return coefficients


def update(
    options: CQLOptions,
    nets: dict[str, Any],
    settings: dict[str, Any],
    state: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
    coef: dict[str, th.Tensor],
    clone: bool,
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    One gradient step of CQL(H), in the authors' order: temperature, critics, multiplier, actor, targets.

    Every sample comes from the policy before its step. What a loss does not differentiate needs no ``detach``, since
    :func:`~sb3_dce.steps.descend` looks at its argument only.

    :param options: choices fixed at trace time
    :param nets: networks as functions of their flat parameters
    :param settings: optimizer constants of each learner
    :param state: learners "actor", "critic", "log_ent_coef", "log_lagrange" and the flat target
    :param batch: tensors of shape (batch, ...); actions scaled to [-1, 1]
    :param noise: random numbers of this update; those of several actions have shape (n_actions, batch, action_dim)
    :param coef: 0-dimensional coefficients
    :param clone: whether the actor clones the data instead of following the critics
    :return: changed parts of the state, metrics
    """
    s, a, s2, d = batch.observations, batch.actions, batch.next_observations, batch.dones
    r = coef["reward_scale"] * batch.rewards + coef["reward_shift"]
    mean, log_std, _ = nets["actor"](state["actor"].params, s)
    mean2, log_std2, _ = nets["actor"](state["actor"].params, s2)

    # 1 temperature; alpha is the value after its step
    a_pi, log_prob = losses.squashed_gaussian(mean, log_std, noise["actor"])
    stepped, ent_coef, metrics = stepped_ent_coef(state, coef, log_prob, settings)
    new: dict[str, Any] = {**stepped}

    # 2 target: each critic's best action, then the smallest critic
    a2, _ = losses.squashed_gaussian(mean2, log_std2, noise["next_actor"])
    q_next = _of_actions(nets["critic_target"](state["critic_target"], _repeated(s2, len(a2)), a2.flatten(0, 1)), len(a2))
    next_values = q_next.amax(dim=-3).amin(dim=-3)
    y = losses.td_target(r, d, next_values, coef["gamma"])

    # 3 critics: the data and all sampled actions, valued at s, in one call
    a_uniform = 2.0 * noise["uniform"] - 1.0
    a_next, log_prob_next = losses.squashed_gaussian(mean2, log_std2, noise["next_policy"])
    a_now, log_prob_now = losses.squashed_gaussian(mean, log_std, noise["policy"])
    sampled = th.cat([a_uniform, a_next, a_now])
    log_uniform = th.full_like(log_prob_now, a.shape[-1] * math.log(0.5))
    log_densities = th.cat([log_uniform, log_prob_next, log_prob_now])
    states, actions = _repeated(s, 1 + len(sampled)), th.cat([a, sampled.flatten(0, 1)])
    n = a.shape[0]
    multiplier = state[LAGRANGE].params.exp().clamp(0.0, MAX_LAGRANGE) if options.lagrange else None

    def q_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor, th.Tensor]]:
        q_all = nets["critic"](params, states, actions)
        q_data, q_sampled = q_all[..., :n, :], _of_actions(q_all[..., n:, :], len(sampled))
        gaps = losses.cql_gap(q_data, q_sampled, log_densities)
        td = losses.mean_square(q_data, y)
        return (td + _penalties(options, gaps, multiplier, coef)).sum(), (q_data, q_sampled, gaps)

    clip = options.max_grad_norm
    new["critic"], loss, kept, norm = descend(q_loss, state["critic"], coef["learning_rate"], settings["critic"], clip)
    q_data, q_sampled, gaps = kept
    metrics.update(critic_loss=loss, grad_norm_q=norm, value_next=next_values.mean(), td_target=y.mean())
    metrics.update(_critic_metrics(q_data, q_sampled, y))
    metrics.update(cql_gap=gaps.mean(), cql_penalty=_penalties(options, gaps, multiplier, coef).mean())

    # 4 multiplier: ascends on the mean of the critics; the critics saw it before its step
    if options.lagrange:

        def lagrange_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[()]]:
            return -_penalties(options, gaps, params.exp().clamp(0.0, MAX_LAGRANGE), coef).mean(), ()

        new[LAGRANGE], _, _, _ = descend(lagrange_loss, state[LAGRANGE], coef["learning_rate"], settings[LAGRANGE])
        assert multiplier is not None
        metrics["lagrange"] = multiplier.mean()

    # 5 actor
    critic_params = (state if options.actor_q_timing == "previous" else new)["critic"].params

    def pi_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[()]]:
        mean, log_std, _ = nets["actor"](params, s)
        actions, log_prob = losses.squashed_gaussian(mean, log_std, noise["actor"])
        if clone:
            return losses.batch_mean(ent_coef * log_prob) + losses.bc_nll(mean, log_std, a), ()
        q_pi = nets["critic"](critic_params, s, actions)
        return losses.sac_actor_loss(log_prob, q_pi.amin(dim=-3), ent_coef), ()

    rate = coef["actor_learning_rate"]
    new["actor"], loss, _, norm = descend(pi_loss, state["actor"], rate, settings["actor"], clip)
    metrics.update(actor_loss=loss, grad_norm_actor=norm, entropy=-log_prob.mean(), ent_coef=ent_coef.mean())
    metrics.update(bc_loss=losses.bc_nll(mean, log_std, a), **action_metrics(a_pi, a))
    metrics["actor_learning_rate"] = rate

    # 6 targets
    new["critic_target"] = polyak(new["critic"].params, state["critic_target"], coef["tau"])
    return new, metrics


def _penalties(options: CQLOptions, gaps: th.Tensor, multiplier: th.Tensor | None, coef: dict[str, th.Tensor]) -> th.Tensor:
    """Regulariser of each critic with its weight and, if it is learned, the multiplier; shape (n_critics,)."""
    if multiplier is None:
        return coef["cql_weight"] * gaps
    if options.lagrange_form == "gap":
        return multiplier * coef["cql_weight"] * (gaps - coef["lagrange_threshold"])
    return multiplier * (coef["cql_weight"] * gaps - coef["lagrange_threshold"])


def _repeated(obs: th.Tensor, times: int) -> th.Tensor:
    """The batch several times over, shape (times * batch, ...)."""
    return obs.expand(times, *obs.shape).flatten(0, 1)


def _of_actions(q_values: th.Tensor, n_actions: int) -> th.Tensor:
    """Values of a repeated batch by action, shape (n_critics, n_actions, batch, 1)."""
    return q_values.view(*q_values.shape[:-2], n_actions, -1, 1)


def _critic_metrics(q_data: th.Tensor, q_sampled: th.Tensor, y: th.Tensor) -> dict[str, th.Tensor]:
    """Diagnostics of the critics before their step."""
    q_uniform, q_next, q_policy = q_sampled.chunk(3, dim=-3)
    return {
        **{f"q{i}_data": q.mean() for i, q in enumerate(q_data)},
        **q_data_metrics(q_data),
        "q_policy": q_policy.mean(),
        "q_next_policy": q_next.mean(),
        "q_uniform": q_uniform.mean(),
        "q_gap": q_policy.mean() - q_data.mean(),
        "td_mse": (q_data - y).square().mean(),
        "twin_gap": (q_data.amax(dim=0) - q_data.amin(dim=0)).mean(),
    }
