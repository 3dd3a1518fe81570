"""What users of Stable-Baselines3 naturally try next, where an answer must be right or in words; DCE stands for all agents."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback, LogEveryNTimesteps
from stable_baselines3.common.logger import configure
from stable_baselines3.common.save_util import save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.sac.policies import SACPolicy

from sb3_dce import OfflineBC, OfflineDCE, OfflineIQL, OfflineSAC, OfflineTD3BC, Transitions, load_dataset, run_files
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import (
    ConfigError,
    DatasetError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetNotFoundError,
    DatasetWarning,
)
from sb3_dce.evaluation import EvaluationCallback
from sb3_dce.networks import StandardizedExtractor
from sb3_dce.rollouts import Rollouts

SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "execution": "eager"}
TINY = "halfcheetah-tiny-sb3"


def flat(model: OfflineDCE) -> th.Tensor:
    return th.cat([p.detach().flatten() for p in model.policy.parameters()])


def arrays(n: int = 60, scale: float = 1.0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "observations": rng.standard_normal((n, 3)),
        "actions": scale * rng.uniform(-1, 1, (n, 1)),
        "rewards": rng.standard_normal(n),
        "terminals": np.zeros(n, dtype=bool),
        "timeouts": np.arange(n) % 20 == 19,
    }


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """A log with two columns that could be the reward."""
    data = arrays()
    frame = pd.DataFrame(data["observations"], columns=["obs_0", "obs_1", "obs_2"])
    frame = frame.assign(action_0=data["actions"][:, 0], reward=data["rewards"], good_reward=data["rewards"] + 1.0)
    frame.assign(terminal=0, timeout=data["timeouts"].astype(int)).to_csv(tmp_path / "log.csv", index=False)
    return tmp_path / "log.csv"


@pytest.fixture
def sac(make_point_mass: Callable[[], gym.Env]) -> SAC:
    return SAC("MlpPolicy", make_point_mass(), learning_starts=1000, policy_kwargs={"net_arch": [8]}, seed=0).learn(60)


# -- data that were read before ------------------------------------------------------------------------------------------


def test_data_that_were_read_before_bring_row_and_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = load_dataset(arrays_of_hopper())
    data.to_hdf5(tmp_path / "hopper-medium-expert-sb3.hdf5")
    monkeypatch.setenv("SB3_DCE_DATASETS", str(tmp_path))
    by_name = OfflineDCE.load_dataset("hopper-medium-expert-sb3", device="cpu")
    by_data = OfflineDCE.load_dataset(load_dataset("hopper-medium-expert-sb3"), device="cpu")
    default = OfflineDCE.load_dataset(data, device="cpu")
    rows = [{**model.hyperparameters(), "dataset": None} for model in (by_name, by_data, default)]
    assert rows[0] == rows[1] != rows[2]
    environments = [type(model.get_env().envs[0].unwrapped) for model in (by_name, by_data, default)]
    assert environments[0] is environments[1] is not environments[2]
    # a file that has gone since, or a reader that was not told, is no obstacle
    read = load_dataset("hopper-medium-expert-sb3")
    (tmp_path / "hopper-medium-expert-sb3.hdf5").rename(tmp_path / "moved.hdf5")
    assert OfflineDCE.load_dataset(read, device="cpu").beta == by_name.beta
    (tmp_path / "moved.hdf5").rename(tmp_path / "hopper-medium-expert-sb3.hdf5")
    load_dataset(arrays()).to_hdf5(tmp_path / "hopper-medium-sb3.hdf5")
    other = Transitions.from_hdf5(tmp_path / "hopper-medium-sb3.hdf5")
    assert OfflineDCE.load_dataset(other, device="cpu", **SMALL).learn(1).observation_space.shape == (3,)
    # with other bounds of the actions it is another task
    wide = load_dataset("hopper-medium-expert-sb3", action_scale=2.0)
    assert {**OfflineDCE.load_dataset(wide, device="cpu").hyperparameters(), "dataset": None} == rows[2]


def arrays_of_hopper() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        **arrays(),
        "observations": rng.standard_normal((60, 11)),
        "actions": rng.uniform(-1, 1, (60, 3)),
        "next_observations": rng.standard_normal((60, 11)),
    }


@pytest.mark.parametrize("cls", [OfflineTD3BC, OfflineIQL])
def test_trained_model_keeps_what_it_was_trained_with_on_other_data(cls: Any, tmp_path: Path) -> None:
    first, second = arrays(), arrays()
    second["observations"] = 5.0 + 3.0 * second["observations"]
    second["rewards"] = 10.0 * second["rewards"]
    more = {"reward_normalization": "iql"} if cls is OfflineIQL else {}
    model = cls.load_dataset(load_dataset(first), seed=0, **SMALL, **more).learn(2)

    def kept() -> tuple[list[float], float]:
        extractor = next(m for m in model.policy.modules() if isinstance(m, StandardizedExtractor))
        return extractor.mean.tolist(), model._reward_factor()

    before = kept() if cls is OfflineTD3BC else ([], model._reward_factor())
    model.set_dataset(load_dataset(second))
    model.save(tmp_path / "model.zip")
    for changed in (model, cls.load(tmp_path / "model.zip", dataset=load_dataset(second))):
        model = changed.learn(2, reset_num_timesteps=False)
        assert model.replay_buffer.rewards.max() > 9.0
        assert (kept() if cls is OfflineTD3BC else ([], model._reward_factor())) == before
    fresh = cls.load_dataset(load_dataset(first), seed=0, **SMALL, **more)
    fresh.set_dataset(load_dataset(second))
    model = fresh.learn(1)
    assert (kept() if cls is OfflineTD3BC else ([], model._reward_factor())) != before, "it has learned nothing yet"


def test_buffer_with_other_rows_is_noticed(tmp_path: Path) -> None:
    other, same = arrays(), load_dataset(arrays())
    other["rewards"] = other["rewards"] - 7.0
    OfflineDCE.load_dataset(load_dataset(other), seed=0, **SMALL).learn(1).save_replay_buffer(tmp_path / "other.pkl")
    same.to_hdf5(tmp_path / "data.hdf5")
    model = OfflineDCE.load_dataset(tmp_path / "data.hdf5", seed=0, **SMALL).learn(2)
    model.save_replay_buffer(tmp_path / "same.pkl")
    model.save(tmp_path / "model.zip")
    loaded = OfflineDCE.load(tmp_path / "model.zip")
    loaded.load_replay_buffer(tmp_path / "same.pkl")
    loaded.learn(1, reset_num_timesteps=False)  # the rows it knows: no word
    loaded = OfflineDCE.load(tmp_path / "model.zip")
    loaded.load_replay_buffer(tmp_path / "other.pkl")
    with pytest.warns(DatasetWarning, match=r"57 rows of the replay buffer; .*data\.hdf5 is not read"):
        loaded.learn(1, reset_num_timesteps=False)
    assert loaded.dataset_statistics["reward_mean"] < -6.0
    loaded.save(tmp_path / "later.zip")
    with pytest.raises(DatasetIntegrityError, match="not the rows the model was trained on"):
        OfflineDCE.load(tmp_path / "later.zip").learn(1)
    # a model that has not read its dataset yet, with a buffer of the same rows, goes on with either
    fresh = OfflineDCE.load_dataset(tmp_path / "data.hdf5", seed=0, **SMALL)
    fresh.load_replay_buffer(tmp_path / "same.pkl")
    with pytest.warns(DatasetWarning, match="of the replay buffer"):
        fresh.learn(1)
    fresh.save(tmp_path / "fresh.zip")
    OfflineDCE.load(tmp_path / "fresh.zip").learn(1)


def test_refused_data_leave_the_model_as_it_was(tmp_path: Path) -> None:
    load_dataset(arrays()).to_hdf5(tmp_path / "data.hdf5")
    model = OfflineDCE.load_dataset(tmp_path / "data.hdf5", seed=0, d4rl_compat=True, **SMALL)
    for wrong, error in (("halfchetah-medium", DatasetError), (load_dataset(arrays()), ConfigError)):
        with pytest.raises(error):
            model.set_dataset(wrong)
        assert model.dataset == str(tmp_path / "data.hdf5")
    assert model.learn(1).dataset_statistics["rows"] == 54, "the refused ones have 57"


def test_buffer_of_another_model_is_refused(tmp_path: Path) -> None:
    def model(n_actions: int, scale: float = 1.0) -> OfflineDCE:
        own = {**arrays(), "actions": np.random.default_rng(0).uniform(-1, 1, (60, n_actions))}
        return OfflineDCE.load_dataset(load_dataset(own, action_scale=scale), seed=0, **SMALL)

    model(2).save_replay_buffer(tmp_path / "buffer.pkl")
    for other, message in (
        (model(3), "actions of width 2, the model wants 3 and 3"),
        (model(2, 2.0), "the model's are from -2 to 2"),
    ):
        with pytest.raises(DatasetError, match=message):
            other.load_replay_buffer(tmp_path / "buffer.pkl")
        assert other.learn(1).replay_buffer.size() == 57, "its own data are still there"


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (spaces.Box(-2.0, 2.0, (1,)), "the buffer's actions were scaled from -2 to 2, the model's are from -1 to 1"),
        (spaces.Box(-1.0, 1.0, (2,)), "actions of width 2, the model wants 3 and 1"),
        (spaces.Discrete(3), "no agent for such actions"),
        (None, "cannot be loaded as a replay buffer .*must inherit.*save_replay_buffer"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_buffer_of_another_algorithm_that_does_not_fit_is_refused(
    actions: spaces.Space | None, message: str, tmp_path: Path
) -> None:
    saved: Any = {"observations": 0}
    if actions is not None:
        saved = ReplayBuffer(10, spaces.Box(-1.0, 1.0, (3,)), actions, device="cpu")
        for _ in range(10):
            saved.add(np.ones(3), np.ones(3), np.zeros(saved.action_dim), np.ones(1), np.zeros(1), [{}])
    save_to_pkl(tmp_path / "buffer.pkl", saved)
    model = OfflineDCE.load_dataset(load_dataset(arrays()), seed=0, **SMALL)
    with pytest.raises(DatasetError, match=message):
        model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.learn(1).replay_buffer.size() == 57, "its own data are still there"


def test_file_of_a_buffer_that_is_missing_or_damaged_is_said_in_words(tmp_path: Path) -> None:
    model = OfflineDCE.load_dataset(load_dataset(arrays()), seed=0, **SMALL)
    with pytest.raises(DatasetNotFoundError, match="no such file"):
        model.load_replay_buffer(tmp_path / "buffer.pkl")
    (tmp_path / "buffer.pkl").write_bytes(b"no pickle")
    with pytest.raises(DatasetFormatError, match="cannot be loaded as a replay buffer"):
        model.load_replay_buffer(tmp_path / "buffer.pkl")


def test_data_whose_attaching_fails_are_attached_anew() -> None:
    data = load_dataset(arrays())
    model = OfflineTD3BC.load_dataset(data, seed=0, **SMALL | {"batch_size": 100})
    with warnings.catch_warnings(), pytest.raises(DatasetWarning, match="draws rows more than once"):
        warnings.simplefilter("error", DatasetWarning)
        model.learn(1)
    with pytest.warns(DatasetWarning, match="draws rows more than once"):
        model.learn(1)
    extractor = next(m for m in model.policy.modules() if isinstance(m, StandardizedExtractor))
    assert np.allclose(extractor.mean, data.observations.mean(axis=0), atol=1e-6)


def test_empty_buffer_changes_nothing(tmp_path: Path) -> None:
    load_dataset(arrays()).to_hdf5(tmp_path / "data.hdf5")
    trained = OfflineDCE.load_dataset(tmp_path / "data.hdf5", **SMALL).learn(1)
    model = OfflineDCE("MlpPolicy", trained.get_env(), **SMALL)
    model.save_replay_buffer(tmp_path / "empty.pkl")
    trained.load_replay_buffer(tmp_path / "empty.pkl")
    assert trained.learn(1).replay_buffer.size() == 57
    model.load_replay_buffer(tmp_path / "empty.pkl")
    with pytest.raises(ConfigError, match="nothing to learn from"):
        model.learn(1)


def test_buffer_of_data_in_memory_is_saved_before_the_first_update(tmp_path: Path) -> None:
    model = OfflineDCE.load_dataset(load_dataset(arrays()), **SMALL)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    other = OfflineDCE("MlpPolicy", model.get_env(), **SMALL)
    other.load_replay_buffer(tmp_path / "buffer.pkl")
    assert other.learn(1).replay_buffer.size() == 57


def test_data_that_have_moved_are_said_to_have(tmp_path: Path) -> None:
    load_dataset(arrays()).to_hdf5(tmp_path / "data.hdf5")
    OfflineDCE.load_dataset(tmp_path / "data.hdf5", **SMALL).learn(1).save(tmp_path / "model.zip")
    (tmp_path / "data.hdf5").rename(tmp_path / "moved.hdf5")
    with pytest.raises(DatasetNotFoundError, match=r"no such file.*set_dataset\(<new path>\)"):
        OfflineDCE.load(tmp_path / "model.zip").learn(1)
    OfflineDCE.load(tmp_path / "model.zip", dataset=tmp_path / "moved.hdf5").learn(1)


# -- going on ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options", [{"columns": {"rewards": "good_reward"}}, {"columns": {"observations": ["obs_1", "obs_0", "obs_2"]}}], ids=str
)
def test_loaded_model_does_not_go_on_with_other_rows_of_its_file(options: dict[str, Any], table: Path, tmp_path: Path) -> None:
    data = load_dataset(table, **options)
    model = OfflineDCE.load_dataset(data, seed=0, **SMALL).learn(3)
    model.save(tmp_path / "model.zip")
    loaded = OfflineDCE.load(tmp_path / "model.zip")
    with pytest.raises(DatasetIntegrityError, match=r"not the rows the model was trained on.*set_dataset\("):
        loaded.learn(3, reset_num_timesteps=False)
    loaded.set_dataset(load_dataset(table, **options))
    loaded.learn(3, reset_num_timesteps=False)
    assert th.equal(flat(loaded), flat(model.learn(3, reset_num_timesteps=False)))


def test_set_dataset_takes_other_data_on_purpose(table: Path) -> None:
    model = OfflineDCE.load_dataset(table, **SMALL).learn(2)
    model.set_dataset(load_dataset(table, columns={"rewards": "good_reward"}))
    before = model.learn(2).dataset_statistics
    assert before is not None and before["reward_mean"] == pytest.approx(arrays()["rewards"][:].mean() + 1.0, abs=0.1)


def test_seed_given_at_load_counts(tmp_path: Path) -> None:
    OfflineDCE.load_dataset(TINY, seed=0, **SMALL).learn(2).save(tmp_path / "model.zip")
    trained = [OfflineDCE.load(tmp_path / "model.zip", seed=seed).learn(3) for seed in (1, 2, 1)]
    assert not th.equal(flat(trained[0]), flat(trained[1])) and th.equal(flat(trained[0]), flat(trained[2]))


def test_dataset_given_at_load_counts(table: Path, tmp_path: Path) -> None:
    model = OfflineDCE.load_dataset(table, **SMALL).learn(2)
    model.save(tmp_path / "model.zip")
    data = load_dataset(table, columns={"rewards": "good_reward"})
    loaded = OfflineDCE.load(tmp_path / "model.zip", dataset=data).learn(2)
    assert np.allclose(loaded.replay_buffer.rewards[:, 0], data.rewards)


def test_rows_asked_for_at_load_are_trained_on(tmp_path: Path) -> None:
    OfflineBC.load_dataset(TINY, **SMALL).learn(2).save(tmp_path / "model.zip")
    loaded = OfflineBC.load(tmp_path / "model.zip", fraction=0.5).learn(1)
    assert 0 < loaded.replay_buffer.size() < 4000


def test_saved_seed_at_load_goes_on(tmp_path: Path) -> None:
    model = OfflineDCE.load_dataset(TINY, seed=3, **SMALL).learn(2)
    model.save(tmp_path / "model.zip")
    straight = model.learn(2, reset_num_timesteps=False)
    loaded = OfflineDCE.load(tmp_path / "model.zip", seed=3).learn(2, reset_num_timesteps=False)
    assert th.equal(flat(straight), flat(loaded))


def test_model_goes_on_with_the_statistics_it_was_trained_with(
    make_point_mass: Callable[[], gym.Env], transitions: Transitions, tmp_path: Path
) -> None:
    def wrapped(**settings: Any) -> VecNormalize:
        return VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False, **settings)

    env = wrapped()
    model = OfflineDCE("MlpPolicy", env, dataset=transitions, **SMALL).learn(2)
    mean = env.obs_rms.mean.copy()
    assert env.obs_rms.count < 2000, "few enough to be taken for a reset"
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)
        model.learn(2)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))
    loaded = OfflineDCE.load(tmp_path / "model.zip", env=VecNormalize.load(str(tmp_path / "statistics.pkl"), wrapped().venv))
    other = Transitions.from_arrays(
        transitions.observations + 1.0, transitions.actions, transitions.rewards, transitions.terminals, transitions.timeouts
    )
    loaded.set_dataset(other)
    loaded.learn(2)
    assert np.array_equal(loaded.get_vec_normalize_env().obs_rms.mean, mean)
    looked = wrapped()
    looked.reset()
    for fresh in (wrapped(), wrapped(norm_obs=False), looked):
        wrong = OfflineDCE.load(tmp_path / "model.zip", env=fresh)
        wrong.set_dataset(transitions)
        with pytest.raises(ConfigError, match="whose statistics are not here"):
            wrong.learn(1)


# -- what counts as data -----------------------------------------------------------------------------------------------


def test_agents_take_what_the_front_door_takes(sac: SAC, spaces_env: SpacesEnv) -> None:
    frame = pd.DataFrame({"obs_0": [0.1, 0.2, 0.3], "action_0": [0.0, 0.5, -0.5], "reward": 1.0, "terminal": [0, 0, 1]})
    for source, rows in ((arrays(), 57), (frame, 3), (sac.replay_buffer, 60)):
        assert OfflineDCE.load_dataset(source, **SMALL).learn(1).replay_buffer.size() == rows
    model = OfflineDCE("MlpPolicy", spaces_env, dataset=sac.replay_buffer, **SMALL)
    assert model.learn(1).replay_buffer.size() == 60
    model.set_dataset(sac.replay_buffer)
    assert model.learn(1).replay_buffer.size() == 60
    with pytest.raises(ConfigError, match=r"a dataset cannot be made of float.*Give an id, a file"):
        model.set_dataset(3.5)  # type: ignore[arg-type]


def test_saved_buffer_of_another_algorithm_can_be_loaded(sac: SAC, spaces_env: SpacesEnv, tmp_path: Path) -> None:
    sac.save_replay_buffer(tmp_path / "buffer.pkl")
    model = OfflineDCE("MlpPolicy", spaces_env, **SMALL)
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    model.learn(2)
    assert np.allclose(model.replay_buffer.rewards, sac.replay_buffer.rewards[:60])
    model.replay_buffer = sac.replay_buffer
    with pytest.raises(ConfigError, match=r"is a ReplayBuffer, .*set_dataset"):
        model.learn(2)
    model.set_dataset(load_dataset(sac.replay_buffer))
    assert model.learn(2).replay_buffer.size() == 60, "the remedy works"


def test_buffer_saved_by_an_earlier_version(tmp_path: Path) -> None:
    source = OfflineDCE.load_dataset(TINY, **SMALL).learn(1)
    vars(source.replay_buffer).pop("n_added", None)
    source.save_replay_buffer(tmp_path / "buffer.pkl")
    model = OfflineDCE.load_dataset(TINY, **SMALL)
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    assert model.learn(1).replay_buffer.size() == source.replay_buffer.size()


def test_rows_that_are_added_are_said_to_replace_the_dataset() -> None:
    model = OfflineDCE.load_dataset(TINY, **SMALL)
    zeros = np.zeros((1, 17))
    for _ in range(20):
        model.replay_buffer.add(zeros, zeros, np.zeros((1, 6)), np.zeros(1), np.array([0.0]), [{}])
    with pytest.warns(DatasetWarning, match=f"20 rows that were added .*{TINY} is not read"):
        model.learn(1)


def test_npz_keeps_the_bounds_of_actions(tmp_path: Path) -> None:
    data = load_dataset(arrays(scale=2.0), action_low=-2, action_high=[3.0])
    data.to_npz(tmp_path / "data.npz")
    info = load_dataset(tmp_path / "data.npz").info
    assert info.action_space_low.tolist() == [-2.0] and info.action_space_high.tolist() == [3.0]
    assert load_dataset(tmp_path / "data.npz", action_scale=4.0).info.action_space_high.tolist() == [4.0]
    plain = load_dataset(arrays())
    plain.to_npz(tmp_path / "plain.npz")
    assert load_dataset(tmp_path / "plain.npz").info.action_space_high.tolist() == [1.0]


def test_empty_cell_is_nan_if_such_rows_are_dropped(table: Path) -> None:
    frame = pd.read_csv(table)
    frame.loc[7, "obs_1"] = np.nan
    frame.to_csv(table, index=False)
    whole = load_dataset(frame, drop_nonfinite=True)
    read = load_dataset(table, drop_nonfinite=True)
    assert np.array_equal(read.rows, whole.rows) and len(read) == 55
    with pytest.raises(Exception, match=r"empty cell.*drop_nonfinite=True"):
        load_dataset(table)
    frame["terminal"] = frame["terminal"].astype(object)
    frame.loc[9, "terminal"] = ""
    frame.to_csv(table, index=False)
    with pytest.raises(Exception, match=r"line 11, column 'terminal': empty cell. Fill it in$"):
        load_dataset(table, drop_nonfinite=True)


def test_repr_of_transitions_is_a_line() -> None:
    text = repr(load_dataset(arrays()))
    assert text == "<Transitions: dataset arrays: 57 transitions from 60 rows, 3 whole episodes>"


# -- own classes and messages ------------------------------------------------------------------------------------------


class Extended(OfflineDCE):
    """A user's agent: one more parameter, all others passed on, no hyperparameter file of its own."""

    algo_name = "extended"

    def __init__(self, *args: Any, weight: float = 1.0, sharp: bool = False, **kwargs: Any) -> None:
        self.weight, self.sharp = weight, sharp
        super().__init__(*args, **kwargs)


