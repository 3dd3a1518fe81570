"""
The deterministic action of an MLP policy: the operations of ``predict`` on the same batch, without the work around them.

A module call, a distribution and the conversions of ``predict`` cost several times what the matrix products of ten
observations cost. Here they are ``addmm`` into buffers that are made once, which is what ``nn.Linear`` calls as well, so the
actions agree to the last bit: for as many observations at a time, on a CPU, with as many threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch.nn import functional as F

from sb3_dce.networks import StandardizedExtractor
from sb3_dce.policy_parts import actor_parts, plain_layers

IN_PLACE: dict[str, Callable[[th.Tensor], Any]] = {
    "relu": th.relu_,
    "tanh": th.tanh_,
    "elu": F.elu_,
    "leaky_relu": F.leaky_relu_,
    "silu": lambda x: F.silu(x, inplace=True),
}


@dataclass(frozen=True, eq=False)
class ActorSnapshot:
    """
    What a policy does without noise, as arrays: small (0.3 MB with 256-256 units), and all that another process needs.

    :param layers: weight of shape (out, in) and bias of shape (out,) of each layer, float32
    :param activation: key of :data:`IN_PLACE`, of all layers but the last
    :param squash: the last layer goes through tanh and is taken to the box; otherwise it is clipped to it
    :param low: smallest action, shape (act_dim,)
    :param high: largest action, shape (act_dim,)
    :param standardize: mean and divisor of the observations, shape (obs_dim,) each, float32; ``None`` for raw ones
    """

    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    activation: str
    squash: bool
    low: np.ndarray
    high: np.ndarray
    standardize: tuple[np.ndarray, np.ndarray] | None


def actor_snapshot(policy: Any) -> ActorSnapshot | None:
    """
    Copy what a policy's deterministic action depends on, if it is a policy that :class:`MLPActor` can repeat.

    :param policy: policy of Stable-Baselines3 or of this package
    :return: its weights as they are now; ``None`` if it is no plain float32 MLP on vectors of known kind
    """
    parts = actor_parts(policy)
    if parts is None:
        return None
    modules, _, extractor, squash = parts
    plain = plain_layers(modules)
    if plain is None or (squash != "none") != policy.squash_output:
        return None
    linears, activation = plain
    tensors = [tensor for linear in linears for tensor in (linear.weight, linear.bias)]
    if any(tensor is None or tensor.dtype != th.float32 for tensor in tensors):
        return None
    standardize = None
    if type(extractor) is StandardizedExtractor:
        standardize = (_copy(extractor.mean), _copy(extractor.std + extractor.eps))
    elif type(extractor) is not FlattenExtractor:
        return None
    layers = tuple((_copy(linear.weight), _copy(linear.bias)) for linear in linears)
    space = policy.action_space
    return ActorSnapshot(layers, activation, squash != "none", space.low, space.high, standardize)


def _copy(tensor: th.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()


class MLPActor:
    """
    Acts as a snapshot's policy did.

    :param snapshot: from :func:`actor_snapshot`
    """

    def __init__(self, snapshot: ActorSnapshot) -> None:
        # copied into PyTorch's own memory: the bits of a matrix product may depend on how its operands are aligned
        layers = [[th.tensor(array, device="cpu") for array in layer] for layer in snapshot.layers]
        self._layers = [(weight.t(), bias) for weight, bias in layers]
        self._activate = IN_PLACE[snapshot.activation]
        scales = snapshot.standardize
        self._standardize = None if scales is None else [th.tensor(array, device="cpu") for array in scales]
        self._squash, self._low, self._high = snapshot.squash, snapshot.low, snapshot.high
        self._range = snapshot.high - snapshot.low
        self._buffers: list[th.Tensor] = []

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """
        Deterministic actions of a batch; a batch of another size than the last one gets new buffers.

        :param obs: shape (n, obs_dim)
        :return: actions in the units of the environment, shape (n, act_dim); a new array
        """
        if not self._buffers or len(self._buffers[0]) != len(obs):
            widths = [len(self._layers[0][0]), *(len(bias) for _, bias in self._layers)]
            self._buffers = [th.empty(len(obs), width, device="cpu") for width in widths]
        x = self._buffers[0].copy_(th.from_numpy(obs))
        if self._standardize is not None:
            x.sub_(self._standardize[0]).div_(self._standardize[1])
        last = len(self._layers) - 1
        for index, (weight, bias) in enumerate(self._layers):
            x = th.addmm(bias, x, weight, out=self._buffers[index + 1])
            if index < last:
                self._activate(x)
        if not self._squash:
            return np.clip(x.numpy(), self._low, self._high)
        # the operations of BasePolicy.unscale_action
        return self._low + (0.5 * (x.tanh_().numpy() + 1.0) * self._range)
