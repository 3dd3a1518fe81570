"""Networks that Stable-Baselines3 does not have: a state-value net, a critic with dropout masks, observation statistics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim, get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import Actor
from torch import nn


class KeepDtype:
    """
    Feature extraction that follows the network's dtype.

    Stable-Baselines3 casts every Box observation to float32 in ``preprocess_obs``; then a float64 copy of the networks,
    which the equality tests need, could not be run. Mixed in before a ``BaseModel``.
    """

    def extract_features(self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor | None) -> th.Tensor:
        """
        Apply an extractor in the network's dtype; a Box skips Stable-Baselines3's preprocessing.

        :param obs: shape (batch, *obs_shape)
        :param features_extractor: network applied to the observations
        :return: features, shape (batch, features_dim)
        """
        if isinstance(self.observation_space, spaces.Box):  # type: ignore[attr-defined]
            assert isinstance(obs, th.Tensor) and features_extractor is not None
            return features_extractor(obs.to(self._dtype()))
        return super().extract_features(obs, features_extractor).to(self._dtype())  # type: ignore[misc]

    def _dtype(self) -> th.dtype:
        return next(self.parameters()).dtype  # type: ignore[attr-defined]


def masked_mlp(net: nn.Module, hidden: th.Tensor, masks: Sequence[th.Tensor]) -> th.Tensor:
    """
    Run a sequence of layers with dropout after each activation.

    :param net: linear layers, with an activation and perhaps a normalisation after each hidden one
    :param hidden: inputs, shape (batch, width)
    :param masks: per activation a factor of shape (batch, width): 0, or 1 / (1 - dropout)
    :return: outputs of the last layer
    """
    remaining = iter(masks)
    for layer in net.children():
        hidden = layer(hidden)
        if not isinstance(layer, nn.Linear | nn.LayerNorm):  # an activation may be made by a function, which is no class
            hidden = hidden * next(remaining)
    return hidden


class OfflineActor(KeepDtype, Actor):
    """Stable-Baselines3's SAC actor; its state dict is the same."""

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """
        A draw of the squashed Gaussian, or ``tanh`` of its mean.

        :param obs: shape (batch, *obs_shape)
        :param deterministic: without noise; then no distribution is made, which takes longer than the network
        :return: actions in [-1, 1], shape (batch, action_dim)
        """
        if not deterministic:
            return super().forward(obs)
        return th.tanh(self.mu(self.latent_pi(self.extract_features(obs, self.features_extractor))))


class OfflineCritic(KeepDtype, ContinuousCritic):
    """
    Stable-Baselines3's critic, with optional layer normalisation and dropout.

    Dropout masks are arguments of :meth:`forward` instead of random draws inside it, so that every way of running an
    update (eager, compiled, many models at once) drops the same units. Without masks nothing is dropped.

    Parameters not listed here are those of Stable-Baselines3's ``ContinuousCritic``.

    :param layer_norm: put a ``LayerNorm`` before each hidden activation
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        n_critics: int = 2,
        share_features_extractor: bool = False,
        layer_norm: bool = False,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            net_arch,
            features_extractor,
            features_dim,
            activation_fn,
            normalize_images,
            n_critics,
            share_features_extractor,
        )
        if layer_norm:
            self.q_networks = []
            for index in range(n_critics):
                layers = create_mlp(
                    features_dim + get_action_dim(action_space),
                    1,
                    net_arch,
                    activation_fn,
                    post_linear_modules=[nn.LayerNorm],
                )
                # Critics of Stable-Baselines3 take no such modules, so the networks are made again; the output stays bare.
                q_net = nn.Sequential(*layers)
                setattr(self, f"qf{index}", q_net)
                self.q_networks.append(q_net)

    def forward(
        self, obs: th.Tensor, actions: th.Tensor, masks: Sequence[Sequence[th.Tensor]] | None = None
    ) -> tuple[th.Tensor, ...]:
        """
        Q(s, a) of every critic from one extraction of the features, with dropout where masks are given.

        :param obs: shape (batch, *obs_shape)
        :param actions: scaled to [-1, 1], shape (batch, action_dim)
        :param masks: per critic and hidden layer a factor of shape (batch, width): 0, or 1 / (1 - dropout)
        :return: one tensor of shape (batch, 1) per critic
        """
        features = self.extract_features(obs, self.features_extractor)
        inputs = th.cat([features, actions], dim=-1)
        if masks is None:
            return tuple(q_net(inputs) for q_net in self.q_networks)
        return tuple(masked_mlp(q_net, inputs, net_masks) for q_net, net_masks in zip(self.q_networks, masks, strict=True))


class ValueNet(KeepDtype, BaseModel):
    """
    State-value network V(s).

    :param observation_space: observation space
    :param action_space: action space (unused, part of Stable-Baselines3's model interface)
    :param net_arch: widths of the hidden layers
    :param features_extractor: network applied to the observations first
    :param features_dim: its output width
    :param activation_fn: activation of the hidden layers
    :param normalize_images: kept for Stable-Baselines3's interface; observations are never divided by 255
    """

    optimizer: th.optim.Optimizer

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
    ) -> None:
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.value_net = nn.Sequential(*create_mlp(features_dim, 1, net_arch, activation_fn))

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """
        Estimate each state's value; what it estimates, such as an expectile of Q, is the update's choice.

        :param obs: shape (batch, *obs_shape)
        :return: V(s), shape (batch, 1), reward units
        """
        return self.value_net(self.extract_features(obs, self.features_extractor))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            net_arch=self.net_arch,
            features_extractor=self.features_extractor,
            features_dim=self.features_dim,
            activation_fn=self.activation_fn,
        )
        return data


class StandardizedExtractor(BaseFeaturesExtractor):
    """
    ``(s - mean) / (std + eps)`` with the dataset's statistics, kept as buffers of the network.

    The statistics are saved with the model, so that a loaded policy acts right on raw observations. The formula is that
    of TD3+BC (Fujimoto & Gu, 2021), which differs from Stable-Baselines3's ``VecNormalize``.

    :param observation_space: a Box
    :param eps: added to the standard deviation
    """

    mean: th.Tensor
    std: th.Tensor

    def __init__(self, observation_space: spaces.Box, eps: float = 1e-3) -> None:
        features_dim = get_flattened_obs_dim(observation_space)
        super().__init__(observation_space, features_dim)
        self.eps = eps
        self.register_buffer("mean", th.zeros(features_dim))
        self.register_buffer("std", th.ones(features_dim) - eps)

    def set_statistics(self, mean: th.Tensor, std: th.Tensor) -> None:
        """
        Copy the dataset's statistics into the buffers, in place; training does not change them.

        :param mean: shape (obs_dim,)
        :param std: population standard deviation, shape (obs_dim,)
        """
        self.mean.copy_(mean)
        self.std.copy_(std)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        Standardise observations, each flattened to a vector; before statistics are set they stay as they are.

        :param observations: shape (batch, *obs_shape)
        :return: shape (batch, obs_dim)
        """
        return (observations.flatten(1) - self.mean) / (self.std + self.eps)