def test_subclass_that_passes_its_arguments_on(tmp_path: Path) -> None:
    model = Extended.load_dataset(TINY, weight=2.0, beta=3.0, beta_final=None, beta_rate=0.0, **SMALL).learn(2)
    assert model.hyperparameters()["weight"] == 2.0 and model.hyperparameters()["beta"] == 3.0
    model.save(tmp_path / "model.zip")
    assert Extended.load(tmp_path / "model.zip", beta=2.0).beta == 2.0
    with pytest.raises(ConfigError, match=r"no parameter 'wait'. Did you mean 'weight'"):
        Extended.load_dataset(TINY, wait=1.0)
    with pytest.raises(ConfigError, match="sharp must be True or False"):
        Extended.load_dataset(TINY, sharp="no", **SMALL)


def test_constructor_that_is_a_partial_method() -> None:
    class Fixed(OfflineDCE):
        __init__ = functools.partialmethod(OfflineDCE.__init__, policy_update_freq=2)  # type: ignore[assignment]

    assert Fixed.load_dataset(TINY, tau=0.01, **SMALL).learn(1).policy_update_freq == 2


def test_messages_lead_somewhere(make_point_mass: Callable[[], gym.Env]) -> None:
    with pytest.raises(ConfigError, match=r"belongs to the reader.*load_dataset\(<file>, action_scale="):
        OfflineDCE.load_dataset(TINY, action_scale=2.0)
    with pytest.raises(ConfigError, match="actions of width 6, the model's environment of 2"):
        OfflineDCE.load_dataset(TINY, env=make_point_mass(), **SMALL).learn(1)
    with pytest.raises(ConfigError, match=r"SACPolicy does not take .*use_v.*sb3_dce.policies"):
        OfflineDCE(SACPolicy, dataset=TINY)
    OfflineSAC(SACPolicy, dataset=TINY, **SMALL).learn(1)


