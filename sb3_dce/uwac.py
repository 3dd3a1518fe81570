"""UWAC: BEAR with targets and policy weighted by the uncertainty of Monte-Carlo dropout (Wu et al., 2021)."""

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
from sb3_dce.checks import check_number, check_widths
from sb3_dce.execution import Update, UpdateOptions, bound_update
from sb3_dce.noise import NoiseSpec
from sb3_dce.state import LearnedNumber, PureNet, Storage
from sb3_dce.steps import action_metrics, descend, polyak, q_data_metrics
from sb3_dce.uwac_networks import ActionVAE, DropoutCritic
from sb3_dce.uwac_policy import VAE_NET_ARCH, UWACPolicy
from sb3_dce.warm_up import ActorWarmUp

# Names in the state tree: the multiplier of the MMD constraint, and the vectors of the critics' power iteration.
LOG_ALPHA = "log_alpha"
VECTORS, TARGET_VECTORS = "critic_vectors", "critic_target_vectors"
# Constants of the authors' code.
LOG_ALPHA_LIMITS = (-5.0, 10.0)
KL_WEIGHT = 0.5


@dataclass(frozen=True)
class UWACOptions(UpdateOptions):
    """Choices of :func:`update` that are fixed when it is traced; see :class:`OfflineUWAC` for their meaning."""

    n_critics: int
    n_masks: int  # hidden layers of the critics
    weight_squared: bool
    actor_q_timing: str


