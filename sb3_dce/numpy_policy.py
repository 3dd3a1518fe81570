"""
Policies as plain NumPy in float64: fast for one observation at a time, and the same bits on every BLAS once rounded.

Stable-Baselines3's ``predict`` costs several simulator steps per call. What can be expressed as an MLP is taken out of the
PyTorch policy by :func:`~sb3_dce.policy_parts.numpy_policy`; the rest is wrapped by :class:`PredictPolicy`, which is slower
and the only one here that needs PyTorch.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sb3_dce.errors import ConfigError

Layer = tuple[np.ndarray, np.ndarray]
Squash = Literal["draw", "mean", "none"]

# Bounds of the log standard deviation of Stable-Baselines3's SAC actor.
LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


def _relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0.0, out=x)


def _leaky_relu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0.0, x, 0.01 * x)


def _elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))


def _silu(x: np.ndarray) -> np.ndarray:
    return x / (1.0 + np.exp(-x))


# they may overwrite their argument
ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "relu": _relu,
    "tanh": np.tanh,
    "elu": _elu,
    "leaky_relu": _leaky_relu,
    "silu": _silu,
}


class NumpyPolicy(ABC):
    """
    A policy for observations that are vectors and actions that are vectors in a box.

    :param obs_dim: number of entries of an observation
    :param low: smallest action, shape (act_dim,)
    :param high: largest action, shape (act_dim,)
    """

    # whether the two ways of acting differ, and whether the policy can act without noise
    is_stochastic = True
    is_deterministic = True

    def __init__(self, obs_dim: int, low: np.ndarray, high: np.ndarray) -> None:
        self.obs_dim = obs_dim
        self.low, self.high = (np.asarray(bound, dtype=np.float64).reshape(-1) for bound in (low, high))

    @property
    def act_dim(self) -> int:
        """Number of entries of an action, which is that of the bounds."""
        return len(self.low)

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """
        The noise of ``n`` actions. Drawing it at once or in parts gives the same numbers.

        :param rng: generator
        :param n: actions
        :return: what :meth:`act` wants as ``noise``, shape (n, act_dim)
        """
        return rng.standard_normal((n, self.act_dim))

    @property
    def weight_bytes(self) -> int:
        """Bytes of weights that every action reads; if they are many, a recording plays episodes side by side. 0: unknown."""
        return 0

    @abstractmethod
    def act(self, obs: np.ndarray, noise: np.ndarray | None = None, step: int = 0) -> np.ndarray:
        """
        Actions of a batch of observations, all at the same step of their episodes.

        :param obs: shape (n, obs_dim)
        :param noise: from :meth:`draw`, shape (n, act_dim); ``None`` for the deterministic action
        :param step: steps since the start of the episode, for policies that see the time
        :return: actions in the units of the environment, float64, shape (n, act_dim)
        """


@dataclass(frozen=True, eq=False)
class ObsNormalizer:
    """
    ``clip((s - mean) / scale, -clip, clip)``.

    :param mean: shape (obs_dim,)
    :param scale: shape (obs_dim,)
    :param clip: largest absolute value, may be infinite
    """

    mean: np.ndarray
    scale: np.ndarray
    clip: float = np.inf

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """
        Standardise each entry of a batch, then clip it; nothing is learned from the observations.

        :param obs: shape (n, obs_dim)
        :return: shape (n, obs_dim)
        """
        normalized = (obs - self.mean) / self.scale
        return np.minimum(np.maximum(normalized, -self.clip), self.clip)


class MLPPolicy(NumpyPolicy):
    """
    A Gaussian policy with a multi-layer perceptron, squashed by tanh or clipped, or its mean alone.

    :param layers: weight of shape (in, out) and bias of shape (out,) of each layer; the last one gives the mean
    :param activation: key of :data:`ACTIVATIONS`, of all layers but the last
    :param low: smallest action, shape (act_dim,)
    :param high: largest action, shape (act_dim,)
    :param squash: ``"draw"``: tanh of mean plus noise, from [-1, 1] to the box (SAC, TD3); ``"mean"``: tanh of the mean, to
        which noise is added, clipped to [-1, 1] and taken to the box (IQL); ``"none"``: clipped to the box (PPO)
    :param log_std: of the Gaussian before squashing: a layer on the last hidden units, clipped to [-20, 2] as in SAC; or a
        vector, as in PPO; ``None`` for a policy without noise of its own (TD3)
    :param normalizer: applied to the observation, the time included
    :param time_limit: steps after which the time feature ``1 - step / time_limit``, appended to the observation, is 0;
        ``None`` for a policy that does not see the time
    """

    def __init__(
        self,
        layers: Sequence[Layer],
        activation: str,
        low: np.ndarray,
        high: np.ndarray,
        squash: Squash,
        log_std: Layer | np.ndarray | None = None,
        normalizer: ObsNormalizer | None = None,
        time_limit: int | None = None,
    ) -> None:
        super().__init__(len(layers[0][0]) - (time_limit is not None), low, high)
        self.activation = activation
        self.squash = squash
        self.normalizer = normalizer
        self.time_limit = time_limit
        self.is_stochastic = log_std is not None
        self.layers = [_float64(layer) for layer in layers]
        self.log_std = log_std
        self._hidden, self._mean = self.layers[:-1], self.layers[-1]
        self._has_std_layer = isinstance(log_std, tuple)
        self._std: np.ndarray | None = None
        if isinstance(log_std, tuple):
            self.log_std = weight, bias = _float64(log_std)
            # one product for mean and log std is faster than two
            self._both = (np.ascontiguousarray(np.hstack([self._mean[0], weight])), np.concatenate([self._mean[1], bias]))
        elif log_std is not None:
            self._std = np.exp(np.asarray(log_std, dtype=np.float64))
        if squash != "none":
            self._middle, self._half_range = (self.high + self.low) / 2, (self.high - self.low) / 2

    @property
    def weight_bytes(self) -> int:
        """Bytes of the weight matrices from the observation to the mean, without biases and the layer of log std."""
        return sum(weight.nbytes for weight, _ in self.layers)

    def act(self, obs: np.ndarray, noise: np.ndarray | None = None, step: int = 0) -> np.ndarray:
        drawn, std = self.distribution(obs, step, with_std=noise is not None)
        if noise is not None and std is not None:
            drawn = drawn + std * noise
        if self.squash == "none":
            return np.minimum(np.maximum(drawn, self.low), self.high)
        scaled = np.tanh(drawn) if self.squash == "draw" else np.minimum(np.maximum(drawn, -1.0), 1.0)
        return self._middle + self._half_range * scaled

    def distribution(self, obs: np.ndarray, step: int = 0, with_std: bool = True) -> tuple[np.ndarray, np.ndarray | None]:
        """
        The Gaussian that noise is drawn from, before a draw is squashed or clipped.

        :param obs: shape (n, obs_dim)
        :param step: steps since the start of the episode
        :param with_std: compute the standard deviation
        :return: mean, shape (n, act_dim), and standard deviation, shape (n, act_dim) or (act_dim,); ``None`` without
        """
        x = np.asarray(obs, dtype=np.float64)
        if self.time_limit is not None:
            x = np.concatenate([x, np.full((len(x), 1), 1.0 - step / self.time_limit)], axis=1)
        if self.normalizer is not None:
            x = self.normalizer(x)
        activation = ACTIVATIONS[self.activation]
        for weight, bias in self._hidden:
            x = x @ weight
            x += bias
            x = activation(x)
        if with_std and self._has_std_layer:
            both = x @ self._both[0] + self._both[1]
            log_std = np.minimum(np.maximum(both[:, self.act_dim :], LOG_STD_MIN), LOG_STD_MAX)
            mean, std = both[:, : self.act_dim], np.exp(log_std)
        else:
            mean, std = x @ self._mean[0] + self._mean[1], self._std if with_std else None
        return np.tanh(mean) if self.squash == "mean" else mean, std


class RandomPolicy(NumpyPolicy):
    """
    Uniform on the box of the actions.

    :param obs_dim: number of entries of an observation
    :param low: smallest action, shape (act_dim,)
    :param high: largest action, shape (act_dim,)
    :raises ConfigError: if the box is unbounded
    """

    is_deterministic = False

    def __init__(self, obs_dim: int, low: np.ndarray, high: np.ndarray) -> None:
        super().__init__(obs_dim, low, high)
        if not np.isfinite([self.low, self.high]).all():
            raise ConfigError(
                "the random policy is uniform on the action space, and this one has no bounds",
                key="policy",
                hint="Wrap the environment with gymnasium.wrappers.RescaleAction, or record another policy.",
            )

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return rng.uniform(self.low, self.high, (n, self.act_dim))

    def act(self, obs: np.ndarray, noise: np.ndarray | None = None, step: int = 0) -> np.ndarray:
        if noise is None:
            raise ConfigError(
                "the random policy has no deterministic action", key="deterministic", hint="Leave deterministic out."
            )
        return noise


class PredictPolicy(NumpyPolicy):
    """
    Any policy of Stable-Baselines3, through its own ``predict``: for networks that are no plain MLP. Slower.

    Its noise is PyTorch's, seeded anew for each action, so that it depends on nothing else.

    :param load: returns the policy; called once per process, so that the object can be sent to others
    :param obs_dim: number of entries of an observation
    :param low: smallest action, shape (act_dim,)
    :param high: largest action, shape (act_dim,)
    :param normalizer: applied to the observation
    """

    def __init__(
        self,
        load: Callable[[], Any],
        obs_dim: int,
        low: np.ndarray,
        high: np.ndarray,
        normalizer: ObsNormalizer | None = None,
    ) -> None:
        super().__init__(obs_dim, low, high)
        self._load, self.normalizer = load, normalizer
        self._policy: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_policy": None}

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return rng.integers(2**31, size=(n, 1))

    def act(self, obs: np.ndarray, noise: np.ndarray | None = None, step: int = 0) -> np.ndarray:
        if self._policy is None:
            self._policy = self._load()
        x = np.asarray(obs, dtype=np.float64)
        if self.normalizer is not None:
            x = self.normalizer(x)
        x = x.astype(np.float32)
        if noise is None:
            return np.asarray(self._policy.predict(x, deterministic=True)[0], dtype=np.float64)
        import torch as th

        actions = []
        for row, seed in zip(x, noise[:, 0], strict=True):
            th.manual_seed(int(seed))
            actions.append(self._policy.predict(row[np.newaxis], deterministic=False)[0])
        return np.concatenate(actions).astype(np.float64)


def _float64(layer: Layer) -> Layer:
    weight, bias = (np.ascontiguousarray(array, dtype=np.float64) for array in layer)
    return weight, bias