# -- logs --------------------------------------------------------------------------------------------------------------


def rows_of(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "progress.csv")


def test_diagnostics_are_in_rows_that_a_callback_asks_for(transitions: Transitions, tmp_path: Path) -> None:
    model = OfflineDCE("MlpPolicy", dataset=transitions, **SMALL)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(10, LogEveryNTimesteps(5), log_interval=None)
    rows = rows_of(tmp_path)
    assert rows["time/total_timesteps"].tolist() == [5, 10] and rows["train/q_data"].notna().all()


def test_an_evaluation_at_the_interval_of_the_log_makes_one_row(
    transitions: Transitions, make_point_mass: Callable[[], gym.Env], tmp_path: Path
) -> None:
    model = OfflineDCE("MlpPolicy", make_point_mass(), dataset=transitions, **SMALL)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    evaluation = EvalCallback(make_point_mass(), eval_freq=5, n_eval_episodes=1, verbose=0, warn=False)
    model.learn(10, evaluation, log_interval=5)
    rows = rows_of(tmp_path)
    assert rows["time/total_timesteps"].tolist() == [5, 10]
    assert rows[["train/q_data", "eval/mean_reward", "time/fps"]].notna().all(axis=None)
    own = OfflineDCE("MlpPolicy", dataset=transitions, **SMALL)
    own.set_logger(configure(str(tmp_path / "own"), ["csv"]))
    own.learn(10, EvaluationCallback(Rollouts(make_point_mass, 1), None, eval_freq=5), log_interval=5)
    rows = rows_of(tmp_path / "own")
    assert rows["time/total_timesteps"].tolist() == [5, 10]
    assert rows[["train/q_data", "eval/mean_reward", "time/fps"]].notna().all(axis=None)


