"""Actors that are no squashed Gaussians: the deterministic one of TD3+BC and the plain Gaussian of IQL."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.td3.policies import Actor as TD3Actor
from torch import nn

from sb3_dce.networks import KeepDtype, masked_mlp

# Bounds of the log standard deviation in the authors' code of IQL.
LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0


class DeterministicActor(KeepDtype, TD3Actor):
    """Stable-Baselines3's TD3 actor, ``tanh(mu(s))``; its state dict is the same."""


class GaussianActor(KeepDtype, BasePolicy):
    """
    Gaussian policy of IQL: mean ``tanh(mu(s))``, one standard deviation per action entry for all states, not squashed.

    Dropout masks are arguments, as in :class:`~sb3_dce.networks.OfflineCritic`. Without masks nothing is dropped.

    :param observation_space: observation space
    :param action_space: action space
    :param net_arch: widths of the hidden layers
    :param features_extractor: network applied to the observations first
    :param features_dim: its output width
    :param activation_fn: activation of the hidden layers
    :param normalize_images: kept for Stable-Baselines3's interface; observations are never divided by 255
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
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            # its actions are scaled to [-1, 1] all the same: `forward` clips the draws
            squash_output=True,
        )
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        action_dim = get_action_dim(action_space)
        self.latent_pi = nn.Sequential(*create_mlp(features_dim, -1, net_arch, activation_fn))
        self.mu = nn.Linear(net_arch[-1] if net_arch else features_dim, action_dim)
        self.log_std = nn.Parameter(th.zeros(action_dim))

    def get_action_dist_params(self, obs: th.Tensor, masks: Sequence[th.Tensor] | None = None) -> tuple[th.Tensor, th.Tensor]:
        """
        Mean ``tanh(mu(s))`` of the Gaussian and its log standard deviation, clamped to [-5, 2] as in the authors' code.

        :param obs: shape (batch, *obs_shape)
        :param masks: per hidden layer a factor of shape (batch, width): 0, or 1 / (1 - dropout)
        :return: mean in (-1, 1), shape (batch, action_dim), and log standard deviation, shape (action_dim,)
        """
        features = self.extract_features(obs, self.features_extractor)
        latent = self.latent_pi(features) if masks is None else masked_mlp(self.latent_pi, features, masks)
        return th.tanh(self.mu(latent)), self.log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)

    def forward(self, obs: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """
        Actions of the policy without dropout: one draw per observation from PyTorch's global generator, or the mean.

        :param obs: shape (batch, *obs_shape)
        :param deterministic: the mean instead of a draw
        :return: actions clipped to [-1, 1], shape (batch, action_dim)
        """
        mean, log_std = self.get_action_dist_params(obs)
        return mean if deterministic else (mean + log_std.exp() * th.randn_like(mean)).clamp(-1.0, 1.0)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        return self(observation, deterministic)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            net_arch=self.net_arch,
            features_extractor=self.features_extractor,
            features_dim=self.features_dim,
            activation_fn=self.activation_fn,
        )
        return data
