"""Policies of the offline agents: Stable-Baselines3's SAC policy with a state-value network beside the critics."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn

from sb3_dce.actors import DeterministicActor, GaussianActor
from sb3_dce.errors import ConfigError
from sb3_dce.networks import OfflineActor, OfflineCritic, ValueNet

Net = TypeVar("Net", bound=nn.Module)


class OfflineSACPolicy(SACPolicy):
    """
    Squashed-Gaussian actor, critics with targets and, if wished, a state-value network.

    :param observation_space: observation space
    :param action_space: action space
    :param lr_schedule: learning rate as a function of the remaining progress
    :param net_arch: widths of the hidden layers, default [256, 256]; ``dict(pi=[...], qf=[...])`` to tell them apart
    :param activation_fn: activation of the hidden layers
    :param features_extractor_class: network applied to the observations first; each network has its own copy
    :param features_extractor_kwargs: its keyword arguments
    :param normalize_images: kept for Stable-Baselines3's interface; observations are never divided by 255
    :param optimizer_class: ``torch.optim.Adam`` or ``torch.optim.AdamW``
    :param optimizer_kwargs: its keyword arguments, learning rate excluded
    :param n_critics: number of critics
    :param share_features_extractor: must be False
    :param use_v: build the state-value network
    :param use_target_v: build a moving-average copy of it
    :param critic_layer_norm: put a ``LayerNorm`` before each hidden activation of the critics
    :param critic_weight_decay: L2 coefficient of the critics' optimizer
    """

    value_net: ValueNet | None
    value_net_target: ValueNet | None

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        share_features_extractor: bool = False,
        use_v: bool = False,
        use_target_v: bool = False,
        critic_layer_norm: bool = False,
        critic_weight_decay: float = 0.0,
    ) -> None:
        if share_features_extractor:
            raise ConfigError(
                "share_features_extractor=True is not supported: actor, critics and V are trained by losses of their own",
                key="share_features_extractor",
                hint="Leave it out of policy_kwargs.",
            )
        self.use_v = use_v
        self.use_target_v = use_target_v
        self.critic_layer_norm = critic_layer_norm
        self.critic_weight_decay = critic_weight_decay
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=net_arch,
            activation_fn=activation_fn,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            n_critics=n_critics,
        )
        _refuse_batch_norm(self)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        if self.critic_weight_decay:
            self.set_critic_weight_decay()
        self.value_net = self.value_net_target = None
        if not self.use_v:
            return
        self.value_net = self.make_value_net()
        self.value_net.optimizer = self.make_optimizer(self.value_net, lr_schedule)
        if self.use_target_v:
            self.value_net_target = self.make_value_net()
            self.value_net_target.load_state_dict(self.value_net.state_dict())
            self.value_net_target.set_training_mode(False)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        return OfflineActor(**self._update_features_extractor(self.actor_kwargs, features_extractor)).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return OfflineCritic(**kwargs, layer_norm=self.critic_layer_norm).to(self.device)

    def set_critic_weight_decay(self) -> None:
        """Give the critics' optimizer its L2 coefficient, instead of one that a loaded state has brought along."""
        optimizer = self.critic.optimizer
        optimizer.param_groups[0]["weight_decay"] = self.critic_weight_decay or optimizer.defaults["weight_decay"]

    def make_optimizer(self, network: nn.Module, lr_schedule: Schedule) -> th.optim.Optimizer:
        """
        The optimizer that Stable-Baselines3 gives actor and critics, for a network that it does not build itself.

        :param network: whose parameters are trained
        :param lr_schedule: learning rate as a function of the remaining progress; the optimizer begins with that of the start
        :return: optimizer of the policy's class, with its arguments
        """
        return self.optimizer_class(network.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    @property
    def critic_arch(self) -> list[int]:
        """Widths of the critics' hidden layers: ``net_arch`` itself, or its ``qf`` entry if it is a dictionary."""
        return get_actor_critic_arch(self.net_arch)[1]

    def make_value_net(self) -> ValueNet:
        """A new state-value network with the critics' hidden layers; its target, if there is one, is made by a second call."""
        kwargs = self._update_features_extractor(self.net_args, None)
        kwargs["net_arch"] = self.critic_arch
        return ValueNet(**kwargs).to(self.device)

    def set_training_mode(self, mode: bool) -> None:
        """
        Switch actor, critics and V between training and evaluation; the targets always stay in evaluation mode.

        :param mode: True for training, False for evaluation
        """
        super().set_training_mode(mode)
        if self.value_net is not None:
            self.value_net.set_training_mode(mode)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        for name in ("use_sde", "log_std_init", "use_expln", "clip_mean"):  # gSDE is not offered
            del data[name]
        data.update(
            use_v=self.use_v,
            use_target_v=self.use_target_v,
            critic_layer_norm=self.critic_layer_norm,
            critic_weight_decay=self.critic_weight_decay,
        )
        return data


class ActorPolicy(OfflineSACPolicy):
    """
    The same policy with an actor only, for agents without critics; further parameters as :class:`OfflineSACPolicy`.

    :param stochastic: whether ``predict`` draws actions unless it is told not to; False where only the mean is trained
    """

    def __init__(self, *args: Any, stochastic: bool = True, **kwargs: Any) -> None:
        self.stochastic = stochastic
        super().__init__(*args, **kwargs)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.actor(observation, deterministic or not self.stochastic)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "stochastic": self.stochastic}

    def _build(self, lr_schedule: Schedule) -> None:
        self.actor = self.make_actor()
        self.actor.optimizer = self.make_optimizer(self.actor, lr_schedule)

    def set_training_mode(self, mode: bool) -> None:
        """
        Switch the actor, the only network there is; the base class would look for critics.

        :param mode: True for training, False for evaluation
        """
        self.actor.set_training_mode(mode)
        self.training = mode