# -- environments by their ids -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["HalfCheetah-v2", "no_such_module:Env-v0", "Nowhere-v0"])
def test_environment_that_cannot_be_made_is_said(name: str, spaces_env: SpacesEnv) -> None:
    with pytest.raises(ConfigError, match=f"no environment '{name}'.*Give an id that gymnasium.make knows"):
        OfflineDCE("MlpPolicy", name, dataset=TINY, **SMALL)
    with pytest.raises(ConfigError, match=f"no environment '{name}'"):
        OfflineDCE("MlpPolicy", spaces_env, **SMALL).set_env(name)


def test_environment_may_be_set_by_its_id(tmp_path: Path) -> None:
    model = OfflineDCE.load_dataset(TINY, **SMALL)
    model.set_env("HalfCheetah-v4")
    model.save(tmp_path / "model.zip")
    assert OfflineDCE.load(tmp_path / "model.zip", env="HalfCheetah-v4").get_env() is not None


def test_several_environments_are_refused(make_point_mass: Callable[[], gym.Env]) -> None:
    with pytest.raises(ConfigError, match=r"wants one environment, got 2 in one\. Give one"):
        OfflineDCE("MlpPolicy", DummyVecEnv([make_point_mass] * 2), **SMALL)


def test_run_without_the_metadata_of_mujoco_says_its_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        if name == "mujoco":
            raise PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(run_files, "version", absent)
    assert run_files._installed("numpy", "mujoco") == {"numpy": "1.0"}
