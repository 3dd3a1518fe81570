"""DCE: offline RL with double conservative estimates (Zhao, Huang, Yuan, OpenReview reEMFxIRMAl)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples, Schedule

from sb3_dce import losses
from sb3_dce.attaching import DatasetLike
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.checks import check_choice, check_number, check_optional
from sb3_dce.entropy import ENT_COEF, EntropyCoefficient, descend_ent_coef
from sb3_dce.errors import ConfigError
from sb3_dce.execution import Update, UpdateOptions, bound_update
from sb3_dce.hyperparams import constructor_parameters
from sb3_dce.networks import OfflineCritic, ValueNet
from sb3_dce.noise import NoiseSpec
from sb3_dce.policies import OfflineSACPolicy
from sb3_dce.schedules import StepSchedule
from sb3_dce.state import PureNet, Storage
from sb3_dce.steps import Forward, action_metrics, descend, descend_from, polyak, q_data_metrics
from sb3_dce.theory import beta_eff, shift_factor

PENALTY_SOURCES = ("policy", "policy_deterministic", "next_policy", "dataset", "uniform")
PENALTY_FORMS = ("linear", "hinge", "cql", "logsumexp")
REDUCTIONS = ("min", "mean", "first")


@dataclass(frozen=True)
class DCEOptions(UpdateOptions):
    """Choices of :func:`update` that are fixed when it is traced; see :class:`OfflineDCE` for their meaning."""

    use_v: bool
    use_target_v: bool
    learned_ent_coef: bool
    penalty_action_source: str
    n_penalty_actions: int
    share_policy_sample: bool
    penalty_form: str
    penalty_floor: float | None
    v_target_reduction: str
    v_target_timing: str
    actor_q: str
    q_target_clip: float | None
    n_masks: tuple[int, int]  # critics, hidden layers with dropout; (0, 0) without dropout
    dropout_in_target: bool


class OfflineDCE(EntropyCoefficient, OfflineAlgorithm):
    """
    Offline RL with double conservative estimates: V by expectile regression, Q by TD on V plus ``beta * E[Q(s, a ~ pi)]``.

    Paper against code: tau -> ``expectile``, upsilon -> ``tau``, alpha -> ``ent_coef``, beta -> ``beta``. In effect the
    penalty shifts Q on the data by exactly ``-beta_eff = -beta / (2 * td_loss_coef)`` per Bellman step, like the reward
    ``r - beta_eff``, and lowers actions away from the data at least as much. The logged ``train/gap_td`` checks this
    identity: it stays about 0 with the linear penalty.

    ``beta=0`` is the paper's SAC with V; ``use_v=False, td_loss_coef=0.5, beta=4, ent_coef=1.0`` its Eq. 18 agent.
    Parameters not listed here are described in :class:`~sb3_dce.base.OfflineAlgorithm`.

    :param expectile: level of V in (0, 1), the paper's tau; raising it follows the better actions of the data more closely
    :param ent_coef: SAC temperature (the paper's alpha): a number, ``"auto"``, or ``"auto_0.1"`` to start at 0.1
    :param target_entropy: entropy aimed at, in nats, when ``ent_coef`` is learned; ``"auto"`` is minus the action dimension
    :param beta: penalty weight at the start, reward units; raising it makes Q more conservative
    :param beta_final: value the schedule never passes; ``None`` for a constant beta
    :param beta_rate: amount subtracted at each change of beta; negative makes beta rise
    :param beta_update_every: epochs between two changes (paper: 50)
    :param steps_per_epoch: gradient steps in one epoch (paper: 1000)
    :param td_loss_coef: factor before the TD mean square; 1 is Eq. 6 as printed, 0.5 are the units of the paper's theory
    :param penalty_action_source: where a' of the penalty comes from: ``"policy"`` (paper), ``"policy_deterministic"``,
        ``"next_policy"`` (the policy at s', valued at s), ``"dataset"`` (the paper's variant without a policy),
        ``"uniform"``
    :param n_penalty_actions: actions a' per state
    :param share_policy_sample: use the draw of the actor loss as (first) penalty action; same distribution, less work
    :param penalty_form: ``"linear"`` (paper), ``"hinge"`` relu(Q(s, a') - V(s)), ``"cql"`` Q(s, a') - Q(s, a),
        ``"logsumexp"`` over the penalty actions minus Q(s, a); with the last three gap_td is not expected to be 0
    :param penalty_floor: no penalty gradient where Q(s, a') is below this value, reward units; ``None`` is off
    :param use_v: False bootstraps on the target critics at a' ~ pi(s') instead of V(s') (paper, Eq. 18)
    :param use_target_v: bootstrap on a moving average of V
    :param v_target_reduction: reduction of the target critics in V's target: ``"min"``, ``"mean"``, ``"first"``
    :param v_target_timing: V(s') of the TD target ``"updated"`` (after V's step of this update) or ``"previous"``
    :param actor_q: reduction of the critics in the actor loss: ``"min"``, ``"mean"``, or ``"first"`` (as printed)
    :param policy_update_freq: actor and temperature step once every so many updates
    :param critic_dropout: dropout after each hidden activation of the critics, in the critic loss only (paper: 0.1 on
        Adroit human data)
    :param dropout_in_target: also drop units of the target critics
    :param critic_layer_norm: layer normalisation in the critics
    :param critic_weight_decay: L2 coefficient of the critics' optimizer
    :param q_target_clip: clip the TD target to [-q_target_clip, q_target_clip]; ``None`` is off
    """

    algo_name: ClassVar[str] = "dce"
    networks: ClassVar[tuple[str, ...]] = ("actor", "critic", "critic_target", "value_net", "value_net_target")
    population_scalars = frozenset(
        {
            *("expectile", "td_loss_coef"),
            *("beta", "beta_final", "beta_rate", "beta_update_every", "steps_per_epoch"),
        }
    )
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": OfflineSACPolicy}
    policy: OfflineSACPolicy
    critic: OfflineCritic
    critic_target: OfflineCritic
    value_net: ValueNet | None

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
        expectile: float = 0.7,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        beta: float = 4.0,
        beta_final: float | None = None,
        beta_rate: float = 0.0,
        beta_update_every: int = 50,
        steps_per_epoch: int = 1000,
        td_loss_coef: float = 1.0,
        penalty_action_source: str = "policy",
        n_penalty_actions: int = 1,
        share_policy_sample: bool = True,
        penalty_form: str = "linear",
        penalty_floor: float | None = None,
        use_v: bool = True,
        use_target_v: bool = False,
        v_target_reduction: str = "min",
        v_target_timing: str = "updated",
        actor_q: str = "min",
        policy_update_freq: int = 1,
        critic_dropout: float = 0.0,
        dropout_in_target: bool = False,
        critic_layer_norm: bool = False,
        critic_weight_decay: float = 0.0,
        max_grad_norm: float | None = None,
        q_target_clip: float | None = None,
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
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy
        self.beta = beta
        self.beta_final = beta_final
        self.beta_rate = beta_rate
        self.beta_update_every = beta_update_every
        self.steps_per_epoch = steps_per_epoch
        self.td_loss_coef = td_loss_coef
        self.penalty_action_source = penalty_action_source
        self.n_penalty_actions = n_penalty_actions
        self.share_policy_sample = share_policy_sample
        self.penalty_form = penalty_form
        self.penalty_floor = penalty_floor
        self.use_v = use_v
        self.use_target_v = use_target_v
        self.v_target_reduction = v_target_reduction
        self.v_target_timing = v_target_timing
        self.actor_q = actor_q
        self.policy_update_freq = policy_update_freq
        self.critic_dropout = critic_dropout
        self.dropout_in_target = dropout_in_target
        self.critic_layer_norm = critic_layer_norm
        self.critic_weight_decay = critic_weight_decay
        self.q_target_clip = q_target_clip
        if _init_setup_model:
            self._setup_model()

    # -- set-up ----------------------------------------------------------------------------------------------------

    def check_parameters(self) -> None:
        super().check_parameters()
        check_number("expectile", self.expectile, 0, 1, open_low=True, open_high=True, hint="The paper uses 0.7.")
        check_number("beta", self.beta, 0, hint="0 is SAC with V; the paper's values are in zoo_hyperparams/dce.yml.")
        check_optional("beta_final", self.beta_final, 0, hint="None keeps beta constant.")
        check_number("beta_rate", self.beta_rate, -float("inf"), open_low=True, hint="0 keeps beta constant.")
        check_number("td_loss_coef", self.td_loss_coef, 0, open_low=True, hint="The paper's Eq. 6 is 1.")
        check_number("critic_dropout", self.critic_dropout, 0, 1, open_high=True, hint="The paper uses 0.1 on human data.")
        for name in ("beta_update_every", "steps_per_epoch", "n_penalty_actions", "policy_update_freq"):
            check_number(name, getattr(self, name), 1, integer=True)
        check_number("critic_weight_decay", self.critic_weight_decay, 0)
        check_optional("penalty_floor", self.penalty_floor, -float("inf"), open_low=True)
        check_optional("q_target_clip", self.q_target_clip, 0, open_low=True)
        check_choice("penalty_action_source", self.penalty_action_source, PENALTY_SOURCES)
        check_choice("penalty_form", self.penalty_form, PENALTY_FORMS)
        check_choice("v_target_reduction", self.v_target_reduction, REDUCTIONS)
        check_choice("v_target_timing", self.v_target_timing, ("updated", "previous"))
        check_choice("actor_q", self.actor_q, REDUCTIONS)
        if self.penalty_action_source in ("dataset", "policy_deterministic") and self.n_penalty_actions > 1:
            raise ConfigError(
                f"n_penalty_actions={self.n_penalty_actions} with penalty_action_source={self.penalty_action_source!r} "
                "would repeat one action",
                key="n_penalty_actions",
                hint="Use n_penalty_actions=1 with this source.",
            )
        if not self.use_v and (self.use_target_v or self.penalty_form == "hinge"):
            raise ConfigError(
                "use_target_v=True and penalty_form='hinge' need the state-value network, got use_v=False",
                key="use_v",
                hint="Set use_v=True, or choose another form.",
            )
        if self.dropout_in_target and (self.critic_dropout == 0 or not self.use_v):
            raise ConfigError(
                "dropout_in_target=True drops units of the target critics that V learns from; it needs critic_dropout above 0 "
                f"and use_v=True, got critic_dropout={self.critic_dropout} and use_v={self.use_v}",
                key="dropout_in_target",
                hint="Leave it out, or set critic_dropout=0.1 (the paper's value on human data).",
            )
        self._beta_schedule()

    def _beta_schedule(self) -> StepSchedule:
        return StepSchedule.of(vars(self))

    def policy_settings(self) -> dict[str, Any]:
        # Agents without such parameters of their own leave them to policy_kwargs.
        own = constructor_parameters(type(self)).keys() & {"critic_layer_norm", "critic_weight_decay"}
        settings = {name: getattr(self, name) for name in sorted(own)}
        return {**super().policy_settings(), "use_v": self.use_v, "use_target_v": self.use_target_v, **settings}

    # -- what the base class needs ---------------------------------------------------------------------------------

    def make_update(self, storages: dict[str, Storage]) -> Update:
        nets = {
            "actor": PureNet(self.actor, "get_action_dist_params"),
            "critic": PureNet(self.critic),
            "critic_target": PureNet(self.critic_target),
        }
        if self.value_net is not None:
            nets["value_net"] = PureNet(self.value_net)
        options = DCEOptions(
            use_v=self.use_v,
            use_target_v=self.use_target_v,
            learned_ent_coef=ENT_COEF in storages,
            penalty_action_source=self.penalty_action_source,
            n_penalty_actions=self.n_penalty_actions,
            share_policy_sample=self.share_policy_sample,
            penalty_form=self.penalty_form,
            penalty_floor=self.penalty_floor,
            v_target_reduction=self.v_target_reduction,
            v_target_timing=self.v_target_timing,
            actor_q=self.actor_q,
            q_target_clip=self.q_target_clip,
            max_grad_norm=self.max_grad_norm,
            n_masks=self._n_masks(),
            dropout_in_target=self.dropout_in_target,
        )
        return bound_update(update, options, nets, storages)

    def update_variant(self, n_updates: int) -> dict[str, Any]:
        return {"with_actor": (n_updates + 1) % self.policy_update_freq == 0}

    def noise_specs(self, batch_size: int) -> dict[str, NoiseSpec]:
        action_dim = get_action_dim(self.action_space)
        specs = {"actor": NoiseSpec("normal", (batch_size, action_dim))}
        if (n_extra := self._n_extra_penalty_actions()) > 0:
            kind = "uniform" if self.penalty_action_source == "uniform" else "normal"
            specs["penalty"] = NoiseSpec(kind, (n_extra * batch_size, action_dim))
        if not self.use_v:
            specs["next_actor"] = NoiseSpec("normal", (batch_size, action_dim))
        n_critics, n_layers = self._n_masks()
        widths = self.policy.critic_arch
        for i in range(n_critics):
            for j in range(n_layers):
                rows = (1 + self.n_penalty_actions) * batch_size
                specs[f"dropout_{i}_{j}"] = NoiseSpec("dropout", (rows, widths[j]), self.critic_dropout)
                if self.dropout_in_target:
                    specs[f"target_dropout_{i}_{j}"] = NoiseSpec("dropout", (batch_size, widths[j]), self.critic_dropout)
        return specs

    def _n_extra_penalty_actions(self) -> int:
        """Draws of the penalty beyond the one shared with the actor loss."""
        if self.penalty_action_source in ("dataset", "policy_deterministic"):
            return 0
        shared = self.penalty_action_source == "policy" and self.share_policy_sample
        return self.n_penalty_actions - (1 if shared else 0)

    def _n_masks(self) -> tuple[int, int]:
        if self.critic_dropout == 0:
            return (0, 0)
        return (self.critic.n_critics, len(self.policy.critic_arch))

    def coefficients(self, n_updates: int) -> dict[str, float]:
        beta = self._beta_schedule().value(n_updates)
        return {
            **super().coefficients(n_updates),
            "expectile": self.expectile,
            "td_loss_coef": self.td_loss_coef,
            "beta": beta,
            "beta_eff": beta_eff(beta, self.td_loss_coef),
        }

    def coefficients_hold_until(self, n_updates: int) -> int:
        if callable(self.learning_rate):
            return n_updates + 1
        every = self._beta_schedule().every
        return (n_updates // every + 1) * every

    def derived_metrics(self, means: dict[str, float]) -> dict[str, float]:
        n, extra = self._n_updates, {"epoch": self._n_updates / self.steps_per_epoch}
        if self.penalty_form != "linear":  # another form does not lower Q on the data by beta_eff at each step
            return extra
        # what the closed form assumes: V itself is bootstrapped on, and nothing else than the penalty moves Q off its target
        if self.use_v and not self.use_target_v and self.penalty_floor is None and not self.critic_weight_decay:
            # Q is linear in beta: every change of beta shifts it as if it had been there alone
            changes = self._beta_schedule().changes(n)
            factors = [(shift_factor(n - at, self.gamma, self.tau), by) for at, by in changes]
            extra["beta_pred_shift"] = sum(factor * beta_eff(by, self.td_loss_coef) for factor, by in factors)
        if self.dataset_statistics is not None:
            extra["survival_margin"] = self._mean_reward() - means["beta_eff"]
        return extra

    def check_dataset_fits(self, reward_mean: float, n_terminals: int) -> list[str]:
        shift = beta_eff(self._beta_schedule().largest, self.td_loss_coef)
        if self.penalty_form == "linear" and n_terminals > 0 and shift > reward_mean:
            return [
                f"beta / (2 * td_loss_coef) = {shift:.3g} is above the mean reward per step {reward_mean:.3g} of data with "
                "true terminals: ending an episode becomes attractive. Lower beta."
            ]
        return []


def update(
    options: DCEOptions,
    nets: dict[str, PureNet],
    settings: dict[str, Any],
    state: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
    coef: dict[str, th.Tensor],
    with_actor: bool = True,
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    One gradient step of DCE, in the order V, Q, targets, temperature, actor (paper, Algorithm 1).

    Pure: nothing is drawn, read back or changed in place. What a loss does not differentiate needs no ``detach``, since
    :func:`~sb3_dce.steps.descend` looks at its argument only.

    :param options: choices fixed at trace time
    :param nets: networks as functions of their flat parameters
    :param settings: optimizer constants of each learner
    :param state: learners "actor", "critic", "value_net", "log_ent_coef" and flat targets
    :param batch: tensors of shape (batch, ...); actions scaled to [-1, 1]
    :param noise: random numbers of this update
    :param coef: 0-dimensional coefficients
    :param with_actor: whether actor and temperature take a step
    :return: changed parts of the state, metrics
    """
    s, a, d = batch.observations, batch.actions, batch.dones
    r = coef["reward_scale"] * batch.rewards + coef["reward_shift"]
    lr, clip = coef["learning_rate"], options.max_grad_norm
    new: dict[str, Any] = {}

    actor = Forward.of(lambda params: nets["actor"](params, s)[:2], state["actor"].params)
    mean, log_std = actor.outputs
    a_pi, _ = losses.squashed_gaussian(mean, log_std, noise["actor"])
    a_pen = _penalty_actions(options, nets, state, batch, noise, (mean, log_std), a_pi)

    # 1 value
    metrics: dict[str, th.Tensor] = {}
    values = None
    if options.use_v:
        target_masks = _masks(options, noise, "target_dropout") if options.dropout_in_target else None
        q_t = losses.reduce_critics(
            nets["critic_target"](state["critic_target"], s, a, target_masks), options.v_target_reduction
        )

        def v_loss(params: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
            v = nets["value_net"](params, s)
            return losses.value_loss(q_t, v, coef["expectile"]), v

        new["value_net"], loss, values, norm = descend(v_loss, state["value_net"], lr, settings["value_net"], clip)
        advantages = q_t - values
        metrics.update(value_loss=loss, grad_norm_v=norm, value=values.mean(), adv=advantages.mean())
        metrics["adv_pos_frac"] = (advantages > 0).to(values.dtype).mean()

    # 2 critics
    next_values = _next_values(options, nets, state, new, batch, noise)
    y = losses.td_target(r, d, next_values, coef["gamma"])
    if options.q_target_clip is not None:
        y = y.clamp(-options.q_target_clip, options.q_target_clip)
    n, n_pen = a.shape[0], options.n_penalty_actions

    def q_loss(params: th.Tensor) -> tuple[th.Tensor, Any]:
        masks = _masks(options, noise, "dropout") if options.n_masks[0] else None
        q_all = nets["critic"](params, th.cat([s] * (1 + n_pen)), th.cat([a, a_pen]), masks)
        q_data, q_pen = [q[:n] for q in q_all], [q[n:] for q in q_all]
        penalty = _penalty(options, q_data, q_pen, values, coef["beta"])
        return losses.critic_loss(q_data, y, coef["td_loss_coef"]) + penalty, (q_data, q_pen, penalty)

    new["critic"], loss, (q_data, q_pen, penalty), norm = descend(q_loss, state["critic"], lr, settings["critic"], clip)
    metrics.update(critic_loss=loss, grad_norm_q=norm, penalty=penalty, value_next=next_values.mean(), td_target=y.mean())
    metrics.update(_critic_metrics(q_data, q_pen, y, coef))

    # 3 targets
    new["critic_target"] = polyak(new["critic"].params, state["critic_target"], coef["tau"])
    if options.use_target_v:
        new["value_net_target"] = polyak(new["value_net"].params, state["value_net_target"], coef["tau"])

    # 4 and 5 temperature and actor; alpha is the value before the temperature's step, as in Stable-Baselines3
    metrics.update(action_metrics(a_pi, a))
    if not with_actor:
        return new, metrics
    ent_coef = state[ENT_COEF].params.exp() if options.learned_ent_coef else coef["ent_coef"]

    def pi_loss(outputs: tuple[th.Tensor, ...]) -> tuple[th.Tensor, th.Tensor]:
        mean, log_std = outputs
        actions, log_prob = losses.squashed_gaussian(mean, log_std, noise["actor"])
        q_pi = losses.reduce_critics(nets["critic"](new["critic"].params, s, actions), options.actor_q)
        return losses.sac_actor_loss(log_prob, q_pi, ent_coef), log_prob

    new["actor"], loss, log_prob, norm = descend_from(actor, pi_loss, state["actor"], lr, settings["actor"], clip)
    metrics.update(actor_loss=loss, grad_norm_actor=norm, entropy=-log_prob.mean(), ent_coef=ent_coef.mean())
    if options.learned_ent_coef:
        new[ENT_COEF], metrics["ent_coef_loss"] = descend_ent_coef(
            state[ENT_COEF], log_prob, coef["target_entropy"], lr, settings[ENT_COEF]
        )
    return new, metrics


def _penalty_actions(
    options: DCEOptions,
    nets: dict[str, PureNet],
    state: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
    actor_output: tuple[th.Tensor, th.Tensor],
    a_pi: th.Tensor,
) -> th.Tensor:
    """Actions a' of the penalty, shape (n_penalty_actions * batch, action_dim)."""
    source, extra = options.penalty_action_source, noise.get("penalty")
    if source == "dataset":
        return batch.actions
    if source == "policy_deterministic":
        return th.tanh(actor_output[0])
    if source == "uniform":
        assert extra is not None
        return 2.0 * extra - 1.0
    mean, log_std = actor_output
    if source == "next_policy":
        mean, log_std, _ = nets["actor"](state["actor"].params, batch.next_observations)
    shared = [a_pi] if source == "policy" and options.share_policy_sample else []
    if extra is None:
        return a_pi
    repeats = extra.shape[0] // mean.shape[0]
    drawn, _ = losses.squashed_gaussian(mean.repeat(repeats, 1), log_std.repeat(repeats, 1), extra)
    return th.cat([*shared, drawn])


def _next_values(
    options: DCEOptions,
    nets: dict[str, PureNet],
    state: dict[str, Any],
    new: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
) -> th.Tensor:
    """Value of the next state in the TD target, shape (batch, 1)."""
    s2 = batch.next_observations
    if not options.use_v:
        mean, log_std, _ = nets["actor"](state["actor"].params, s2)
        a2, _ = losses.squashed_gaussian(mean, log_std, noise["next_actor"])
        return losses.reduce_critics(nets["critic_target"](state["critic_target"], s2, a2), "min")
    if options.use_target_v:
        return nets["value_net"](state["value_net_target"], s2)
    learner = (new if options.v_target_timing == "updated" else state)["value_net"]
    return nets["value_net"](learner.params, s2)


def _penalty(
    options: DCEOptions, q_data: list[th.Tensor], q_pen: list[th.Tensor], values: th.Tensor | None, beta: th.Tensor
) -> th.Tensor:
    """Penalty term of the critic loss, 0-dimensional."""
    if options.penalty_floor is not None:
        q_pen = [losses.floored(q, options.penalty_floor) for q in q_pen]
    if options.penalty_form == "hinge":
        assert values is not None
        q_pen = [losses.hinge(q, values.repeat(options.n_penalty_actions, 1)) for q in q_pen]
    elif options.penalty_form == "cql":
        q_pen = [q - qd.repeat(options.n_penalty_actions, 1) for q, qd in zip(q_pen, q_data, strict=True)]
    elif options.penalty_form == "logsumexp":
        per_state = [q.view(options.n_penalty_actions, -1, 1) for q in q_pen]
        q_pen = [th.logsumexp(q, dim=0) - qd for q, qd in zip(per_state, q_data, strict=True)]
    return losses.policy_penalty(q_pen, beta)


def _masks(options: DCEOptions, noise: dict[str, th.Tensor], prefix: str) -> list[list[th.Tensor]]:
    n_critics, n_layers = options.n_masks
    return [[noise[f"{prefix}_{i}_{j}"] for j in range(n_layers)] for i in range(n_critics)]


def _critic_metrics(
    q_data: list[th.Tensor], q_pen: list[th.Tensor], y: th.Tensor, coef: dict[str, th.Tensor]
) -> dict[str, th.Tensor]:
    """Diagnostics of the critics before their step; ``gap_td`` is about 0 by the bias identity of the linear penalty."""
    data, penalised = th.cat(q_data, dim=-1), th.cat(q_pen, dim=-1)
    per_critic = {f"q{i}_data": q.mean() for i, q in enumerate(q_data)}
    return {
        **per_critic,
        **q_data_metrics(data),
        "q_policy": penalised.mean(),
        "q_gap": penalised.mean() - data.mean(),
        "td_mse": (data - y).square().mean(),
        "gap_td": (data - y).mean() + coef["beta_eff"],
        "beta": coef["beta"],
        "beta_eff": coef["beta_eff"],
        "twin_gap": (data.max(dim=-1).values - data.min(dim=-1).values).mean(),
    }
