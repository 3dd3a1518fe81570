"""``OfflineBC(fraction=...)``: cloning the best episodes only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_dce import OfflineBC, Transitions
from sb3_dce.data.selection import rows_of_best_episodes
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import ConfigError, DatasetSemanticsError
from sb3_dce.networks import StandardizedExtractor

LENGTH = 4


def episodes(returns: list[float], *, terminal: bool = False, next_observations: bool = True, **options: Any) -> Transitions:
    """Episodes of four rows with the given returns; every observation carries the number of its episode."""
    n = LENGTH * len(returns)
    rng = np.random.default_rng(0)
    number = np.repeat(np.arange(len(returns)), LENGTH)
    observations = np.column_stack([number, rng.standard_normal((n, 4))]).astype(np.float32)
    ends = np.arange(n) % LENGTH == LENGTH - 1
    arrays = {
        "observations": observations,
        "actions": rng.uniform(-1, 1, (n, 2)).astype(np.float32),
        "rewards": np.repeat(np.asarray(returns) / LENGTH, LENGTH).astype(np.float32),
        "terminals": ends if terminal else np.zeros(n, dtype=bool),
        "timeouts": np.zeros(n, dtype=bool) if terminal else ends,
    }
    if next_observations:
        following = observations.copy()
        following[:-1] = observations[1:]
        following[ends, 0] = number[ends]
        arrays["next_observations"] = following
    return Transitions.from_arrays(**arrays, **options)


def chosen(data: Transitions, fraction: float) -> list[int]:
    """Numbers of the episodes in the buffer of a model."""
    model = OfflineBC("MlpPolicy", dataset=data, fraction=fraction, policy_kwargs={"net_arch": [4]}, seed=0)
    model.attach_dataset()
    return sorted({int(n) for n in model.replay_buffer.observations[:, 0, 0]})


@pytest.mark.parametrize("terminal", [False, True], ids=["time limits", "terminals"])
@pytest.mark.parametrize("next_observations", [False, True], ids=["without next observations", "with"])
def test_best_tenth_of_20_episodes_are_2(terminal: bool, next_observations: bool) -> None:
    returns = [float(n % 7) for n in range(20)]
    returns[3], returns[11] = 50.0, 40.0
    data = episodes(returns, terminal=terminal, next_observations=next_observations)
    assert chosen(data, 0.1) == [3, 11]


def test_rows_are_those_of_the_data_in_their_order() -> None:
    made = episodes([1.0, 5.0, 2.0, 4.0])
    arrays = {n: getattr(made, n).copy() for n in ("observations", "actions", "rewards", "timeouts", "next_observations")}
    arrays["timeouts"][3], terminals = False, np.arange(16) == 3  # the first episode ends otherwise than the rest
    data = Transitions.from_arrays(**arrays, terminals=terminals)
    model = OfflineBC("MlpPolicy", dataset=data, fraction=0.5, policy_kwargs={"net_arch": [4]}, seed=0).learn(3)
    buffer, kept = model.replay_buffer, np.r_[4:8, 12:16]
    assert buffer.size() == 8
    assert np.array_equal(buffer.observations[:, 0], data.observations[kept])
    assert np.array_equal(buffer.actions[:, 0], data.actions[kept])
    assert np.array_equal(buffer.rewards[:, 0], data.rewards[kept])
    assert np.array_equal(buffer.next_observations[:, 0], data.next_observations[kept])
    assert np.array_equal(buffer.timeouts[:, 0], data.timeouts[kept])
    assert model.dataset_statistics["rows"] == 8


@pytest.mark.parametrize(
    ("fraction", "expected"),
    [
        (0.1, [2]),  # 0.5 of an episode: at least one is kept
        (0.3, [2, 4]),  # 1.5 of 5, rounded
        (0.8, [0, 2, 3, 4]),
        (1.0, [0, 1, 2, 3, 4]),
    ],
)
def test_number_of_episodes_is_rounded(fraction: float, expected: list[int]) -> None:
    assert chosen(episodes([1.0, 0.0, 4.0, 2.0, 3.0]), fraction) == expected


def test_of_equal_returns_the_earlier_counts_as_better() -> None:
    assert chosen(episodes([1.0, 2.0, 2.0, 2.0]), 0.5) == [1, 2]


def test_open_last_episode_has_no_known_return() -> None:
    whole = episodes([1.0, 3.0, 2.0, 90.0])
    cut = {name: getattr(whole, name)[:14] for name in ("observations", "actions", "rewards", "timeouts", "next_observations")}
    data = Transitions.from_arrays(**cut, terminals=np.zeros(14, dtype=bool))
    assert data.info.open_last_episode
    assert chosen(data, 0.34) == [1]
    assert chosen(data, 0.99) == [0, 1, 2]


def test_episode_that_lost_rows_has_no_known_return() -> None:
    whole = episodes([9.0, 1.0, 2.0, 4.0])
    arrays = {n: getattr(whole, n).copy() for n in ("observations", "actions", "rewards", "timeouts", "next_observations")}
    arrays["rewards"][1] = np.nan
    data = Transitions.from_arrays(**arrays, terminals=np.zeros(16, dtype=bool), drop_nonfinite=True)
    assert data.info.episode_numbers.tolist() == [1, 2, 3]
    assert chosen(data, 0.34) == [3]


def test_episode_without_a_usable_row_is_not_chosen() -> None:
    # without next observations an episode of one row that ends by a time limit has none
    ends = np.array([True, False, True, False, True])
    data = Transitions.from_arrays(
        np.arange(25.0).reshape(5, 5), np.zeros((5, 2)), np.array([99.0, 1.0, 1.0, 2.0, 2.0]), np.zeros(5, dtype=bool), ends
    )
    assert data.info.episode_returns.tolist() == [99.0, 2.0, 4.0]
    assert rows_of_best_episodes(data, 0.3).tolist() == [1]
    assert data.episodes[1] == 2


@pytest.mark.filterwarnings("ignore:.*reward is constant")
def test_data_without_whole_episodes_are_refused() -> None:
    whole = episodes([1.0, 2.0])
    arrays = {n: getattr(whole, n) for n in ("observations", "actions", "rewards", "next_observations")}
    nothing = np.zeros(8, dtype=bool)
    data = Transitions.from_arrays(**{n: a[:4] for n, a in arrays.items()}, terminals=nothing[:4], timeouts=nothing[:4])
    with pytest.raises(
        DatasetSemanticsError, match=r"fraction=0.1 chooses whole episodes, and the data have none.*fraction=1"
    ):
        OfflineBC("MlpPolicy", dataset=data, fraction=0.1, policy_kwargs={"net_arch": [4]}).learn(1)
    OfflineBC("MlpPolicy", dataset=data, policy_kwargs={"net_arch": [4]}).learn(1)


def test_replay_buffer_of_its_own_is_refused(spaces_env: SpacesEnv, tmp_path: Path) -> None:
    source = OfflineBC("MlpPolicy", dataset=episodes([1.0, 2.0]), policy_kwargs={"net_arch": [4]}).learn(1)
    source.save_replay_buffer(tmp_path / "buffer.pkl")
    model = OfflineBC("MlpPolicy", env=spaces_env, fraction=0.5, policy_kwargs={"net_arch": [4]})
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    with pytest.raises(ConfigError, match=r"replay buffer does not know where they begin.*from_replay_buffer"):
        model.learn(1)


@pytest.mark.parametrize("fraction", [0.0, -0.1, 1.1, "most"])
def test_wrong_fraction_is_refused(fraction: Any, spaces_env: SpacesEnv) -> None:
    with pytest.raises(ConfigError, match="fraction"):
        OfflineBC("MlpPolicy", env=spaces_env, fraction=fraction)


def test_observations_are_standardised_with_the_chosen_rows() -> None:
    data = episodes([1.0, 5.0, 2.0, 4.0])
    model = OfflineBC("MlpPolicy", dataset=data, fraction=0.25, normalize_obs=True, policy_kwargs={"net_arch": [4]}).learn(1)
    extractor = next(m for m in model.policy.modules() if isinstance(m, StandardizedExtractor))
    assert np.allclose(extractor.mean, data.observations[4:8].mean(axis=0), atol=1e-6)


def test_loaded_model_chooses_the_same_rows_again(tmp_path: Path) -> None:
    data = episodes([1.0, 5.0, 2.0, 4.0])
    data.to_hdf5(tmp_path / "data.hdf5")
    make = {"dataset": tmp_path / "data.hdf5", "fraction": 0.5, "policy_kwargs": {"net_arch": [4]}, "seed": 0, "batch_size": 4}
    model = OfflineBC("MlpPolicy", **make).learn(3)
    model.save(tmp_path / "model")
    loaded = OfflineBC.load(tmp_path / "model").learn(2, reset_num_timesteps=False)
    assert loaded.fraction == 0.5 and loaded.replay_buffer.size() == 8
    straight = OfflineBC("MlpPolicy", **make).learn(5)
    for one, other in zip(straight.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert np.array_equal(one.detach(), other.detach())


@pytest.mark.filterwarnings("ignore:.*next observations are not the next row")
def test_cloning_the_best_episodes_clones_what_they_do() -> None:
    # in episodes of return 1 the action is 0.5 everywhere, in those of return 0 it is -0.5
    returns = [float(n % 2) for n in range(40)]
    data = episodes(returns)
    actions = np.where(data.observations[:, :1] % 2 == 1, 0.5, -0.5).repeat(2, axis=1)
    observations = data.observations.copy()
    observations[:, 0] = 0.0  # the observation does not tell which episode it is from
    data = Transitions.from_arrays(
        observations, actions, data.rewards, data.terminals.astype(bool), data.timeouts, observations[::-1].copy()
    )
    predicted = {}
    for fraction in (0.5, 1.0):
        model = OfflineBC(
            "MlpPolicy", dataset=data, fraction=fraction, learning_rate=1e-2, policy_kwargs={"net_arch": [8]}, seed=0
        )
        predicted[fraction] = model.learn(300).predict(observations[:8], deterministic=True)[0]
    assert np.allclose(predicted[0.5], 0.5, atol=0.05)
    assert predicted[1.0].mean() < 0.3
