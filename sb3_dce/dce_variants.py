"""
Two agents of the paper's ablations that are settings of :class:`~sb3_dce.dce.OfflineDCE`, under names of their own.

They have DCE's update, and no parameter that would make them something else. What they save is loaded by their own class.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_dce.attaching import DatasetLike
from sb3_dce.dce import OfflineDCE
from sb3_dce.policies import OfflineSACPolicy


class OfflineSACV(OfflineDCE):
    """
    SAC with V: V by expectile regression, Q on V, no penalty. It is ``OfflineDCE(beta=0)``.

    Parameters are described in :class:`~sb3_dce.dce.OfflineDCE` and :class:`~sb3_dce.base.OfflineAlgorithm`.
    """

    algo_name: ClassVar[str] = "sac_v"

    def __init__(
        self,
        policy: str | type[OfflineSACPolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        gradient_steps: int = 1,
        expectile: float = 0.7,
        ent_coef: str | float = "auto",
        target_entropy: str | float = "auto",
        max_grad_norm: float | None = None,
        d4rl_compat: bool = False,
        normalize_obs: bool = False,
        reward_normalization: str | None = None,
        reward_scale: float = 1.0,
        reward_shift: float = 0.0,
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
            tau=tau,
            gamma=gamma,
            gradient_steps=gradient_steps,
            expectile=expectile,
            ent_coef=ent_coef,
            target_entropy=target_entropy,
            beta=0.0,
            max_grad_norm=max_grad_norm,
            d4rl_compat=d4rl_compat,
            normalize_obs=normalize_obs,
            reward_normalization=reward_normalization,
            reward_scale=reward_scale,
            reward_shift=reward_shift,
            execution=execution,
            precision=precision,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )


class OfflineCQLEq18(OfflineDCE):
    """
    The paper's Eq. 18: CQL's first objective, that is DCE's penalty without V.

    ``y = r + gamma * (1 - d) * min_i Qt_i(s', a')`` with a' ~ pi(s') and no entropy, critics with ``0.5 * mean((Q - y)^2) +
    beta * mean(Q(s, a ~ pi))``, beta constant. It is ``OfflineDCE(use_v=False, td_loss_coef=0.5, beta=4, ent_coef=1.0)``.
    In these units the penalty shifts Q by ``beta`` per step, where DCE with its ``td_loss_coef=1`` shifts by ``beta / 2``.

    Parameters are described in :class:`~sb3_dce.dce.OfflineDCE` and :class:`~sb3_dce.base.OfflineAlgorithm`.
    """

    algo_name: ClassVar[str] = "cql_eq18"

    def __init__(
        self,
        policy: str | type[OfflineSACPolicy],
        env: GymEnv | str | None = None,
        dataset: DatasetLike | None = None,
        learning_rate: float | Schedule = 3e-4,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        gradient_steps: int = 1,
        ent_coef: str | float = 1.0,
        target_entropy: str | float = "auto",
        beta: float = 4.0,
        max_grad_norm: float | None = None,
        d4rl_compat: bool = False,
        normalize_obs: bool = False,
        reward_normalization: str | None = None,
        reward_scale: float = 1.0,
        reward_shift: float = 0.0,
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
            tau=tau,
            gamma=gamma,
            gradient_steps=gradient_steps,
            ent_coef=ent_coef,
            target_entropy=target_entropy,
            beta=beta,
            td_loss_coef=0.5,
            use_v=False,
            max_grad_norm=max_grad_norm,
            d4rl_compat=d4rl_compat,
            normalize_obs=normalize_obs,
            reward_normalization=reward_normalization,
            reward_scale=reward_scale,
            reward_shift=reward_shift,
            execution=execution,
            precision=precision,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )
