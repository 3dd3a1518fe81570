"""
Episodes of a deterministic policy, many side by side: the returns of Stable-Baselines3's ``evaluate_policy``, sooner.

Nothing is approximated. The actor computes on the same batch of observations, so actions agree to the last bit; what is left
out is the work around it: vectorised environments that restart, monitors, distributions that are not sampled, and the parts
of the simulators' steps that nobody reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_dce.checks import SEEDS_PER_EVALUATION, check_number, check_optional
from sb3_dce.data.catalog import resolve
from sb3_dce.data.locate import catalogue_id, is_path
from sb3_dce.data.minari import is_minari_name
from sb3_dce.envs import make_env_if_possible, missing_simulator, own_env, without_bookkeeping
from sb3_dce.errors import ConfigError
from sb3_dce.locomotion import EnvSteps, fast_steps
from sb3_dce.mlp_actor import MLPActor, actor_snapshot
from sb3_dce.normalizing import vec_normalize_of
from sb3_dce.sb3_checks import check_env_fits

Act = Callable[[np.ndarray], np.ndarray]


class Episodes(NamedTuple):
    """
    Outcome of some episodes, in the order in which they ended (as ``evaluate_policy`` lists them).

    :param returns: undiscounted return of each, reward units
    :param lengths: steps of each
    """

    returns: tuple[float, ...]
    lengths: tuple[int, ...]


class Ending(NamedTuple):
    """
    One episode; sorted, episodes are in the order in which they ended.

    :param step: steps since the start of the evaluation
    :param row: of the environment
    :param episode_return: undiscounted return, reward units
    :param length: steps of the episode
    """

    step: int
    row: int
    episode_return: float
    length: int


def in_order(endings: Iterable[Ending]) -> Episodes:
    """
    Returns and lengths in the order in which episodes ended, so that it does not matter which process played which.

    :param endings: of all episodes of an evaluation, which may come from several processes
    :return: the same as of an evaluation in one process
    """
    ordered = sorted(endings)
    return Episodes(tuple(e.episode_return for e in ordered), tuple(e.length for e in ordered))


class Rollouts:
    """
    Environments that play episodes side by side, made when they are first needed.

    With ``n_envs`` environments the returns are those of ``evaluate_policy`` on a ``DummyVecEnv`` of ``n_envs`` environments
    that was seeded (``vec_env.seed(seed)``): of its first environment with ``seed``, of the next ones with the next numbers.
    Each plays its share of the episodes; from its second one on it goes on with its own random generator. The default, one
    environment per episode, is the fastest. ``n_envs=1`` is ``evaluate_policy`` on a single environment. The returns for
    different ``n_envs`` are those of different starts and so not the same numbers.

    :param make_env: makes one environment
    :param n_episodes: episodes of an evaluation
    :param n_envs: environments; default: as many as episodes
    :param dataset: id or name from which :func:`~sb3_dce.rollouts.rollouts_of` makes the same in another process
    :raises ConfigError: if a number is below 1, or there would be more than 10,000 environments, each with a seed of its own
    """

    def __init__(
        self,
        make_env: Callable[[], gym.Env],
        n_episodes: int,
        n_envs: int | None = None,
        dataset: str | None = None,
    ) -> None:
        most = SEEDS_PER_EVALUATION if n_envs is None else float("inf")
        hint = f"Usual are 10; for more than {SEEDS_PER_EVALUATION:,} give n_envs."
        check_number("n_eval_episodes", n_episodes, 1, most, integer=True, hint=hint)
        check_optional("n_envs", n_envs, 1, high=SEEDS_PER_EVALUATION, integer=True, hint="Leave it out.")
        self.n_episodes, self.n_envs, self.dataset = n_episodes, n_envs or n_episodes, dataset
        self._make_env = make_env
        self._envs: dict[int, gym.Env] = {}
        self._limit: int | None = None
        self._steps: tuple[list[int], EnvSteps] | None = None

    def check_fits(self, model: Any) -> None:
        """
        Refuse a model with other spaces than the environments; bounds of observations may differ.

        :param model: agent, or anything with ``predict``; without spaces it passes
        :raises ConfigError: if it sees or does other things than the environments have
        """
        hint = "Evaluate it in the environment of its own data (--dataset, --env), or use evaluate_policy(model, env)."
        check_env_fits(model, self._env(0), hint)

    def play(self, act: Act, seed: int) -> Episodes:
        """
        All episodes.

        :param act: observations of shape (n_envs, *obs_shape) to actions of shape (n_envs, *action_shape); rows of
            environments that are done keep their last observation
        :param seed: seed of the first environment; the next ones have the next numbers
        :return: returns and lengths
        """
        return in_order(self.play_rows(act, seed, range(self.n_envs)))

    def play_rows(self, act: Act, seed: int, rows: Iterable[int]) -> list[Ending]:
        """
        The episodes of some of the environments. They are what they are beside the others: the actor computes on a batch of
        ``n_envs`` observations, each in its place, and the bits of a row depend on nothing but the batch's shape.

        :param act: as for :meth:`play`
        :param seed: as for :meth:`play`
        :param rows: numbers of the environments
        :return: their episodes
        """
        rows = list(rows)
        steps = self._make_steps(rows)
        left = {row: (self.n_episodes + row) // self.n_envs for row in rows}  # the shares of `evaluate_policy`
        running = [row for row in rows if left[row]]
        starts = [steps.reset(row, seed + row) for row in running]
        if not running:
            return []
        obs = np.zeros((self.n_envs, *starts[0].shape), starts[0].dtype)
        obs[running] = starts
        rewards: dict[int, list[float]] = {row: [] for row in running}
        limit, t, endings = self._limit, 0, []
        while running:
            t += 1
            paid, ended = steps.step(running, act(obs), obs)
            still = []
            for row, reward, end in zip(running, paid, ended, strict=True):
                seen = rewards[row]
                seen.append(reward)
                if not (end or len(seen) == limit):
                    still.append(row)
                    continue
                # the sum and the rounding of Stable-Baselines3's Monitor
                endings.append(Ending(t, row, round(sum(seen), 6), len(seen)))
                left[row] -= 1
                if left[row]:
                    obs[row], rewards[row] = steps.reset(row, None), []
                    still.append(row)
            running = still
        return endings

    def _make_steps(self, rows: list[int]) -> EnvSteps:
        if self._steps is None or self._steps[0] != rows:
            self._steps = (rows, fast_steps({row: self._env(row) for row in rows}))
        return self._steps[1]

    def _env(self, row: int) -> gym.Env:
        if row not in self._envs:
            self._envs[row], self._limit = without_bookkeeping(self._make_env())
        return self._envs[row]

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs.values():
            env.close()
        self._envs, self._steps = {}, None


def make_rollouts(dataset_id: str, n_episodes: int, n_envs: int | None = None) -> Rollouts | None:
    """
    Environments in which policies trained on a dataset of the catalogue are scored.

    :param dataset_id: id of the catalogue
    :param n_episodes: episodes of an evaluation
    :param n_envs: environments that play them, see :class:`~sb3_dce.rollouts.Rollouts`
    :return: environments to evaluate in, or ``None`` where there is no simulator
    """
    if missing_simulator(resolve(dataset_id)) is not None:
        return None
    return Rollouts(lambda: make_env_if_possible(dataset_id), n_episodes, n_envs, dataset_id)


def rollouts_of(dataset: str | None, n_episodes: int, n_envs: int | None = None) -> Rollouts | None:
    """
    Environments of the data a model was trained on: by the catalogue, else by what the data say of themselves.

    :param dataset: id, file or ``minari:`` name a model was trained on
    :param n_episodes: episodes of an evaluation
    :param n_envs: environments that play them, see :class:`~sb3_dce.rollouts.Rollouts`
    :return: environments to evaluate in, or ``None`` where none is known or there is no simulator
    :raises DatasetError: for a name that is neither known nor a file
    """
    dataset_id = catalogue_id(dataset)
    if dataset_id is not None:
        return make_rollouts(dataset_id, n_episodes, n_envs)
    if dataset is not None and not is_path(dataset) and not is_minari_name(dataset):
        resolve(dataset)  # which says what is known
    first = None if dataset is None else own_env(dataset)
    if dataset is None or first is None:
        return None
    made = [first]  # what was made to find out is the first that is used

    def make_env() -> gym.Env:
        env = made.pop() if made else own_env(dataset)
        assert env is not None
        return env

    return Rollouts(make_env, n_episodes, n_envs, dataset)


def plain_policy(model: Any) -> BasePolicy | None:
    """
    The policy that can stand in for its model, because ``model.predict`` adds nothing to it.

    :param model: agent of Stable-Baselines3 or of this package, or anything with ``predict``
    :return: its policy, if ``model.predict`` is the policy's ``predict`` of Stable-Baselines3 and nothing else, on the
        observations of the environment; else ``None``
    """
    if vec_normalize_of(model) is not None:
        return None
    policy: Any = getattr(model, "policy", None)
    own_predict = type(model).predict is not BaseAlgorithm.predict or type(policy).predict is not BasePolicy.predict
    return None if own_predict or not isinstance(policy, BasePolicy) else policy


def deterministic_act(model: Any) -> Act:
    """
    What a model does without noise.

    :param model: agent of Stable-Baselines3 or of this package, or anything with ``predict``
    :return: function of a batch of observations; the bits are those of ``model.predict(obs, deterministic=True)``. Weights
        that change later need another call. It raises ``ConfigError`` for a model that remembers what it saw before
    """
    policy, normalizer = plain_policy(model), vec_normalize_of(model)
    if normalizer is not None:
        return lambda obs: _predicted(model, normalizer.normalize_obs(obs))
    if policy is None:
        return lambda obs: _predicted(model, obs)
    snapshot = actor_snapshot(policy) if policy.device.type == "cpu" else None
    return policy_act(policy) if snapshot is None else MLPActor(snapshot)


def _predicted(model: Any, obs: Any) -> np.ndarray:
    actions, memory = model.predict(obs, deterministic=True)
    if memory is not None:  # which would have to be given back at the next step, and forgotten at the end of an episode
        raise ConfigError(
            f"{type(model).__name__} acts by what it remembers of an episode, and these episodes are played without",
            key="model",
            hint="Use evaluate_policy(model, env) of Stable-Baselines3, which keeps it.",
        )
    return actions


def policy_act(policy: BasePolicy) -> Act:
    """
    Let a policy act without noise through its own modules, which are put into evaluation mode.

    :param policy: any policy of Stable-Baselines3 with a box of actions
    :return: function of a batch of observations, the bits of ``policy.predict(obs, deterministic=True)``
    """
    policy.set_training_mode(False)
    space, device = policy.action_space, policy.device
    shape = space.shape
    assert isinstance(space, gym.spaces.Box) and shape is not None

    def act(obs: np.ndarray) -> np.ndarray:
        with th.inference_mode():
            actions = policy._predict(th.as_tensor(obs, device=device), deterministic=True).cpu().numpy()
        actions = actions.reshape(-1, *shape)
        return policy.unscale_action(actions) if policy.squash_output else np.clip(actions, space.low, space.high)

    return act
