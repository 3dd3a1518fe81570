"""
An actor of Stable-Baselines3 or of this package, taken apart: its MLP, its spread, its normalisation, its squashing.

From the parts come policies that act without the work around a module call: :func:`numpy_policy` here, the
:class:`~sb3_dce.mlp_actor.ActorSnapshot` of an evaluation. PyTorch is imported by the functions that need it only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_dce.numpy_policy import Layer, MLPPolicy, ObsNormalizer, Squash


def numpy_policy(policy: Any, normalizer: ObsNormalizer | None = None) -> MLPPolicy | None:
    """
    The NumPy twin of a policy of Stable-Baselines3 or of this package.

    Known are the MLP policies of SAC, TQC, TD3, DDPG, PPO, A2C and TRPO, and those of the offline agents, with or without
    standardised observations. Classes are compared exactly: a subclass may act in another way.

    :param policy: ``model.policy``
    :param normalizer: applied to the observation first, as ``VecNormalize`` does
    :return: the twin; ``None`` if the policy cannot be expressed
    """
    parts = actor_parts(policy)
    if parts is None:
        return None
    modules, log_std, extractor, squash = parts
    extracted = _extractor_normalizer(extractor)
    plain = plain_layers(modules)
    if extracted is _UNKNOWN or plain is None or (extracted is not None and normalizer is not None):
        return None
    linears, activation = plain
    layers = [_layer(linear) for linear in linears]
    low, high = policy.action_space.low, policy.action_space.high
    return MLPPolicy(layers, activation, low, high, squash, log_std, extracted or normalizer)


_UNKNOWN: Any = object()


def actor_parts(policy: Any) -> tuple[list[Any], Layer | np.ndarray | None, Any, Squash] | None:
    """
    Take the actor of a known policy apart into what its NumPy twin or a snapshot needs to act.

    :param policy: policy of Stable-Baselines3 or of this package
    :return: modules of the mean, log std, features extractor, and the way of squashing; ``None`` for an unknown policy, or
        one whose observations or actions are no vectors
    """
    from stable_baselines3.common.distributions import DiagGaussianDistribution
    from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
    from stable_baselines3.common.torch_layers import MlpExtractor
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import Actor as TD3Actor
    from stable_baselines3.td3.policies import TD3Policy

    from sb3_dce.actors import LOG_STD_MAX as IQL_LOG_STD_MAX
    from sb3_dce.actors import LOG_STD_MIN as IQL_LOG_STD_MIN
    from sb3_dce.actors import DeterministicActor, GaussianActor
    from sb3_dce.policies import ActorPolicy, OfflineTD3Policy

    for space in (policy.observation_space, policy.action_space):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            return None
    own = (ActorPolicy._predict, OfflineTD3Policy._predict)
    known = (SACPolicy._predict, TD3Policy._predict, ActorCriticPolicy._predict, *own, *_contrib())
    if type(policy).predict is not BasePolicy.predict or type(policy)._predict not in known:
        return None
    actor: Any = getattr(policy, "actor", None)
    if type(actor) in _squashed_gaussian_actors() and not actor.use_sde:
        spread = _layer(actor.log_std) if getattr(policy, "stochastic", True) else None
        return [*actor.latent_pi, actor.mu], spread, actor.features_extractor, "draw"
    if type(actor) in (TD3Actor, DeterministicActor) and _is_tanh(actor.mu[-1]):
        return list(actor.mu)[:-1], None, actor.features_extractor, "draw"
    if type(actor) is GaussianActor:
        log_std = np.clip(actor.log_std.detach().cpu().numpy(), IQL_LOG_STD_MIN, IQL_LOG_STD_MAX)
        return [*actor.latent_pi, actor.mu], log_std, actor.features_extractor, "mean"
    if (
        type(policy) is ActorCriticPolicy
        and type(policy.mlp_extractor) is MlpExtractor
        and type(policy.action_dist) is DiagGaussianDistribution
    ):
        modules = [*policy.mlp_extractor.policy_net, policy.action_net]
        return modules, policy.log_std.detach().cpu().numpy(), policy.pi_features_extractor, "none"
    return None


def _squashed_gaussian_actors() -> tuple[type, ...]:
    from stable_baselines3.sac.policies import Actor

    from sb3_dce.networks import OfflineActor

    actors: tuple[type, ...] = (Actor, OfflineActor)
    try:
        from sb3_contrib.tqc.policies import Actor as TQCActor
    except ImportError:
        return actors
    return (*actors, TQCActor)


def _contrib() -> tuple[Callable[..., Any], ...]:
    try:
        from sb3_contrib.tqc.policies import TQCPolicy
    except ImportError:
        return ()
    return (TQCPolicy._predict,)


def _extractor_normalizer(extractor: Any) -> Any:
    from stable_baselines3.common.torch_layers import FlattenExtractor

    from sb3_dce.networks import StandardizedExtractor

    if type(extractor) is FlattenExtractor:
        return None
    if type(extractor) is StandardizedExtractor:
        mean, std = (tensor.cpu().numpy().astype(np.float64) for tensor in (extractor.mean, extractor.std))
        return ObsNormalizer(mean, std + extractor.eps)
    return _UNKNOWN


def plain_layers(modules: list[Any]) -> tuple[list[Any], str] | None:
    """
    Tell whether modules alternate between linear layers and one activation with its default settings.

    :param modules: of an MLP, in order
    :return: its linear layers and the activation between all of them, a key of :data:`~sb3_dce.numpy_policy.ACTIVATIONS`;
        ``None`` for any other order or kind of modules
    """
    from torch import nn

    names: dict[type, str] = {nn.ReLU: "relu", nn.Tanh: "tanh", nn.ELU: "elu", nn.LeakyReLU: "leaky_relu", nn.SiLU: "silu"}
    linear, between = modules[::2], modules[1::2]
    kinds = {type(module) for module in between}
    plain = all(getattr(m, "alpha", 1.0) == 1.0 and getattr(m, "negative_slope", 0.01) == 0.01 for m in between)
    if len(linear) != len(between) + 1 or any(type(module) is not nn.Linear for module in linear):
        return None
    if len(kinds) > 1 or not kinds <= set(names) or not plain:
        return None
    return linear, names[kinds.pop()] if kinds else "relu"


def _layer(linear: Any) -> Layer:
    weight = linear.weight.detach().cpu().numpy()
    bias = np.zeros(len(weight)) if linear.bias is None else linear.bias.detach().cpu().numpy()
    return weight.T, bias


def _is_tanh(module: Any) -> bool:
    from torch import nn

    return type(module) is nn.Tanh
