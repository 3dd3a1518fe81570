"""Policy of UWAC: the best of many sampled actions, by critics whose dropout is never switched off."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_dce.policies import OfflineSACPolicy
from sb3_dce.uwac_networks import BLOCK_ROWS, ActionVAE, DropoutCritic

VAE_NET_ARCH = (750, 750)


class UWACPolicy(OfflineSACPolicy):
    """
    Actor, critics with dropout, action model; acts by the best of many sampled actions.

    As in the authors' code the action is the one of ``n_predict_actions`` draws of the actor with the largest value, the
    first critic's mean over its dropout passes. With ``deterministic=False`` draws and masks are new at every call, which
    is their evaluation. With ``deterministic=True`` they are those of ``predict_seed`` (the same for every agent), at every
    call and for every state: the action is then a function of the observation alone, also after loading. All candidates of
    a call are valued with the same masks. Other parameters as :class:`~sb3_dce.policies.OfflineSACPolicy`.

    :param critic_dropout: probability that a hidden unit of the critics is dropped
    :param n_mc_dropout: dropout passes
    :param n_predict_actions: actions drawn for a prediction
    :param predict_seed: of the draws and masks of deterministic predictions
    :param vae_net_arch: widths of the hidden layers of the action model's encoder and decoder
    """

    critic: DropoutCritic  # type: ignore[assignment]
    critic_target: DropoutCritic  # type: ignore[assignment]
    vae: ActionVAE
    candidate_noise: th.Tensor

    def __init__(
        self,
        *args: Any,
        critic_dropout: float = 0.1,
        n_mc_dropout: int = 100,
        n_predict_actions: int = 100,
        predict_seed: int = 0,
        vae_net_arch: Sequence[int] = VAE_NET_ARCH,
        **kwargs: Any,
    ) -> None:
        self.critic_dropout = critic_dropout
        self.n_mc_dropout = n_mc_dropout
        self.n_predict_actions = n_predict_actions
        self.predict_seed = predict_seed
        self.vae_net_arch = list(vae_net_arch)
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        kwargs = self._update_features_extractor(self.net_args, None)
        self.vae = ActionVAE(**{**kwargs, "net_arch": self.vae_net_arch}).to(self.device)
        self.vae.optimizer = self.make_optimizer(self.vae, lr_schedule)
        # Not in the state dict: they follow from the seed, and a model may be loaded with other numbers of them.
        generator = th.Generator().manual_seed(self.predict_seed)
        noise = th.randn(self.n_predict_actions, 1, get_action_dim(self.action_space), generator=generator, device="cpu")
        self.register_buffer("candidate_noise", noise, persistent=False)
        for index, mask in enumerate(self._draw_masks(generator, generator.device)):
            self.register_buffer(f"predict_mask_{index}", mask, persistent=False)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> DropoutCritic:  # type: ignore[override]
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return DropoutCritic(**kwargs, dropout=self.critic_dropout, n_passes=self.n_mc_dropout).to(self.device)

    def set_training_mode(self, mode: bool) -> None:
        """
        Switch actor, critics and action model; the targets always stay in evaluation mode.

        :param mode: True for training, False for evaluation
        """
        super().set_training_mode(mode)
        self.vae.set_training_mode(mode)

    def _draw_masks(self, generator: th.Generator | None, device: th.device) -> list[th.Tensor]:
        """New dropout masks of the first critic, each of shape (1, 1, n_mc_dropout, width)."""
        keep = 1.0 - self.critic_dropout
        shapes = [(1, 1, self.n_mc_dropout, width) for width in self.critic.net_arch]
        return [(th.rand(shape, generator=generator, device=device) < keep) / keep for shape in shapes]

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        at_once = max(1, BLOCK_ROWS // self.n_predict_actions)
        return th.cat([self._best_actions(obs, deterministic) for obs in observation.split(at_once)])

    def _best_actions(self, obs: th.Tensor, deterministic: bool) -> th.Tensor:
        mean, log_std, _ = self.actor.get_action_dist_params(obs)
        if deterministic:
            noise = self.candidate_noise
            masks = [getattr(self, f"predict_mask_{index}") for index in range(len(self.critic.net_arch))]
        else:
            noise = th.randn(self.n_predict_actions, *mean.shape, device=mean.device, dtype=mean.dtype)
            masks = [mask.to(mean.dtype) for mask in self._draw_masks(None, mean.device)]
        actions = th.tanh(mean + log_std.exp() * noise)  # (n_predict_actions, batch, action_dim)
        vectors = th.cat([vector.reshape(-1) for vector in self.critic.power_vectors()])
        repeated = obs.expand(len(actions), *obs.shape).flatten(0, 1)
        q_values = self.critic.mc_values(vectors, repeated, actions.flatten(0, 1)[None], masks, n_critics=1)
        best = q_values.mean(dim=-2).view(len(actions), -1).argmax(dim=0)
        return actions[best, th.arange(len(obs), device=obs.device)]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "critic_dropout": self.critic_dropout,
            "n_mc_dropout": self.n_mc_dropout,
            "n_predict_actions": self.n_predict_actions,
            "predict_seed": self.predict_seed,
            "vae_net_arch": self.vae_net_arch,
        }