class OfflineTD3Policy(OfflineSACPolicy):
    """The same policy with a deterministic actor that has a target; parameters as :class:`OfflineSACPolicy`."""

    actor: DeterministicActor  # type: ignore[assignment]
    actor_target: DeterministicActor

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.actor_target = self.make_actor()
        self.actor_target.load_state_dict(self.actor.state_dict())
        self.actor_target.set_training_mode(False)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> DeterministicActor:  # type: ignore[override]
        return DeterministicActor(**self._update_features_extractor(self.net_args, features_extractor)).to(self.device)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.actor(observation)


class OfflineIQLPolicy(OfflineSACPolicy):
    """
    The same policy with an actor that is a plain Gaussian, and with the orthogonal start (gain sqrt(2), no biases) of IQL's
    authors; parameters as :class:`OfflineSACPolicy`.
    """

    actor: GaussianActor  # type: ignore[assignment]
    value_net: ValueNet

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> GaussianActor:  # type: ignore[override]
        actor = GaussianActor(**self._update_features_extractor(self.net_args, features_extractor))
        return _orthogonal(actor).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        return _orthogonal(super().make_critic(features_extractor))

    def make_value_net(self) -> ValueNet:
        """The state-value network of the base class, with orthogonal weights (gain sqrt(2)) and biases of 0."""
        return _orthogonal(super().make_value_net())


def _orthogonal(net: Net) -> Net:
    return net.apply(partial(BasePolicy.init_weights, gain=math.sqrt(2.0)))


def _refuse_batch_norm(policy: nn.Module) -> None:
    for module in policy.modules():
        if isinstance(module, nn.modules.batchnorm._BatchNorm):
            raise ConfigError(
                f"{type(module).__name__} is not supported: its running statistics change inside a pure update",
                key="features_extractor_class",
                hint="Use LayerNorm, or normalize_obs=True for dataset statistics.",
            )
