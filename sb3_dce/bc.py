"""Behavioural cloning: the policy of the data, by regression or by maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples, Schedule

from sb3_dce import losses
from sb3_dce.attaching import DatasetLike
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.buffers import OfflineReplayBuffer
from sb3_dce.checks import check_choice, check_number
from sb3_dce.data.selection import rows_of_best_episodes
from sb3_dce.data.transitions import Transitions
from sb3_dce.errors import ConfigError
from sb3_dce.execution import Update, UpdateOptions, bound_update
from sb3_dce.noise import NoiseSpec
from sb3_dce.policies import ActorPolicy
from sb3_dce.state import PureNet, Storage
from sb3_dce.steps import descend


@dataclass(frozen=True)
class BCOptions(UpdateOptions):
    """
    What is fixed when an update of behavioural cloning is traced: which of the two losses it descends.

    :param likelihood: maximise the likelihood instead of the squared error
    """

    likelihood: bool


class OfflineBC(OfflineAlgorithm):
    """
    Behavioural cloning: ``mean((tanh(mu(s)) - a)^2)``, or ``-mean(log pi(a|s))`` of a squashed Gaussian.

    Parameters not listed here are described in :class:`~sb3_dce.base.OfflineAlgorithm`.

    :param bc_loss: ``"mse"`` trains the deterministic action (default), which ``predict`` then always gives; ``"nll"`` trains
        the whole distribution. Its log-probabilities need actions inside (-1, 1), so data are clipped to +-(1 - 1e-5) there
    :param fraction: clone only this share of the whole episodes, the best by undiscounted return (0.1 is "10 % BC"); 1.0 uses
        all rows. The chosen rows are copied
    """

    algo_name: ClassVar[str] = "offline_bc"
    networks = ("actor",)
    population_scalars = frozenset({"fraction"})
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": ActorPolicy}
    policy: ActorPolicy

    def __init__(
        self,
        policy: str | type[ActorPolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        gradient_steps: int = 1,
        bc_loss: str = "mse",
        fraction: float = 1.0,
        max_grad_norm: float | None = None,
        d4rl_compat: bool = False,
        normalize_obs: bool = False,
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
            gradient_steps=gradient_steps,
            max_grad_norm=max_grad_norm,
            d4rl_compat=d4rl_compat,
            normalize_obs=normalize_obs,
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
        self.bc_loss = bc_loss
        self.fraction = fraction
        if _init_setup_model:
            self._setup_model()

    def check_parameters(self) -> None:
        super().check_parameters()
        check_choice("bc_loss", self.bc_loss, ("mse", "nll"))
        check_number("fraction", self.fraction, 0, 1, open_low=True, hint="0.1 clones the best tenth of the episodes.")

    def policy_settings(self) -> dict[str, Any]:
        return {**super().policy_settings(), "stochastic": self.bc_loss == "nll"}

    def chosen_rows(self, transitions: Transitions) -> np.ndarray | None:
        return rows_of_best_episodes(transitions, self.fraction) if self.fraction < 1.0 else None

    def _take_statistics_of(self, buffer: OfflineReplayBuffer) -> None:
        if self.fraction < 1.0:
            raise ConfigError(
                f"fraction={self.fraction:g} chooses episodes, and a replay buffer does not know where they begin",
                key="fraction",
                hint="Pass the data as dataset=, for example Transitions.from_replay_buffer(buffer), or use fraction=1.0.",
            )
        super()._take_statistics_of(buffer)

    def make_update(self, storages: dict[str, Storage]) -> Update:
        options = BCOptions(max_grad_norm=self.max_grad_norm, likelihood=self.bc_loss == "nll")
        return bound_update(update, options, {"actor": PureNet(self.actor, "get_action_dist_params")}, storages)

    def noise_specs(self, batch_size: int) -> dict[str, NoiseSpec]:
        return {}


def update(
    options: BCOptions,
    nets: dict[str, PureNet],
    settings: dict[str, Any],
    state: dict[str, Any],
    batch: ReplayBufferSamples,
    noise: dict[str, th.Tensor],
    coef: dict[str, th.Tensor],
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """
    One gradient step of behavioural cloning.

    :param options: choices fixed at trace time
    :param nets: the actor as a function of its flat parameters
    :param settings: optimizer constants of each learner
    :param state: learner "actor"
    :param batch: tensors of shape (batch, ...); actions scaled to [-1, 1]
    :param noise: none is needed
    :param coef: 0-dimensional coefficients
    :return: changed parts of the state, metrics
    """

    def loss(params: th.Tensor) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor]]:
        mean, log_std, _ = nets["actor"](params, batch.observations)
        if options.likelihood:
            return losses.bc_nll(mean, log_std, batch.actions), (mean, log_std)
        return losses.bc_mse(th.tanh(mean), batch.actions), (mean, log_std)

    lr, clip = coef["learning_rate"], options.max_grad_norm
    actor, value, (mean, log_std), norm = descend(loss, state["actor"], lr, settings["actor"], clip)
    metrics = {"bc_loss": value, "actor_loss": value, "grad_norm_actor": norm}
    metrics["action_dist"] = (th.tanh(mean) - batch.actions).abs().mean()
    metrics["log_std"] = log_std.mean()
    return {"actor": actor}, metrics
