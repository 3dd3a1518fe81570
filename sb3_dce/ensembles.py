"""Several critics as one function of their flat parameter vector, and the policy of agents with many critics."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_dce.networks import OfflineCritic
from sb3_dce.policies import OfflineSACPolicy
from sb3_dce.state import PureNet


def batched_products_pay(device: th.device) -> bool:
    """
    Whether critics of equal shape run faster as batched matrix products than one after the other.

    On a CPU they do not: with the 10 critics and 5376 rows of PBRL one after the other took 820 ms against 1020 ms (compiled,
    forward and backward; ``benchmarks/results/ensembles.md``), since its activations stay in the cache from layer to layer
    and those of all critics together do not. On a GPU, where launches count, the choice has not been measured.

    :param device: device of the critics
    :return: True for batched products
    """
    return device.type != "cpu"


class EnsembleNet:
    """
    Critics as a function of their flat parameter vector.

    The parameters stay the ordinary ones (``qf0.0.weight``, ``qf0.0.bias``, ...). Since they lie in the vector critic by
    critic, the batched form needs no copy: the same layer of all critics is a strided view.

    :param critic: the critics
    """

    def __init__(self, critic: OfflineCritic) -> None:
        self._critic = critic
        self._one_by_one = PureNet(critic)
        self._layers = list(critic.q_networks[0].children())
        self._sizes = [parameter.numel() for parameter in critic.q_networks[0].parameters()]
        # a features extractor with parameters, or a layer that is none of these, is left to the modules themselves
        plain_layers = all(isinstance(layer, nn.Linear) or not list(layer.parameters()) for layer in self._layers)
        self._plain = plain_layers and not list(critic.features_extractor.parameters())

    def is_batched(self, device: th.device) -> bool:
        """
        Batched products need a device on which they pay, and critics whose parameters all belong to linear layers.

        :param device: device of the parameters
        :return: whether the critics are run as batched products, else one after the other
        """
        return self._plain and batched_products_pay(device)

    def __call__(self, flat: th.Tensor, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Q of all critics, stacked, as a differentiable function of the flat vector; both ways agree up to rounding.

        :param flat: shape (n_parameters,)
        :param obs: shape (batch, *obs_shape)
        :param actions: scaled to [-1, 1], shape (batch, action_dim)
        :return: shape (n_critics, batch, 1)
        """
        if not self.is_batched(flat.device):
            return th.stack(self._one_by_one(flat, obs, actions))
        n_critics = self._critic.n_critics
        features = self._critic.extract_features(obs, self._critic.features_extractor)
        hidden = th.cat([features, actions], dim=-1).expand(n_critics, -1, -1)
        pieces = iter(flat.view(n_critics, -1).split(self._sizes, dim=1))
        for layer in self._layers:
            if isinstance(layer, nn.Linear):
                weight = next(pieces).view(n_critics, layer.out_features, layer.in_features)
                hidden = th.baddbmm(next(pieces).unsqueeze(1), hidden, weight.transpose(1, 2))
            else:
                hidden = layer(hidden)
        return hidden


class EnsemblePolicy(OfflineSACPolicy):
    """
    Squashed-Gaussian actor and an ensemble of critics, with frozen random critics beside them if wished.

    Other parameters as :class:`~sb3_dce.policies.OfflineSACPolicy`.

    :param random_prior: build ``critic_prior``, an untrained critic for each trained one (Osband et al., 2018)
    """

    critic_prior: OfflineCritic | None

    def __init__(self, *args: Any, random_prior: bool = False, **kwargs: Any) -> None:
        self.random_prior = random_prior
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.critic_prior = None
        if self.random_prior:
            prior = self.make_critic()
            assert isinstance(prior, OfflineCritic)
            self.critic_prior = prior.requires_grad_(False)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "random_prior": self.random_prior}