class OfflineUWAC(ActorLearningRate, ActorWarmUp, OfflineAlgorithm):
    """
    Uncertainty-weighted actor-critic: targets of uncertain next actions count less.

    The base is BEAR: the target is the best of ten actions of the policy at s', the policy is kept near a variational
    autoencoder of the data by the maximum mean discrepancy (MMD) between four actions of each, taken before tanh, with a
    learned multiplier alpha. The critics have spectral normalisation on every layer and dropout that is never switched
    off; mean and variance of ``n_mc_dropout`` passes give the value and the weight ``exp(-uwac_beta * variance)`` of a
    target and of the policy's own action. ``predict`` takes the best of 100 sampled actions, see
    :class:`~sb3_dce.uwac_policy.UWACPolicy`.

    This agent is inherently slow: 2560 next actions are valued 100 times by each critic at every update.

    Differences from the authors' code: dropout masks of a pass are shared by the states of a batch (see
    :meth:`~sb3_dce.uwac_networks.DropoutCritic.mc_values`; a state's own means, variances and maxima are distributed as
    there); targets start as copies of the critics instead of drawn anew; one Adam over both critics, which is the same as
    one each; PyTorch's first weights; the actor's log standard deviation goes down to -20, as in Stable-Baselines3 (theirs to
    -5). Episodes end where the data say so, not after 999 rows.

    Names: alpha is the multiplier of the MMD, not an entropy coefficient; ``uwac_beta`` is not DCE's beta. Parameters not
    listed here are described in :class:`~sb3_dce.base.OfflineAlgorithm`.

    :param learning_rate: rate of critics and autoencoder, or a schedule of the remaining progress
    :param actor_learning_rate: rate of the actor; ``None`` takes ``learning_rate``
    :param alpha_learning_rate: rate of log alpha, which ascends on the actor's loss within [-5, 10]
    :param n_mc_dropout: dropout passes per value, at least 2. Fewer are faster and give noisier weights
    :param critic_dropout: probability that a hidden unit of the critics is dropped; 0 is BEAR with spectral normalisation
    :param uwac_beta: how fast the weight falls with the variance, per squared reward unit
    :param weight_squared: weigh the squared TD error by w^2, as the authors' code does, instead of w, as their paper says
    :param n_target_actions: actions of the policy at s' among which the target takes the best
    :param n_mmd_actions: actions of policy and autoencoder in the MMD
    :param mmd_sigma: width of the Gaussian kernel, in squared units of actions before tanh
    :param mmd_threshold: MMD above which alpha rises
    :param policy_eval_start: updates in which the actor follows the MMD alone, for a run of a million; a warning says if a
        training ends before
    :param actor_q_timing: critics of the actor loss: ``"previous"`` (before their step of this update, authors' code) or
        ``"updated"``
    :param n_predict_actions: actions drawn for a prediction
    :param vae_net_arch: hidden layers of the autoencoder, ``None`` for [750, 750]
    """

    algo_name: ClassVar[str] = "offline_uwac"
    networks = ("actor", "critic", "critic_target", "vae")
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": UWACPolicy}
    population_scalars = frozenset({"alpha_learning_rate", "uwac_beta", "mmd_sigma", "mmd_threshold"})
    policy: UWACPolicy
    critic: DropoutCritic
    critic_target: DropoutCritic
    vae: ActionVAE
    log_alpha: th.Tensor
    alpha_optimizer: th.optim.Optimizer

    def __init__(
        self,
        policy: str | type[UWACPolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        actor_learning_rate: float | None = 1e-4,
        alpha_learning_rate: float = 1e-3,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        gradient_steps: int = 1,
        n_mc_dropout: int = 100,
        critic_dropout: float = 0.1,
        uwac_beta: float = 0.5,
        weight_squared: bool = True,
        n_target_actions: int = 10,
        n_mmd_actions: int = 4,
        mmd_sigma: float = 20.0,
        mmd_threshold: float = 0.07,
        policy_eval_start: int = 40_000,
        actor_q_timing: str = "previous",
        n_predict_actions: int = 100,
        vae_net_arch: list[int] | None = None,
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
        self.alpha_learning_rate = alpha_learning_rate
        self.n_mc_dropout = n_mc_dropout
        self.critic_dropout = critic_dropout
        self.uwac_beta = uwac_beta
        self.weight_squared = weight_squared
        self.n_target_actions = n_target_actions
        self.n_mmd_actions = n_mmd_actions
        self.mmd_sigma = mmd_sigma
        self.mmd_threshold = mmd_threshold
        self.policy_eval_start = policy_eval_start
        self.actor_q_timing = actor_q_timing
        self.n_predict_actions = n_predict_actions
        self.vae_net_arch = vae_net_arch
        if _init_setup_model:
            self._setup_model()

    # -- set-up ----------------------------------------------------------------------------------------------------

    def check_parameters(self) -> None:
        super().check_parameters()
        check_number("alpha_learning_rate", self.alpha_learning_rate, 0)
        check_number("n_mc_dropout", self.n_mc_dropout, 2, integer=True, hint="A variance needs two; the authors use 100.")
        check_number("critic_dropout", self.critic_dropout, 0, 1, open_high=True, hint="The authors use 0.1.")
        check_number("uwac_beta", self.uwac_beta, 0, hint="The authors use 0.5.")
        check_number("mmd_sigma", self.mmd_sigma, 0, open_low=True, hint="The authors use 20.")
        check_number("mmd_threshold", self.mmd_threshold, 0, hint="The authors use 0.07.")
        for name in ("n_target_actions", "n_mmd_actions", "n_predict_actions"):
            check_number(name, getattr(self, name), 1, integer=True)
        if self.vae_net_arch is not None:
            check_widths("vae_net_arch", self.vae_net_arch)

    def policy_settings(self) -> dict[str, Any]:
        return {
            **super().policy_settings(),
            "critic_dropout": self.critic_dropout,
            "n_mc_dropout": self.n_mc_dropout,
            "n_predict_actions": self.n_predict_actions,
            "vae_net_arch": VAE_NET_ARCH if self.vae_net_arch is None else self.vae_net_arch,
            "critic_layer_norm": False,  # these critics have spectral normalisation
        }

    def learned_numbers(self) -> dict[str, LearnedNumber]:
        number = LearnedNumber("alpha_optimizer", th.zeros(1), self.alpha_learning_rate)
        return {**super().learned_numbers(), LOG_ALPHA: number}

    def make_storages(self) -> dict[str, Storage]:
        return {
            **super().make_storages(),
            VECTORS: Storage(self.critic.power_vectors()),
            TARGET_VECTORS: Storage(self.critic_target.power_vectors()),
        }

    # -- what the base class needs ---------------------------------------------------------------------------------

    def make_update(self, storages: dict[str, Storage]) -> Update:
        nets = {
            "actor": PureNet(self.actor, "get_action_dist_params"),
            "critic_power_step": PureNet(self.critic, "power_step"),
            "critic_values": PureNet(self.critic, "values"),
            "critic_mc_values": PureNet(self.critic, "mc_values"),
            "target_power_step": PureNet(self.critic_target, "power_step"),
            "target_mc_values": PureNet(self.critic_target, "mc_values"),
            "vae": PureNet(self.vae),
            "vae_sample": PureNet(self.vae, "sample"),
        }
        options = UWACOptions(
            n_critics=self.critic.n_critics,
            n_masks=len(self.critic.net_arch),
            weight_squared=self.weight_squared,
            actor_q_timing=self.actor_q_timing,
            max_grad_norm=self.max_grad_norm,
        )
        return bound_update(update, options, nets, storages)

    def update_variant(self, n_updates: int) -> dict[str, Any]:
        return {"mmd_only": self.in_warm_up(n_updates)}

    def noise_specs(self, batch_size: int) -> dict[str, NoiseSpec]:
        action_dim, critic = get_action_dim(self.action_space), self.critic
        masks = {
            "dropout": critic.mask_specs(critic.n_critics, batch_size),
            "target_dropout": critic.mask_specs(critic.n_critics, self.n_target_actions, self.n_mc_dropout),
            "actor_dropout": critic.mask_specs(critic.n_critics, 1, self.n_mc_dropout),
        }
        return {
            "vae": NoiseSpec("normal", (batch_size, self.vae.latent_dim)),
            "next_actor": NoiseSpec("normal", (self.n_target_actions, batch_size, action_dim)),
            "mmd_actor": NoiseSpec("normal", (self.n_mmd_actions, batch_size, action_dim)),
            "mmd_vae": NoiseSpec("normal", (self.n_mmd_actions, batch_size, self.vae.latent_dim)),
            **{f"{use}_{layer}": spec for use, specs in masks.items() for layer, spec in enumerate(specs)},
        }

    def learning_rates(self) -> dict[str, float]:
        rates = super().learning_rates()
        return {**rates, "log_alpha_learning_rate": self.alpha_learning_rate}

    def coefficients(self, n_updates: int) -> dict[str, float]:
        return {
            **super().coefficients(n_updates),
            "uwac_beta": self.uwac_beta,
            "mmd_sigma": self.mmd_sigma,
            "mmd_threshold": self.mmd_threshold,
        }


def update(
    options: UWACOptions,
    nets: dict[str, PureNet],
    settings: dict[str, Any],
    state: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
    coef: dict[str, th.Tensor],
    mmd_only: bool,
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    One gradient step of UWAC, in the authors' order: autoencoder, critics, actor, multiplier, targets.

    The power iteration takes one step before each valuation, as spectral normalisation does in training: one for the
    targets, two for the critics.

    :param options: choices fixed at trace time
    :param nets: networks as functions of their flat parameters
    :param settings: optimizer constants of each learner
    :param state: learners "actor", "critic", "vae", "log_alpha", flat target, flat vectors of both power iterations
    :param batch: tensors of shape (batch, ...); actions scaled to [-1, 1]
    :param noise: random numbers of this update; those of several actions have shape (n_actions, batch, ...)
    :param coef: 0-dimensional coefficients
    :param mmd_only: whether the actor follows the MMD alone
    :return: changed parts of the state, metrics
    """
    s, a, s2, d = batch.observations, batch.actions, batch.next_observations, batch.dones
    r = coef["reward_scale"] * batch.rewards + coef["reward_shift"]
    lr, clip = coef["learning_rate"], options.max_grad_norm
    new: dict[str, Any] = {}
    metrics: dict[str, th.Tensor] = {}

    # 1 autoencoder
    def vae_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor]]:
        reconstruction, mean, log_std = nets["vae"](params, s, a, noise["vae"])
        mse, kl = losses.bc_mse(reconstruction, a), losses.gaussian_kl(mean, log_std)
        return mse + KL_WEIGHT * kl, (mse, kl)

    new["vae"], loss, (mse, kl), norm = descend(vae_loss, state["vae"], lr, settings["vae"], clip)
    metrics.update(vae_loss=loss, vae_mse=mse, vae_kl=kl, grad_norm_vae=norm)

    # 2 target: value and variance each take the largest of the policy's actions
    target = state["critic_target"]
    new[TARGET_VECTORS] = nets["target_power_step"](target, state[TARGET_VECTORS])
    mean, log_std, _ = nets["actor"](state["actor"].params, s2)
    a2, _ = losses.squashed_gaussian(mean, log_std, noise["next_actor"])
    masks = _masks(options, noise, "target_dropout")
    q_next = nets["target_mc_values"](target, new[TARGET_VECTORS], s2, a2, masks, options.n_critics)
    next_values = losses.soft_clipped_values(q_next.mean(dim=-2)).amax(dim=0).unsqueeze(-1)
    variances = q_next.var(dim=-2).sum(dim=0).amax(dim=0).unsqueeze(-1)
    weights = losses.uncertainty_weight(variances, coef["uwac_beta"])
    y = losses.td_target(r, d, next_values, coef["gamma"])
    metrics.update(value_next=next_values.mean(), td_target=y.mean(), target_variance=variances.mean())
    metrics.update(weight=weights.mean(), weight_min=weights.min())

    # 3 critics
    vectors = nets["critic_power_step"](state["critic"].params, state[VECTORS])

    def q_loss(params: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        q_data = nets["critic_values"](params, vectors, s, a, _masks(options, noise, "dropout"))
        return losses.weighted_td_loss(q_data, y, weights, options.weight_squared), q_data

    new["critic"], loss, q_data, norm = descend(q_loss, state["critic"], lr, settings["critic"], clip)
    metrics.update(critic_loss=loss, grad_norm_q=norm, td_mse=(q_data - y).square().mean())
    metrics.update(q_data_metrics(q_data))
    metrics["twin_gap"] = (q_data.amax(dim=0) - q_data.amin(dim=0)).mean()

    # 4 actor; the first of its actions is valued
    critic_params = (state if options.actor_q_timing == "previous" else new)["critic"].params
    new[VECTORS] = nets["critic_power_step"](critic_params, vectors)
    like_data = nets["vae_sample"](new["vae"].params, s, noise["mmd_vae"])
    alpha = state[LOG_ALPHA].params.exp()

    def pi_loss(params: th.Tensor) -> tuple[th.Tensor, tuple[th.Tensor, ...]]:
        mean, log_std, _ = nets["actor"](params, s)
        before_tanh = mean + log_std.exp() * noise["mmd_actor"]
        a_pi, log_prob = losses.squashed_gaussian(mean, log_std, noise["mmd_actor"][0])
        mmd = losses.gaussian_mmd(before_tanh, like_data, coef["mmd_sigma"])
        loss = losses.mmd_penalty(mmd, alpha, coef["mmd_threshold"])
        if mmd_only:
            return loss, (mmd, a_pi, log_prob)
        masks = _masks(options, noise, "actor_dropout")
        q = nets["critic_mc_values"](critic_params, new[VECTORS], s, a_pi.unsqueeze(0), masks, options.n_critics, True)
        q_pi = q.mean(dim=-2).amin(dim=0).squeeze(0).unsqueeze(-1)
        variances = q.detach().var(dim=-2).sum(dim=0).squeeze(0).unsqueeze(-1)
        loss = loss - losses.batch_mean(q_pi * losses.uncertainty_weight(variances, coef["uwac_beta"]))
        return loss, (mmd, a_pi, log_prob, q.detach().mean(), variances)

    rate = coef["actor_learning_rate"]
    new["actor"], loss, (mmd, a_pi, log_prob, *q_kept), norm = descend(pi_loss, state["actor"], rate, settings["actor"], clip)
    metrics.update(actor_loss=loss, grad_norm_actor=norm, mmd=mmd.mean(), alpha=alpha.mean(), entropy=-log_prob.mean())
    metrics.update(action_metrics(a_pi, a))
    metrics["actor_learning_rate"] = rate
    if not mmd_only:
        q_pi, variances = q_kept
        metrics.update(q_policy=q_pi, q_gap=q_pi - q_data.mean(), policy_variance=variances.mean())
        metrics["policy_weight"] = losses.uncertainty_weight(variances, coef["uwac_beta"]).mean()

    # 5 multiplier: ascends on the actor loss, in which the actor saw it before its step
    def multiplier_loss(log_alpha: th.Tensor) -> tuple[th.Tensor, tuple[()]]:
        return -losses.mmd_penalty(mmd, log_alpha.exp(), coef["mmd_threshold"]), ()

    rate = coef["log_alpha_learning_rate"]
    learner, _, _, _ = descend(multiplier_loss, state[LOG_ALPHA], rate, settings[LOG_ALPHA])
    new[LOG_ALPHA] = learner._replace(params=learner.params.clamp(*LOG_ALPHA_LIMITS))

    # 6 targets
    new["critic_target"] = polyak(new["critic"].params, target, coef["tau"])
    return new, metrics


def _masks(options: UWACOptions, noise: dict[str, th.Tensor], use: str) -> list[th.Tensor]:
    return [noise[f"{use}_{layer}"] for layer in range(options.n_masks)]
