"""Networks of UWAC: spectrally normalised critics with Monte-Carlo dropout, and a model of the data's actions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from torch import nn
from torch.nn import functional as F

from sb3_dce.networks import KeepDtype
from sb3_dce.noise import NoiseSpec

# Rows (states times passes) valued at once: 256 states with 100 passes of 256 units are 26 MB of activations.
BLOCK_ROWS = 25_600
# A mask that drops more units than all but this share of masks keeps the surplus; see `DropoutCritic.mc_values`.
RARE = 1e-9
# The authors' code keeps the action model's latent variables and deviations in these ranges (from BCQ and BEAR).
LATENT_LIMIT = 0.5
VAE_LOG_STD_LIMITS = (-4.0, 15.0)


class SpectralLinear(nn.Module):
    """
    A linear layer of several critics, each weight divided by its largest singular value (Miyato et al., 2018).

    As in ``torch.nn.utils.spectral_norm`` the singular value is followed by one step of power iteration per pass in
    training. The vectors it keeps are buffers and not changed in place: :meth:`power_step` returns the new ones, which the
    update carries through its state like a target network.

    :param n_critics: number of critics
    :param n_in: inputs of each
    :param n_out: outputs of each
    """

    left: th.Tensor
    right: th.Tensor

    def __init__(self, n_critics: int, n_in: int, n_out: int) -> None:
        super().__init__()
        layers = [nn.Linear(n_in, n_out) for _ in range(n_critics)]  # for PyTorch's way of drawing the first weights
        self.weight = nn.Parameter(th.stack([layer.weight.detach() for layer in layers]))
        self.bias = nn.Parameter(th.stack([layer.bias.detach() for layer in layers]))
        self.register_buffer("left", F.normalize(th.randn(n_critics, n_out), dim=-1))
        self.register_buffer("right", F.normalize(th.randn(n_critics, n_in), dim=-1))
        for _ in range(15):  # a model that has not been trained predicts, too
            left, right = self.power_step(self.left)
            self.left.copy_(left.detach())
            self.right.copy_(right.detach())

    def power_step(self, left: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        One step of power iteration.

        :param left: shape (n_critics, n_out)
        :return: new left and right vectors, shapes (n_critics, n_out) and (n_critics, n_in)
        """
        right = F.normalize(th.matmul(left.unsqueeze(-2), self.weight).squeeze(-2), dim=-1)
        return F.normalize(th.matmul(self.weight, right.unsqueeze(-1)).squeeze(-1), dim=-1), right

    def normalized(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        """
        Weights divided by their largest singular value, for which ``left^T W right`` stands; gradients flow through it.

        :param left: shape (n_critics, n_out)
        :param right: shape (n_critics, n_in)
        :return: shape (n_critics, n_out, n_in)
        """
        sigma = (left * th.matmul(self.weight, right.unsqueeze(-1)).squeeze(-1)).sum(dim=-1)
        return self.weight / sigma[..., None, None]


class DropoutCritic(KeepDtype, BaseModel):
    """
    Several critics of one shape with spectral normalisation on every layer and dropout after every hidden layer.

    Their parameters are stacked along a first dimension. Vectors of the power iteration and dropout masks are arguments, so
    that an update stays a pure function; only :meth:`forward` takes the vectors as they are.

    :param observation_space: observation space
    :param action_space: action space
    :param net_arch: widths of the hidden layers
    :param features_extractor: network applied to the observations first
    :param features_dim: its output width
    :param activation_fn: activation of the hidden layers
    :param normalize_images: kept for Stable-Baselines3's interface; observations are never divided by 255
    :param n_critics: number of critics
    :param share_features_extractor: unused, always False
    :param dropout: probability that a hidden unit is dropped
    :param n_passes: Monte-Carlo passes
    """

    optimizer: th.optim.Optimizer
    layers: Sequence[SpectralLinear]  # a ModuleList

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
        dropout: float = 0.1,
        n_passes: int = 100,
    ) -> None:
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.net_arch = net_arch
        self.n_critics = n_critics
        self.dropout = dropout
        self.n_passes = n_passes
        self.activation = activation_fn()
        widths = [features_dim + get_action_dim(action_space), *net_arch, 1]
        layers = [SpectralLinear(n_critics, n_in, n_out) for n_in, n_out in itertools.pairwise(widths)]
        self.layers = nn.ModuleList(layers)  # type: ignore[assignment]

    # -- vectors of the power iteration and masks ------------------------------------------------------------------

    def power_vectors(self) -> list[th.Tensor]:
        """Left and right vectors of each layer in turn, the buffers themselves, for the storage that updates them."""
        return [vector for layer in self.layers for vector in (layer.left, layer.right)]

    def power_step(self, vectors: th.Tensor) -> th.Tensor:
        """
        One step of power iteration in every layer.

        :param vectors: those of :meth:`power_vectors`, flat and one after the other
        :return: the new ones, flat
        """
        pairs = self._pairs(vectors)
        steps = [layer.power_step(left) for layer, (left, _) in zip(self.layers, pairs, strict=True)]
        return th.cat([vector.reshape(-1) for pair in steps for vector in pair])

    def _pairs(self, vectors: th.Tensor) -> list[tuple[th.Tensor, th.Tensor]]:
        buffers = self.power_vectors()
        pieces = vectors.split([buffer.numel() for buffer in buffers])
        shaped = [piece.view(buffer.shape) for piece, buffer in zip(pieces, buffers, strict=True)]
        return list(zip(shaped[::2], shaped[1::2], strict=True))

    def mask_specs(self, *leading: int) -> list[NoiseSpec]:
        """
        Dropout masks to be drawn before an update, one per hidden layer.

        :param leading: dimensions before the unit's
        :return: specifications of the shapes (*leading, width)
        """
        return [NoiseSpec("dropout", (*leading, width), self.dropout) for width in self.net_arch]

    # -- values ----------------------------------------------------------------------------------------------------

    def forward(self, obs: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        Values with every unit in its place, as a look at the critics; training and prediction always use dropout.

        :param obs: shape (batch, *obs_shape)
        :param actions: scaled to [-1, 1], shape (batch, action_dim)
        :return: one tensor of shape (batch, 1) per critic
        """
        vectors = th.cat([vector.reshape(-1) for vector in self.power_vectors()])
        return tuple(self.values(vectors, obs, actions, None))

    def values(self, vectors: th.Tensor, obs: th.Tensor, actions: th.Tensor, masks: Sequence[th.Tensor] | None) -> th.Tensor:
        """
        One pass, each row with masks of its own.

        :param vectors: of the power iteration, flat
        :param obs: shape (batch, *obs_shape)
        :param actions: scaled to [-1, 1], shape (batch, action_dim)
        :param masks: per hidden layer a factor of shape (n_critics, batch, width): 0, or 1 / (1 - dropout)
        :return: shape (n_critics, batch, 1)
        """
        weights, biases = self._weights(vectors)
        hidden = th.cat([self.extract_features(obs, self.features_extractor), actions], dim=-1)
        for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            if index > 0:
                hidden = self.activation(hidden)
                hidden = hidden if masks is None else hidden * masks[index - 1]
            hidden = th.matmul(hidden, weight.transpose(-1, -2)) + bias.unsqueeze(-2)
        return hidden

    def mc_values(
        self,
        vectors: th.Tensor,
        obs: th.Tensor,
        actions: th.Tensor,
        masks: Sequence[th.Tensor],
        n_critics: int,
        with_gradient: bool = False,
    ) -> th.Tensor:
        """
        Values of ``n_passes`` thinned networks.

        A mask belongs to a critic, a group of rows and a pass; the rows of a group share it. So a row's own passes are
        independent draws, as are those of its actions in different groups, and the mean and variance of a row have the
        distribution they have in the authors' code, which draws a mask per row and pass; only the errors of different
        states of a batch become dependent. This makes a pass one network instead of many: of its product after the first
        hidden layer nearly all is the product without dropout, computed once, and only the columns of dropped units are
        taken off. With 256 units and dropout 0.1 that is a quarter of the work. The columns are counted out for all but a
        share of 1e-9 of the masks; a mask beyond keeps the units in excess.

        Rows are valued in blocks of about :data:`BLOCK_ROWS`, which bounds the memory.

        :param vectors: of the power iteration, flat
        :param obs: shape (batch, *obs_shape)
        :param actions: scaled to [-1, 1], shape (groups, batch, action_dim)
        :param masks: per hidden layer a factor of shape (n_critics, groups, n_passes, width)
        :param n_critics: critics wanted, counted from the first
        :param with_gradient: whether the result will be differentiated
        :return: shape (n_critics, groups, n_passes, batch)
        """
        weights, biases = ([tensor[:n_critics] for tensor in tensors] for tensors in self._weights(vectors))
        n_groups, rows = actions.shape[:2]
        features = self.extract_features(obs, self.features_extractor)
        inputs = th.cat([features.expand(n_groups, -1, -1), actions], dim=-1)
        first = th.matmul(inputs, weights[0].transpose(-1, -2).unsqueeze(1)) + biases[0][:, None, None]
        if not masks:  # no hidden layer, nothing to drop: all passes are equal
            return first.transpose(-1, -2).expand(-1, -1, self.n_passes, -1)
        first = self.activation(first)
        groups_at_once = max(1, BLOCK_ROWS // (self.n_passes * rows))
        passes_at_once = max(1, min(self.n_passes, BLOCK_ROWS // rows))
        starts, critics = range(0, self.n_passes, passes_at_once), []
        for critic in range(n_critics):
            own_weights, own_biases = [w[critic] for w in weights], [b[critic] for b in biases]
            groups = []
            for group in range(0, n_groups, groups_at_once):
                some = slice(group, group + groups_at_once)
                blocks = [[mask[critic, some, p : p + passes_at_once] for mask in masks] for p in starts]
                passes = [self._passes(first[critic, some], own_weights, own_biases, b, with_gradient) for b in blocks]
                groups.append(th.cat(passes, dim=1))
            critics.append(th.cat(groups))
        return th.stack(critics)

    def _passes(
        self,
        hidden: th.Tensor,
        weights: list[th.Tensor],
        biases: list[th.Tensor],
        masks: list[th.Tensor],
        with_gradient: bool,
    ) -> th.Tensor:
        """
        What follows the first hidden layer, for some groups and passes of one critic.

        :param hidden: first hidden layer, shape (groups, rows, width)
        :param weights: of each layer, shape (n_out, n_in)
        :param biases: of each layer, shape (n_out,)
        :param masks: per hidden layer, shape (groups, passes, width)
        :param with_gradient: whether the result will be differentiated
        :return: shape (groups, passes, rows)
        """
        for index in range(1, len(weights) - 1):
            if index == 1:
                product = self._thinned_product(hidden, masks[0], weights[1], with_gradient)
            else:
                product = th.matmul(hidden * masks[index - 1].unsqueeze(-2), weights[index].t())
            hidden = self.activation(product + biases[index])
        last = masks[-1] * weights[-1]  # (groups, passes, width)
        if len(masks) == 1:
            return th.matmul(last, hidden.transpose(-1, -2)) + biases[-1]
        return th.matmul(hidden, last.unsqueeze(-1)).squeeze(-1) + biases[-1]

    def _thinned_product(self, hidden: th.Tensor, mask: th.Tensor, weight: th.Tensor, with_gradient: bool) -> th.Tensor:
        """
        ``W (mask * h)`` as the product without dropout less the columns of dropped units.

        :param hidden: shape (groups, rows, n_in)
        :param mask: 0 or 1 / (1 - dropout), shape (groups, passes, n_in)
        :param weight: shape (n_out, n_in)
        :param with_gradient: whether the result will be differentiated
        :return: shape (groups, passes, rows, n_out)
        """
        scale, n_in = 1.0 / (1.0 - self.dropout), weight.shape[1]
        kept, dropped = mask.topk(most_dropped(n_in, self.dropout), dim=-1, largest=False)  # zeros first
        columns = weight.t()[dropped] * (scale - kept).unsqueeze(-1)  # (groups, passes, n_dropped, n_out)
        if with_gradient:
            # The gradient of indexing adds at equal places, in an order that threads do not keep; that of a product is
            # the same at every run.
            chosen = (dropped.unsqueeze(-1) == th.arange(n_in, device=hidden.device)).to(hidden.dtype)
            units = th.matmul(chosen, hidden.transpose(-1, -2).unsqueeze(1))
        else:
            first_row = n_in * th.arange(hidden.shape[0], device=hidden.device)
            units = hidden.transpose(-1, -2).reshape(-1, hidden.shape[1])[dropped + first_row[:, None, None]]
        return th.matmul(scale * hidden, weight.t()).unsqueeze(1) - th.matmul(units.transpose(-1, -2), columns)

    def _weights(self, vectors: th.Tensor) -> tuple[list[th.Tensor], list[th.Tensor]]:
        pairs = zip(self.layers, self._pairs(vectors), strict=True)
        return [layer.normalized(*pair) for layer, pair in pairs], [layer.bias for layer in self.layers]


def most_dropped(width: int, dropout: float) -> int:
    """
    How many units of a layer a mask can be taken to drop at most, which is what a thinned product counts out.

    :param width: units of a layer
    :param dropout: probability that a unit is dropped
    :return: smallest number that a mask exceeds with a probability below :data:`RARE`, at least 1
    """
    if dropout == 0.0:
        return 1
    more = 0.0  # probability of more than k
    for k in range(width, 1, -1):
        # in logarithms: the number of masks of a wide layer is beyond what a float holds
        ways = math.lgamma(width + 1) - math.lgamma(k + 1) - math.lgamma(width - k + 1)
        more += math.exp(ways + k * math.log(dropout) + (width - k) * math.log1p(-dropout))
        if more >= RARE:
            return k
    return 1


class ActionVAE(KeepDtype, BaseModel):
    """
    Conditional variational autoencoder of the data's actions, with the ranges of BCQ and BEAR.

    :param observation_space: observation space
    :param action_space: action space
    :param net_arch: widths of the hidden layers of encoder and decoder
    :param features_extractor: network applied to the observations first
    :param features_dim: its output width
    :param activation_fn: activation of the hidden layers
    :param normalize_images: kept for Stable-Baselines3's interface; observations are never divided by 255
    """

    optimizer: th.optim.Optimizer

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
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        action_dim = get_action_dim(action_space)
        self.latent_dim = 2 * action_dim
        width = net_arch[-1] if net_arch else features_dim + action_dim
        self.encoder = nn.Sequential(*create_mlp(features_dim + action_dim, -1, net_arch, activation_fn))
        self.mean = nn.Linear(width, self.latent_dim)
        self.log_std = nn.Linear(width, self.latent_dim)
        self.decoder = nn.Sequential(*create_mlp(features_dim + self.latent_dim, action_dim, net_arch, activation_fn))

    def forward(self, obs: th.Tensor, actions: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Encode the data's actions, draw latent variables, and decode these: what the autoencoder's loss is made of.

        :param obs: shape (batch, *obs_shape)
        :param actions: scaled to [-1, 1], shape (batch, action_dim)
        :param noise: standard normal, shape (batch, latent_dim)
        :return: reconstructed actions (after tanh), mean and log standard deviation of the latent variables
        """
        hidden = self.encoder(th.cat([self.extract_features(obs, self.features_extractor), actions], dim=-1))
        mean, log_std = self.mean(hidden), self.log_std(hidden).clamp(*VAE_LOG_STD_LIMITS)
        return th.tanh(self.decode(obs, mean + log_std.exp() * noise)), mean, log_std

    def decode(self, obs: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """
        Actions that latent variables stand for in given states, of which each may have several.

        :param obs: shape (batch, *obs_shape)
        :param latents: shape (..., batch, latent_dim)
        :return: actions before tanh, shape (..., batch, action_dim)
        """
        features = self.extract_features(obs, self.features_extractor).expand(*latents.shape[:-1], -1)
        return self.decoder(th.cat([features, latents], dim=-1))

    def sample(self, obs: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """
        Actions like those of the data. The latent variables are clipped, which leaves the unlikely actions out.

        :param obs: shape (batch, *obs_shape)
        :param noise: standard normal, shape (..., batch, latent_dim)
        :return: actions before tanh, shape (..., batch, action_dim)
        """
        return self.decode(obs, noise.clamp(-LATENT_LIMIT, LATENT_LIMIT))
