"""
The agent behind the paper's figure on out-of-distribution actions: SAC with V, and beside it critics trained with a penalty.

One actor, the same batches and the same noise for all: the critics differ in beta alone. It has DCE's update, called once
per set of critics, and is a measuring instrument, not an agent to choose.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from torch import nn

from sb3_dce.attaching import DatasetLike
from sb3_dce.dce import OfflineDCE
from sb3_dce.execution import Update
from sb3_dce.policies import OfflineSACPolicy
from sb3_dce.state import PureNet, Storage
from sb3_dce.theory import beta_eff

PROBE_BETAS = (1, 2, 4, 8)
# Frozen policies whose deterministic actions stand for actions outside of the data.
PROBE_POLICIES = ("init", "best")
TRAINED = ("critic", "critic_target", "value_net")


def probe_name(network: str, beta: int) -> str:
    """
    Attribute under which the policy and the state tree keep a network of one beta's set.

    :param network: "critic", "critic_target" or "value_net"
    :param beta: penalty weight of its set; 0 is the agent's own
    :return: name of the network
    """
    return f"{network}_beta{beta}" if beta else network


class ProbePolicy(OfflineSACPolicy):
    """The same policy with the probe's critics and frozen actors; parameters as :class:`OfflineSACPolicy`."""

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        for name in PROBE_POLICIES:
            self._add(f"actor_{name}", self.make_actor(), self.actor)
        for beta in PROBE_BETAS:  # the same start for all: what differs later is beta's doing
            for network, made in zip(TRAINED, (self.make_critic(), self.make_critic(), self.make_value_net()), strict=True):
                copy = self._add(probe_name(network, beta), made, getattr(self, network))
                if network != "critic_target":
                    copy.optimizer = self.make_optimizer(copy, lr_schedule)  # type: ignore[assignment]

    def _add(self, name: str, network: nn.Module, original: nn.Module) -> nn.Module:
        network.load_state_dict(original.state_dict())
        setattr(self, name, network)
        return network


def rank_correlation(x: th.Tensor, y: th.Tensor) -> th.Tensor:
    """
    Spearman's rank correlation; equal numbers, as of a row that a batch holds twice, get ranks in the order of their rows.

    :param x: shape (n,)
    :param y: shape (n,)
    :return: 0-dimensional, from -1 to 1; 1 for a single row
    """
    n = len(x)
    ranks = [values.argsort(stable=True).argsort(stable=True).to(x.dtype) for values in (x, y)]
    return 1.0 - 6.0 * (ranks[0] - ranks[1]).square().sum() / max(n * (n * n - 1), 1)


class OfflineDCEProbe(OfflineDCE):
    """
    SAC with V (beta 0) and four more sets of critics and V with beta 1, 2, 4 and 8, trained on the same batches.

    Beside DCE's diagnostics it logs, for each set (0 is the agent's own): ``probe<beta>_data`` Q of the data's actions,
    ``probe<beta>_policy`` Q of the current policy's, ``probe<beta>_init`` and ``probe<beta>_best`` Q of the actions of two
    frozen policies, the one at the start and one given later, and ``probe<beta>_max``, ``probe<beta>_min``: in each state
    the larger and the smaller of these two. All are means over batch and critics, in reward units. ``probe<beta>_rank`` says
    how alike the set and the agent's own order the data's actions: rank correlation of Q - V over the batch, of each critic
    with another one of the agent's own, so that for beta 0, too, the two began with other weights.

    ``actor_best`` equals the start until :meth:`set_best_policy`. Parameters are described in :class:`~sb3_dce.dce.OfflineDCE`
    and :class:`~sb3_dce.base.OfflineAlgorithm`.
    """

    algo_name: ClassVar[str] = "dce_probe"
    networks = (
        *OfflineDCE.networks,
        *(f"actor_{name}" for name in PROBE_POLICIES),
        *(f"{network}_beta{beta}" for beta in PROBE_BETAS for network in ("critic", "critic_target", "value_net")),
    )
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": ProbePolicy}
    actor_best: nn.Module

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
        ent_coef: str | float = 1.0,
        target_entropy: str | float = "auto",
        td_loss_coef: float = 1.0,
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
            td_loss_coef=td_loss_coef,
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

    def set_best_policy(self, agent: OfflineDCE) -> None:
        """
        Copy an agent's actor into the frozen ``actor_best``; until then this is the actor at the start.

        :param agent: trained agent with an actor of the same shape, whose deterministic actions are probed from now on
        """
        self.actor_best.load_state_dict(agent.actor.state_dict())

    def coefficients(self, n_updates: int) -> dict[str, float]:
        betas = {f"beta_{beta}": float(beta) for beta in PROBE_BETAS}
        shifts = {f"beta_eff_{beta}": beta_eff(beta, self.td_loss_coef) for beta in PROBE_BETAS}
        return {**super().coefficients(n_updates), **betas, **shifts}

    def make_update(self, storages: dict[str, Storage]) -> Update:
        dce_update = super().make_update(storages)
        actor, critic = PureNet(self.actor, "get_action_dist_params"), PureNet(self.critic)
        assert self.value_net is not None  # no parameter takes V away
        value_net = PureNet(self.value_net)

        def probe_update(state: Any, batch: Any, noise: Any, coef: Any, with_actor: bool) -> Any:
            new, metrics = dce_update(state, batch, noise, coef, with_actor=with_actor)
            s = batch.observations
            actions = [th.tanh(actor(state[f"actor_{name}"], s)[0]) for name in PROBE_POLICIES]
            others: list[th.Tensor] = []
            for beta in (0, *PROBE_BETAS):
                names = {network: probe_name(network, beta) for network in TRAINED}
                found = metrics
                if beta:
                    own = {"actor": state["actor"], **{network: state[name] for network, name in names.items()}}
                    weights = {"beta": coef[f"beta_{beta}"], "beta_eff": coef[f"beta_eff_{beta}"]}
                    changed, found = dce_update(own, batch, noise, {**coef, **weights}, with_actor=False)
                    new.update({name: changed[network] for network, name in names.items()})
                params = state[names["critic"]].params
                q_ood = [th.cat(critic(params, s, a), dim=-1).mean(dim=-1, keepdim=True) for a in actions]
                largest, smallest = th.maximum(*q_ood), th.minimum(*q_ood)
                v = value_net(state[names["value_net"]].params, s)
                advantages = [(q - v).flatten() for q in critic(params, s, batch.actions)]
                others = others or [*advantages[1:], advantages[0]]
                ranks = [rank_correlation(*pair) for pair in zip(advantages, others, strict=True)]
                metrics.update(
                    {
                        f"probe{beta}_data": found["q_data"],
                        f"probe{beta}_policy": found["q_policy"],
                        **{f"probe{beta}_{name}": q.mean() for name, q in zip(PROBE_POLICIES, q_ood, strict=True)},
                        f"probe{beta}_max": largest.mean(),
                        f"probe{beta}_min": smallest.mean(),
                        f"probe{beta}_rank": th.stack(ranks).mean(),
                    }
                )
            return new, metrics

        return probe_update
