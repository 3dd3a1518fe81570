"""Minari datasets: the steps that minari recorded, every way in which they can be broken, and the way to a trained agent."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
from commands import sb3_dce
from gymnasium import spaces
from minari_files import Hub, Steps, box, episode, record, write_dataset

from sb3_dce import OfflineDCE, cli
from sb3_dce.data import Transitions, find_file, load_transitions, normalized_score
from sb3_dce.data.hashes import data_sha256, file_sha256, sha256_once
from sb3_dce.data.locate import catalogue_id, is_path, known_dataset, short_name
from sb3_dce.data.minari_download import download_minari
from sb3_dce.envs import SpacesEnv, make_minari_env, own_env, without_bookkeeping
from sb3_dce.errors import (
    ConfigError,
    DatasetError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetNotFoundError,
    DatasetSecurityError,
    DownloadError,
)

TINY = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 16, "device": "cpu"}


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty root of Minari."""
    folder = tmp_path / "minari"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    return folder


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Steps]]:
    """Three episodes of 20 steps of Pendulum recorded by minari: its root, and the steps."""
    folder = tmp_path_factory.mktemp("recorded")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        yield folder, record(gym.make("Pendulum-v1", max_episode_steps=20), "test/pendulum/random-v0", 3)


class GoalPendulum(gym.ObservationWrapper):
    """Pendulum with an observation of three parts: a vector, a vector, and a number without dimension."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.observation_space = spaces.Dict(
            {
                "observation": spaces.Box(-8.0, 8.0, (3,), np.float32),
                "desired_goal": spaces.Box(-1.0, 1.0, (2,), np.float64),
                "speed": spaces.Box(-8.0, 8.0, (), np.float32),
            }
        )

    def observation(self, observation: np.ndarray) -> dict[str, Any]:
        goal = np.array([1.0, 0.0])
        return {"observation": observation, "desired_goal": goal, "speed": np.array(observation[2], dtype=np.float32)}


def assert_equal_to_steps(transitions: Transitions, steps: Steps) -> None:
    obs, actions, rewards, terminated, truncated, following = zip(*steps, strict=True)
    expected = {
        "observations": np.stack(obs),
        "actions": np.stack(actions),
        "rewards": np.array(rewards),
        "terminals": np.array(terminated),
        "next_observations": np.stack(following),
    }
    for key, array in expected.items():
        np.testing.assert_array_equal(getattr(transitions, key), array.astype(np.float32), err_msg=key)
    np.testing.assert_array_equal(transitions.timeouts, np.array(truncated) & ~np.array(terminated))
    assert transitions.info.dropped_rows == 0


def dataset(root: Path, *episodes: Any, **metadata: Any) -> Path:
    return write_dataset(root / "own/set-v0", {f"episode_{i}": e for i, e in enumerate(episodes)}, **metadata)


def with_dict(**parts: Any) -> dict[str, Any]:
    return {**episode(3), "observations": parts}


# -- what minari records -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("data_format", ["hdf5", "arrow", "parquet"])
def test_transitions_equal_the_steps_recorded_beside(root: Path, data_format: str) -> None:
    if data_format != "hdf5":
        pytest.importorskip("pyarrow")
    # random pushes let the pendulum fall at different times; the time limit ends the others
    env = gym.make("InvertedPendulum-v5", max_episode_steps=6)
    steps = record(env, "test/inverted-v0", 12, data_format=data_format)
    transitions = load_transitions("minari:test/inverted-v0")
    assert_equal_to_steps(transitions, steps)
    assert transitions.info.episodes == 12 and 0 < transitions.info.n_terminals < 12
    assert transitions.info.n_timeouts == 12 - transitions.info.n_terminals
    np.testing.assert_array_equal(transitions.info.action_space_high, np.float32([3.0]))


def test_an_interrupted_recording_loses_no_step(root: Path) -> None:
    steps = record(gym.make("Pendulum-v1", max_episode_steps=20), "pendulum-v0", 3, steps=50)
    transitions = Transitions.from_minari("pendulum-v0")
    assert len(transitions) == 50
    np.testing.assert_array_equal(transitions.next_observations, np.stack([step[5] for step in steps]))


@pytest.mark.parametrize("data_format", ["hdf5", "arrow"])
def test_parts_of_an_observation_are_joined_as_gymnasium_does_or_as_asked(root: Path, data_format: str) -> None:
    pytest.importorskip("pyarrow")
    env = GoalPendulum(gym.make("Pendulum-v1", max_episode_steps=10))
    steps = record(env, "goal/pendulum-v0", 2, data_format=data_format)
    with pytest.raises(DatasetFormatError, match=r"observation Box \(3,\).*flatten=True.*flatten=\[") as caught:
        load_transitions("minari:goal/pendulum-v0")
    assert "desired_goal Box (2,)" in str(caught.value)
    joined = load_transitions("minari:goal/pendulum-v0", flatten=True)
    flat = np.stack([spaces.flatten(env.observation_space, step[0]) for step in steps]).astype(np.float32)
    np.testing.assert_array_equal(joined.observations, flat)
    some = Transitions.from_minari("goal/pendulum-v0", flatten=["observation", "desired_goal"])
    expected = [np.concatenate([step[5]["observation"], step[5]["desired_goal"]]) for step in steps]
    np.testing.assert_array_equal(some.next_observations, np.stack(expected).astype(np.float32))
    assert "the observation is observation (3) | desired_goal (2)" in some.info.notes


def test_agent_trains_on_a_dataset_by_its_name(
    pendulum: tuple[Path, Steps], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(pendulum[0]))
    model = OfflineDCE.load_dataset("minari:test/pendulum/random-v0", seed=0, **TINY)
    assert model.env is not None and model.env.envs[0].spec.id == "Pendulum-v1"  # type: ignore[attr-defined]
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(10)
    assert any((value != before[name]).any() for name, value in model.policy.state_dict().items())
    assert model.replay_buffer is not None and model.replay_buffer.size() == 60
    model.save(tmp_path / "model")
    loaded = OfflineDCE.load(tmp_path / "model")
    assert loaded.dataset == "minari:test/pendulum/random-v0"
    loaded.learn(3)
    action, _ = loaded.predict(np.zeros(3, dtype=np.float32))
    assert action.shape == (1,) and abs(float(action[0])) <= 2.0


def test_agent_of_transitions_reads_them_again_from_their_folder(pendulum: tuple[Path, Steps], tmp_path: Path) -> None:
    model = OfflineDCE.load_dataset(load_transitions(pendulum[0] / "test/pendulum/random-v0"), **TINY)
    model.save(tmp_path / "model")
    loaded = OfflineDCE.load(tmp_path / "model")
    loaded.learn(2)
    assert loaded.replay_buffer is not None and loaded.replay_buffer.size() == 60


# -- the rules -----------------------------------------------------------------------------------------------------


def test_next_observations_and_flags_by_hand(root: Path) -> None:
    only = {
        "observations": np.arange(4.0).reshape(4, 1),
        "actions": np.zeros((3, 1)),
        "rewards": np.arange(3.0),
        "terminations": np.array([False, False, False]),
        "truncations": np.array([False, False, True]),
    }
    transitions = Transitions.from_minari(dataset(root, only, observation_space=None, action_space=None))
    np.testing.assert_array_equal(transitions.observations[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(transitions.next_observations[:, 0], [1, 2, 3])
    np.testing.assert_array_equal(transitions.terminals, [0, 0, 0])
    np.testing.assert_array_equal(transitions.timeouts, [False, False, True])


def test_episodes_are_in_the_order_of_their_numbers(root: Path) -> None:
    transitions = Transitions.from_minari(dataset(root, *(episode(2, first=100.0 * i) for i in range(12))))
    np.testing.assert_array_equal(transitions.observations[::2, 0], 100.0 * np.arange(12))


def test_flags_of_all_kinds(root: Path) -> None:
    both, inside = episode(3), episode(3)
    both["terminations"][-1] = True
    inside["truncations"][0] = True
    made = Transitions.from_minari(
        dataset(root, both, episode(3, end=""), inside, episode(3, end="terminations"), episode(2, end=""))
    )
    np.testing.assert_array_equal(made.terminals, [0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(np.flatnonzero(made.timeouts), [5, 6, 8])
    assert len(made) == 14 and made.info.open_last_episode and made.info.episodes == 5
    notes = " ".join(made.info.notes)
    assert "1 steps terminate and are truncated" in notes
    assert "1 episodes end without a flag" in notes
    assert "1 steps within an episode" in notes


def test_d4rl_compat_drops_what_d4rl_drops(root: Path) -> None:
    both = episode(3, end="terminations")
    both["truncations"][-1] = True  # a terminal, which D4RL keeps
    path = dataset(root, episode(3), both, episode(3))
    assert len(load_transitions(path, d4rl_compat=True)) == 9 - 2 and len(load_transitions(path)) == 9


def test_bounds_of_actions_are_those_of_the_action_space(root: Path) -> None:
    wide = {**episode(3), "actions": np.array([[-2.0], [0.0], [2.0]])}
    path = dataset(root, wide, action_space=json.dumps(box(1, 2.0)))
    made = Transitions.from_minari(path)
    np.testing.assert_array_equal(made.actions[:, 0], [-2, 0, 2])
    np.testing.assert_array_equal([made.info.action_space_low, made.info.action_space_high], [[-2], [2]])
    given = Transitions.from_minari(path, action_low=-4, action_high=4)
    np.testing.assert_array_equal(given.info.action_space_high, [4])
    np.testing.assert_array_equal(Transitions.from_minari(path, action_scale=3.0).info.action_space_high, [3])


def test_infinite_bounds_of_actions_are_no_bounds(root: Path) -> None:
    path = dataset(root, episode(3), action_space=json.dumps({**box(1), "high": [float("inf")]}))
    np.testing.assert_array_equal(Transitions.from_minari(path).info.action_space_high, [1])


def test_nested_dictionaries_and_tuples_have_keys(root: Path) -> None:
    inner = {"type": "Dict", "subspaces": {"b": box(1), "a": box(2)}}
    space = {"type": "Tuple", "subspaces": [box(1), inner]}
    a, b, first = np.ones((4, 2)), np.full((4, 1), 2.0), np.full((4, 1), 3.0)
    path = dataset(root, with_dict(_index_0=first, _index_1={"a": a, "b": b}), observation_space=json.dumps(space))
    np.testing.assert_array_equal(Transitions.from_minari(path, flatten=True).observations[0], [3, 2, 1, 1])
    np.testing.assert_array_equal(Transitions.from_minari(path, flatten=["1/a", "0"]).observations[0], [1, 1, 3])
    np.testing.assert_array_equal(Transitions.from_minari(path, flatten="1").observations[0], [2, 1, 1])


@pytest.mark.parametrize("keys", [["nothing"], [], ["a", "a"], ["a", "nothing"]])
def test_keys_that_do_not_fit_are_refused(root: Path, keys: list[str]) -> None:
    space = json.dumps({"type": "Dict", "subspaces": {"a": box(1), "b": box(1)}})
    path = dataset(root, with_dict(a=np.zeros((4, 1)), b=np.zeros((4, 1))), observation_space=space)
    with pytest.raises(ConfigError, match="Keys are a, b"):
        Transitions.from_minari(path, flatten=keys)


def test_keys_of_one_array_are_refused(root: Path) -> None:
    path = dataset(root, episode(3))
    with pytest.raises(ConfigError, match="without keys"):
        Transitions.from_minari(path, flatten=["observation"])
    assert len(Transitions.from_minari(path, flatten=True)) == 3


IMAGE = {"type": "Box", "dtype": "uint8", "shape": [64, 64, 3], "low": 0, "high": 255}
DISCRETE = {"type": "Discrete", "dtype": "int64", "start": 0, "n": 4}
REFUSED = {
    "image": ({"observation_space": json.dumps(IMAGE)}, "images.*vector"),
    "discrete observation": ({"observation_space": json.dumps(DISCRETE)}, "Discrete.*vector"),
    "text": ({"observation_space": json.dumps({"type": "Text"})}, "Text.*vector"),
    "unknown": ({"observation_space": json.dumps({"type": ["Box"]})}, "vector"),
    "discrete actions": ({"action_space": json.dumps(DISCRETE)}, "Discrete.*continuous"),
    "parts of actions": ({"action_space": json.dumps({"type": "Dict", "subspaces": {"a": box(1)}})}, "Dict.*continuous"),
    "space that is no JSON": ({"observation_space": "Box(2,)"}, "no description of a space"),
    "space that is a list": ({"action_space": "[1]"}, "no description of a space"),
    "bounds that are words": ({"action_space": json.dumps({**box(1), "low": ["a"]})}, "no numbers"),
    "format": ({"data_format": "zarr"}, "zarr.*Known are"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_agent_can_use_is_refused(root: Path, name: str) -> None:
    metadata, message = REFUSED[name]
    with pytest.raises(DatasetFormatError, match=message):
        Transitions.from_minari(dataset(root, episode(3), **metadata))


def test_an_image_among_the_parts_is_refused_unless_it_is_left_out(root: Path) -> None:
    space = json.dumps({"type": "Dict", "subspaces": {"picture": IMAGE, "state": box(2)}})
    pictures = np.zeros((4, 64, 64, 3), dtype=np.uint8)
    path = dataset(root, with_dict(picture=pictures, state=np.zeros((4, 2))), observation_space=space)
    with pytest.raises(DatasetFormatError, match=r"picture.*images"):
        Transitions.from_minari(path, flatten=True)
    assert Transitions.from_minari(path, flatten=["state"]).obs_shape == (2,)


# -- names ---------------------------------------------------------------------------------------------------------


def test_no_set_of_minari_passes_for_one_of_d4rl(root: Path) -> None:
    for name in ("mujoco/halfcheetah/medium-v0", "halfcheetah-medium-v2", "D4RL/door/human-v2"):
        write_dataset(root / name, {"episode_0": episode(3)})
        made = load_transitions(f"minari:{name}")
        assert made.info.id == f"minari:{name}" and find_file(f"minari:{name}")[1] is None
        assert catalogue_id(f"minari:{name}") is None and catalogue_id(str(made.info.path)) is None
        assert not any("score" in line for line in made.summary() if not line.startswith("note"))
        with pytest.raises(DatasetError, match="unknown dataset"):
            normalized_score(made.info.id, 0.0)
    by_path = load_transitions(root / "halfcheetah-medium-v2")
    assert by_path.info.id == "minari:halfcheetah-medium-v2"


def test_replayed_adroit_sets_say_that_their_rewards_deserve_a_look(root: Path) -> None:
    for name, doubtful in {"D4RL/door/human-v2": True, "D4RL/pen/human-v2": False}.items():
        write_dataset(root / name, {"episode_0": episode(3)})
        assert any("Gymnasium-Robotics" in note for note in load_transitions(f"minari:{name}").info.notes) == doubtful


@pytest.mark.parametrize("way", ["", "data", "data/metadata.json", "data/main_data.hdf5"])
def test_a_path_is_as_good_as_a_name(root: Path, way: str) -> None:
    path = dataset(root, episode(3), dataset_id="own/set-v0")
    assert load_transitions(path / way).info.id == load_transitions("minari:own/set-v0").info.id == "minari:own/set-v0"
    assert find_file(path / way) == find_file("minari:own/set-v0") == (path / "data/main_data.hdf5", None)
    assert short_name(path / way) == short_name("minari:own/set-v0") == "own-set-v0"


def test_a_folder_beside_the_user_needs_no_separator(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = dataset(root, episode(3))
    monkeypatch.chdir(path.parent)
    assert is_path("set-v0") and find_file("set-v0")[0].samefile(path / "data/main_data.hdf5")
    monkeypatch.chdir(path)
    assert short_name("data") == short_name("data/main_data.hdf5") == "set-v0"


def test_no_folder_of_minari_passes_for_a_set_of_the_catalogue(root: Path) -> None:
    path = write_dataset(root / "hopper-medium-v2", {"episode_0": episode(3)})
    assert find_file(path)[1] is known_dataset(path) is None


def test_command_trains_on_a_folder(pendulum: tuple[Path, Steps], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    settings = ("--set", "policy_kwargs={net_arch: [8]}", "--set", "batch_size=16")
    steps = ("--updates", "2", "--eval-freq", "2", "--eval-episodes", "1", "--seeds", "1")
    outcome = sb3_dce("train", str(pendulum[0] / "test/pendulum/random-v0"), "--algo", "bc", *steps, *settings)
    assert outcome.code == 0, outcome
    assert (tmp_path / "runs/offline_bc-test-pendulum-random-v0/seed_0/result.json").is_file()


def test_rows_are_kept_if_asked_for(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    space = json.dumps({"type": "Dict", "subspaces": {"a": box(1), "b": box(1)}})
    path = dataset(root, with_dict(a=np.zeros((4, 1)), b=np.ones((4, 1))), observation_space=space)
    load_transitions("minari:own/set-v0", flatten=True, cache=True)
    monkeypatch.setattr("sb3_dce.data.transitions.open_episodes", lambda *_: pytest.fail("read again"))
    kept = load_transitions("minari:own/set-v0", flatten=True, cache=True)
    assert kept.info.id == "minari:own/set-v0" and "the observation is a (1) | b (1)" in kept.info.notes
    np.testing.assert_array_equal(kept.observations, [[0, 1]] * 3)
    monkeypatch.undo()
    np.testing.assert_array_equal(load_transitions(path, flatten=["b", "a"], cache=True).observations, [[1, 0]] * 3)


def test_the_hash_is_that_of_the_data(root: Path) -> None:
    path = dataset(root, episode(3))
    first = load_transitions(path).info.sha256
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        file["episode_0/rewards"][0] += 1
    assert load_transitions(path).info.sha256 != first and first is not None


@pytest.mark.parametrize("data_format", ["arrow", "parquet"])
def test_the_hash_of_a_file_per_episode_is_that_of_all_files(root: Path, tmp_path: Path, data_format: str) -> None:
    pytest.importorskip("pyarrow")
    record(gym.make("Pendulum-v1", max_episode_steps=10), "pendulum-v0", 2, data_format=data_format)
    path, twin = find_file("minari:pendulum-v0")[0], tmp_path / "twin"
    info = load_transitions("minari:pendulum-v0").info
    shutil.copytree(path.parent, twin)
    (twin / ".hidden").mkdir()
    (twin / ".hidden/file").touch()
    first = sha256_once(path)
    assert first == data_sha256(path) == load_transitions(twin).info.sha256
    part = next((path.parent / "1").glob(f"*.{data_format}"))
    part.rename(part.with_name(f"other.{data_format}"))
    renamed = data_sha256(path)
    (path.parent / "0" / part.name).write_bytes(part.with_name(f"other.{data_format}").read_bytes())
    assert len({first, renamed, sha256_once(path)}) == 3 and file_sha256(path) == file_sha256(twin / path.name)
    with pytest.raises(DatasetIntegrityError, match="changed since it was read"):
        _ = info.sha256


def test_a_dataset_that_is_not_here_is_said_without_network(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_network(*_: Any, **__: Any) -> Any:
        raise AssertionError("network")

    monkeypatch.setattr(socket, "socket", no_network)
    monkeypatch.setattr(socket, "getaddrinfo", no_network)
    for load in (load_transitions, find_file, OfflineDCE.load_dataset):
        with pytest.raises(DatasetNotFoundError, match=r"datasets download minari:D4RL/door/human-v2") as caught:
            load("minari:D4RL/door/human-v2")  # type: ignore[operator]
        assert str(root / "D4RL/door/human-v2") in str(caught.value)
    assert not root.exists()


@pytest.mark.parametrize(
    "name", ["", "door", "../../secret-v0", "a/../b-v0", "/etc/set-v0", "D4RL//door-v0", "a b-v0", "é-v0"]
)
def test_what_is_no_id_is_refused(root: Path, name: str) -> None:
    with pytest.raises(DatasetError, match="no id of Minari"):
        load_transitions(f"minari:{name}")


def test_half_a_download_is_not_a_dataset(root: Path) -> None:
    path = dataset(root, episode(3))
    (path / "data/main_data.hdf5").unlink()
    with pytest.raises(DatasetNotFoundError, match=r"incomplete.*download minari:own/set-v0 --force"):
        load_transitions("minari:own/set-v0")
    (path / "data/metadata.json").unlink()
    with pytest.raises(DatasetNotFoundError, match="incomplete"):
        load_transitions("minari:own/set-v0")


# -- broken and hostile datasets -----------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["observations", "actions", "rewards", "terminations", "truncations"])
def test_t_steps_have_one_observation_more(root: Path, key: str) -> None:
    broken = episode(5)
    broken[key] = broken[key][:-1]
    with pytest.raises(DatasetFormatError, match=r"episode_1: .*T \+ 1.*observations") as caught:
        Transitions.from_minari(dataset(root, episode(5), broken))
    assert caught.value.index == 1


@pytest.mark.parametrize("key", ["observations", "actions", "rewards", "terminations", "truncations"])
def test_missing_array_is_named(root: Path, key: str) -> None:
    broken = {name: array for name, array in episode(3).items() if name != key}
    with pytest.raises(DatasetFormatError, match=f"episode_1: missing {key}"):
        Transitions.from_minari(dataset(root, episode(3), broken))


def test_episode_without_steps_is_refused(root: Path) -> None:
    with pytest.raises(DatasetFormatError, match=r"episode_1: no step"):
        Transitions.from_minari(dataset(root, episode(3), episode(0, end="")))


@pytest.mark.parametrize(("numbers", "total", "missing"), [((0, 2), 2, 1), ((0, 1), 3, 2), ((1,), 1, 0), ((), 0, 0)])
def test_missing_episode_is_named(root: Path, numbers: tuple[int, ...], total: int, missing: int) -> None:
    path = write_dataset(root / "own/set-v0", {f"episode_{i}": episode(3) for i in numbers}, total_episodes=total)
    with pytest.raises(DatasetFormatError, match=f"episode_{missing} is missing"):
        Transitions.from_minari(path)


WRONG_ARRAYS = {
    "other width": ("observations", np.zeros((4, 3)), r"episode_1/observations: shape \(4, 3\)"),
    "pixels": ("observations", np.zeros((4, 2, 2)), r"episode_1/observations: shape \(4, 2, 2\)"),
    "text": ("rewards", np.array([b"a", b"b", b"c"]), "episode_1/rewards.*type"),
    "one number": ("rewards", np.float64(1.0), "episode_1/rewards"),
    "complex": ("actions", np.zeros((3, 1), dtype=complex), "episode_1/actions"),
    "flag 2": ("terminations", np.array([0, 0, 2]), "flags must be 0/1"),
    "group": ("actions", {"a": np.zeros(3)}, "group.*metadata.json"),
}


@pytest.mark.parametrize("name", WRONG_ARRAYS)
def test_array_of_another_kind_is_refused(root: Path, name: str) -> None:
    key, array, message = WRONG_ARRAYS[name]
    with pytest.raises(DatasetFormatError, match=message):
        Transitions.from_minari(dataset(root, episode(3), {**episode(3), key: array}))


@pytest.mark.parametrize("content", ["", "{", "[]", "null", '"text"', "[" * 99_999, '{"a": ' * 99_999, b"\xff\xfe\x00"])
def test_metadata_that_are_no_json_object_are_an_integrity_error(root: Path, content: str | bytes) -> None:
    path = dataset(root, episode(3))
    (path / "data/metadata.json").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DatasetIntegrityError, match="damaged"):
        load_transitions("minari:own/set-v0")


def test_metadata_beyond_any_sense_are_not_read(root: Path) -> None:
    path = dataset(root, episode(3))
    with open(path / "data/metadata.json", "wb") as file:
        file.truncate(2**33)
    with pytest.raises(DatasetFormatError, match="no metadata"):
        load_transitions("minari:own/set-v0")


def test_spaces_without_end_are_refused(root: Path) -> None:
    space: dict[str, Any] = box(1)
    for _ in range(200):
        space = {"type": "Dict", "subspaces": {"a": space}}
    with pytest.raises(DatasetFormatError, match="several arrays"):
        Transitions.from_minari(dataset(root, episode(3), observation_space=json.dumps(space)))


@pytest.mark.parametrize(
    "metadata", [{}, {"env_spec": "no JSON"}, {"env_spec": "[1]"}, {"env_spec": '{"id": 3}'}, {"env_spec": 7}]
)
def test_dataset_without_environment_loads(root: Path, metadata: dict[str, Any]) -> None:
    dataset(root, episode(3), episode(3), **metadata)
    model = OfflineDCE.load_dataset("minari:own/set-v0", **TINY)
    assert isinstance(model.env.envs[0].unwrapped, SpacesEnv)  # type: ignore[union-attr, attr-defined]


@pytest.mark.parametrize(
    "spec",
    [
        {"id": "Evil-v0", "entry_point": "evil_of_minari:Env", "kwargs": {}},
        {"id": "evil_of_minari:Evil-v0", "entry_point": "evil_of_minari:Env"},
        {
            "id": "Pendulum-v1",
            "entry_point": "evil_of_minari:Env",
            "additional_wrappers": [{"entry_point": "evil_of_minari:W"}],
        },
        {"id": "Pendulum-v1", "kwargs": {"g": 0.0}},
    ],
)
def test_nothing_that_metadata_name_is_imported_or_passed_on(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spec: dict[str, Any]
) -> None:
    (tmp_path / "evil_of_minari.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    dataset(root, episode(3), env_spec=json.dumps(spec), eval_env_spec=json.dumps(spec))
    assert len(load_transitions("minari:own/set-v0")) == 3
    assert make_minari_env("minari:own/set-v0") is None
    assert "evil_of_minari" not in sys.modules


def test_environment_for_evaluation_is_gymnasiums_own_entry(root: Path) -> None:
    """Of a known id only the id and the time limit count: the entry point beside it is not looked at."""
    spec = {"id": "Pendulum-v1", "entry_point": "evil_of_minari:Env", "kwargs": {}, "max_episode_steps": 7}
    dataset(root, episode(3), env_spec=json.dumps({"id": "CartPole-v1"}), eval_env_spec=json.dumps(spec))
    env = make_minari_env("minari:own/set-v0")
    assert env is not None and env.spec is not None and env.spec.id == "Pendulum-v1" and env.spec.max_episode_steps == 7


@pytest.mark.parametrize(("recorded", "limit"), [(7, 7), (300, 300), (None, 200), (0, 200), ("7", 200)])
def test_episodes_are_as_long_as_those_of_the_recording(root: Path, recorded: object, limit: int) -> None:
    spec = {"id": "Pendulum-v1", "kwargs": {}, "max_episode_steps": recorded}
    dataset(root, episode(3), env_spec=json.dumps(spec))
    env = make_minari_env("minari:own/set-v0")
    assert env is not None and without_bookkeeping(env)[1] == limit


@pytest.mark.parametrize("way", ["", "data/main_data.hdf5"])
def test_environment_is_found_by_a_path_and_of_data_that_were_read(root: Path, way: str) -> None:
    path = dataset(root, episode(3), env_spec=json.dumps({"id": "Pendulum-v1", "kwargs": {}})) / way
    for env in (own_env(str(path)), own_env(str(load_transitions("minari:own/set-v0").info.path))):
        assert env is not None and env.spec is not None and env.spec.id == "Pendulum-v1"


def test_adroit_environment_is_found_if_its_package_is_installed(root: Path) -> None:
    pytest.importorskip("gymnasium_robotics")
    spec = {"id": "AdroitHandDoor-v1", "kwargs": {"reward_type": "dense"}}
    dataset(root, episode(3), env_spec=json.dumps(spec))
    env = make_minari_env("minari:own/set-v0")
    assert env is not None and env.observation_space.shape == (39,)
    env.close()


LINKS = {
    "soft": lambda file: h5py.SoftLink("/episode_0/rewards"),
    "external": lambda file: h5py.ExternalLink("other.hdf5", "/secret"),
}


@pytest.mark.parametrize("where", ["episode_1/rewards", "episode_1"])
@pytest.mark.parametrize("kind", LINKS)
def test_links_are_not_followed(root: Path, where: str, kind: str) -> None:
    path = dataset(root, episode(3), episode(3))
    with h5py.File(path / "data/other.hdf5", "w") as file:
        file["secret"] = np.ones(3)
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        del file[where]
        file[where] = LINKS[kind](file)
    with pytest.raises(DatasetSecurityError, match=r"link to .*not followed"):
        Transitions.from_minari(path)


def test_link_to_nowhere_is_refused(root: Path) -> None:
    path = dataset(root, episode(3))
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        del file["episode_0/rewards"]
        file["episode_0/rewards"] = h5py.ExternalLink("nothing.hdf5", "/x")
    with pytest.raises(DatasetSecurityError, match="link"):
        Transitions.from_minari(path)


def test_numbers_in_other_files_are_not_read(root: Path) -> None:
    path = dataset(root, episode(3), episode(3))
    secret = path / "data/secret.bin"
    secret.write_bytes(np.ones(3).tobytes())
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        del file["episode_1/rewards"]
        file["episode_1"].create_dataset("rewards", (3,), "f8", external=[(str(secret), 0, 24)])
    with pytest.raises(DatasetSecurityError, match="another file"):
        Transitions.from_minari(path)
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        del file["episode_1/rewards"]
        layout = h5py.VirtualLayout((3,), "f8")
        layout[:] = h5py.VirtualSource("other.hdf5", "secret", (3,))
        file["episode_1"].create_virtual_dataset("rewards", layout)
    with pytest.raises(DatasetSecurityError, match="virtual"):
        Transitions.from_minari(path)


def test_budget_counts_all_episodes_together(root: Path) -> None:
    path = dataset(root, *(episode(100) for _ in range(5)))
    assert len(Transitions.from_minari(path, max_bytes=20_000)) == 500
    with pytest.raises(DatasetSecurityError, match="the limit is 5,000"):
        Transitions.from_minari(path, max_bytes=5_000)


def test_arrow_has_a_budget_too(root: Path) -> None:
    pytest.importorskip("pyarrow")
    record(gym.make("Pendulum-v1", max_episode_steps=50), "pendulum-v0", 3, data_format="parquet")
    with pytest.raises(DatasetSecurityError, match="max_bytes"):
        load_transitions("minari:pendulum-v0", max_bytes=3_000)


def test_declared_terabytes_are_not_allocated(root: Path) -> None:
    path = dataset(root, episode(3))
    with h5py.File(path / "data/main_data.hdf5", "a") as file:
        del file["episode_0/rewards"]
        file["episode_0"].create_dataset("rewards", (10**12,), "f8", chunks=(1000,))
    with pytest.raises(DatasetSecurityError, match="the limit is"):
        Transitions.from_minari(path)


@pytest.mark.parametrize("data_format", ["arrow", "parquet"])
def test_damaged_arrow_is_an_error_of_this_package(root: Path, data_format: str) -> None:
    pytest.importorskip("pyarrow")
    record(gym.make("Pendulum-v1", max_episode_steps=10), "pendulum-v0", 2, data_format=data_format)
    folder = root / "pendulum-v0/data"
    part = next((folder / "1").glob(f"*.{data_format}"))
    whole = part.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"not a table at all"):
        part.write_bytes(content)
        with pytest.raises(DatasetError, match="pendulum-v0"):
            load_transitions("minari:pendulum-v0")
    part.unlink()
    (folder / "1/metadata.json").unlink()
    (folder / "1").rmdir()
    with pytest.raises(DatasetFormatError, match="episode_1 is missing"):
        load_transitions("minari:pendulum-v0")


@pytest.mark.filterwarnings("ignore::sb3_dce.errors.DatasetWarning")
@pytest.mark.parametrize("flips", [60, pytest.param(2000, marks=pytest.mark.slow)])
def test_flipped_bytes_never_leave_the_family_of_errors(root: Path, flips: int) -> None:
    path = dataset(root, *(episode(4, first=10.0 * i) for i in range(3)))
    file = path / "data/main_data.hdf5"
    whole, rng, refused = file.read_bytes(), np.random.default_rng(0), 0
    for _ in range(flips):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= int(rng.integers(1, 256))
        file.write_bytes(damaged)
        try:
            Transitions.from_minari(path)
        except DatasetError:
            refused += 1
    assert refused > 0


# -- the command line and the download -----------------------------------------------------------------------------


def command(*arguments: str, root: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    code = "import sys; from sb3_dce import cli; sys.argv[0] = 'sb3-dce'; cli.main()"
    own = {"MINARI_DATASETS_PATH": str(root), "HF_HOME": str(root.parent / "hub"), "COLUMNS": "300"}
    env = {**os.environ, **own, **environment}
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, env=env, timeout=120)


def test_info_of_a_dataset(root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    dataset(root, episode(3), episode(4))
    monkeypatch.setattr(sys, "argv", ["sb3-dce", "datasets", "info", "minari:own/set-v0"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code and "7 transitions from 7 rows, 2 whole episodes" in " ".join(capsys.readouterr().out.split())


def test_download_takes_the_dataset_from_the_hub(pendulum: tuple[Path, Steps], root: Path, tmp_path: Path) -> None:
    recorded, steps = pendulum
    remote = tmp_path / "remote"
    write_dataset(remote / "unused/set-v0", {"episode_0": episode(3)})
    for file in recorded.rglob("*"):
        if file.is_file():
            target = remote / file.relative_to(recorded)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    listed = {"datasets": ["test/pendulum/random-v0"], "namespaces": ["test/pendulum"]}
    (remote / "test/namespace_metadata.json").write_text(json.dumps(listed))
    hub = Hub(remote)
    name = "minari:test/pendulum/random-v0"
    done = command("datasets", "download", name, root=root, HF_ENDPOINT=hub.url)
    assert done.returncode == 0, done.stderr
    assert str(root / "test/pendulum/random-v0/data/main_data.hdf5") in done.stdout
    assert_equal_to_steps(load_transitions(name), steps)
    asked = len(hub.asked)
    assert download_minari(name) == find_file(name)[0] and len(hub.asked) == asked  # what is here needs no network
    (root / "test/pendulum/random-v0/data/main_data.hdf5").unlink()
    repaired = command("datasets", "download", name, root=root, HF_ENDPOINT=hub.url)
    assert repaired.returncode == 0, repaired.stderr
    assert_equal_to_steps(load_transitions(name), steps)
    unknown = command("datasets", "download", "minari:test/nothing-v0", root=root, HF_ENDPOINT=hub.url)
    assert unknown.returncode == 2 and unknown.stderr.startswith("Error: dataset minari:test/nothing-v0: not downloaded")
    assert "Traceback" not in unknown.stderr
    hub.shutdown()


def test_download_without_network_is_one_message(root: Path) -> None:
    pytest.importorskip("minari")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound but not listening: connections are refused
        url = f"http://127.0.0.1:{unused.getsockname()[1]}"
        done = command("datasets", "download", "minari:D4RL/door/human-v2", root=root, HF_ENDPOINT=url)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.startswith("Error: dataset minari:D4RL/door/human-v2: not downloaded") and url in done.stderr
    assert "minari download D4RL/door/human-v2" in done.stderr and str(root / "D4RL/door") in done.stderr


def test_options_of_other_downloads_are_refused(root: Path) -> None:
    done = command("datasets", "download", "minari:D4RL/door/human-v2", "--mirror", "http://localhost", root=root)
    assert done.returncode == 2 and "$MINARI_REMOTE" in done.stderr


def test_download_without_minari_names_the_extra(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ConfigError, match=r'pip install "sb3_dce\[minari\]"'):
        download_minari("minari:D4RL/door/human-v2")


def test_reading_imports_no_minari(root: Path) -> None:
    dataset(root, episode(3))
    code = (
        "import sys; sys.modules['minari'] = None; sys.modules['pyarrow'] = None\n"
        "from sb3_dce.data import load_transitions; assert len(load_transitions('minari:own/set-v0')) == 3"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_arrow_without_pyarrow_names_the_extra(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = dataset(root, episode(3), data_format="arrow")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ConfigError, match=r'pip install "sb3_dce\[parquet\]"'):
        Transitions.from_minari(path)


def test_failure_of_another_remote_is_a_download_error(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_REMOTE", "nowhere://bucket")
    with pytest.raises(DownloadError, match="nowhere://bucket"):
        download_minari("minari:D4RL/door/human-v2")
