"""Dataset ids as environments: registered, silent, D4RL's rewards and episode ends, usable without simulators."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_dce import envs, robotics
from sb3_dce.data import catalog
from sb3_dce.errors import ConfigError

LOCOMOTION = ["halfcheetah-medium-v2", "hopper-random-v2", "walker2d-medium-replay-v2"]
ADROIT = ["door-human-v0", "hammer-cloned-v0", "relocate-human-v1", "pen-human-v0"]


def _make(dataset_id: str) -> gym.Env:
    if catalog.resolve(dataset_id).family != "gym":
        pytest.importorskip("gymnasium_robotics")
    env = envs.make_env_if_possible(dataset_id)
    env.action_space.seed(0)
    return env


def _random_returns(env: gym.Env, n_episodes: int) -> list[float]:
    returns = []
    for seed in range(n_episodes):
        env.reset(seed=seed)
        total, done = 0.0, False
        while not done:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total, done = total + float(reward), terminated or truncated
        returns.append(total)
    return returns


@pytest.mark.parametrize("spec", catalog.all_specs(), ids=lambda spec: spec.id)
def test_every_dataset_id_is_an_environment_with_its_time_limit(spec: catalog.DatasetSpec) -> None:
    assert gym.spec(spec.id).max_episode_steps == spec.max_episode_steps


def test_registering_twice_changes_nothing() -> None:
    before = dict(gym.registry)
    envs.register_envs()
    assert dict(gym.registry) == before


@pytest.mark.parametrize("dataset_id", LOCOMOTION)
def test_locomotion_is_version_4_of_gymnasium(dataset_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # Gymnasium's own environment lets MuJoCo write its log file
    ours, theirs = _make(dataset_id), gym.make(catalog.resolve(dataset_id).env_id)
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    assert np.array_equal(ours.reset(seed=3)[0], theirs.reset(seed=3)[0])
    for _ in range(50):
        action = ours.action_space.sample()
        (obs, *outcome), (their_obs, *their_outcome) = ours.step(action), theirs.step(action)
        assert np.array_equal(obs, their_obs)
        assert outcome == their_outcome
        if outcome[1]:
            break


@pytest.mark.parametrize("dataset_id", [*LOCOMOTION, *ADROIT, "kitchen-mixed-v0"])
def test_spaces_are_known_without_the_simulator(dataset_id: str) -> None:
    env = _make(dataset_id)
    assert envs.dataset_spaces(catalog.resolve(dataset_id)) == (env.observation_space, env.action_space)
    assert env.observation_space.contains(env.reset(seed=0)[0])


@pytest.mark.parametrize("dataset_id", [LOCOMOTION[0], ADROIT[0], "kitchen-complete-v0"])
def test_environments_leave_no_file_no_warning_and_no_output(dataset_id: str, tmp_path: Path) -> None:
    if catalog.resolve(dataset_id).family != "gym":
        pytest.importorskip("gymnasium_robotics")
    code = f"""
from sb3_dce.envs import make_env_if_possible
env = make_env_if_possible({dataset_id!r})
env.reset(seed=0)
env.step(env.action_space.sample())
env.close()
"""
    run = subprocess.run([sys.executable, "-W", "default", "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


def test_registering_imports_no_simulator() -> None:
    code = "import sys, sb3_dce.envs; print([m for m in ('mujoco', 'gymnasium_robotics', 'rl_zoo3') if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.stdout == "[]\n"


def test_spaces_env_resets_but_refuses_to_step() -> None:
    env = envs.SpacesEnv(spaces.Box(-np.inf, np.inf, (3,)), spaces.Box(-1, 1, (2,)))
    obs, info = env.reset(seed=1)
    assert np.array_equal(obs, np.zeros(3))
    assert info == {}
    with pytest.raises(RuntimeError, match="pass an env to evaluate"):
        env.step(env.action_space.sample())


def test_spaces_env_observation_lies_in_a_space_without_zero() -> None:
    env = envs.SpacesEnv(spaces.Box(2.0, 3.0, (1,)), spaces.Box(-1, 1, (1,)))
    assert env.observation_space.contains(env.reset()[0])


def test_without_simulator_making_fails_with_the_command_and_spaces_remain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigError, match=r'pip install "gymnasium\[mujoco\]"'):
        gym.make("halfcheetah-medium-v2")
    assert isinstance(envs.make_env_if_possible("halfcheetah-medium-v2"), envs.SpacesEnv)


def test_antmaze_can_be_trained_on_but_not_evaluated() -> None:
    env = envs.make_env_if_possible("antmaze-umaze-v2")
    assert isinstance(env, envs.SpacesEnv) and env.observation_space.shape == (29,)
    with pytest.raises(ConfigError, match="mirrored"):
        envs.make_dataset_env("antmaze-umaze-v2")


def test_missing_robotics_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    with pytest.raises(ConfigError, match=r'pip install "sb3_dce\[robotics\]"'):
        envs.make_dataset_env("door-human-v0")


def test_environment_dropped_by_gymnasium_names_a_release_that_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(gym.registry, "Hopper-v4")
    with pytest.raises(ConfigError, match=r"Hopper-v4.*gymnasium==1\.4\.0"):
        envs.make_dataset_env("hopper-random-v2")


def test_training_without_simulator_can_be_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gym.registry, "hopper-random-v2", gym.spec("hopper-random-v2"))
    monkeypatch.setattr(gym.registry["hopper-random-v2"], "kwargs", {"dataset_id": "hopper-random-v2"})
    envs.use_spaces_only("hopper-random-v2")
    assert isinstance(gym.make("hopper-random-v2").unwrapped, envs.SpacesEnv)


def test_door_pays_d4rls_reward() -> None:
    env = _make("door-human-v0")
    env.reset(seed=0)
    simulator: Any = env.unwrapped
    for _ in range(20):
        _, reward, *_ = env.step(env.action_space.sample())
        data = simulator.data
        palm, handle = data.site_xpos[simulator.grasp_site_id], data.site_xpos[simulator.handle_site_id]
        hinge = data.qpos[simulator.door_hinge_addrs]
        expected = -0.1 * np.linalg.norm(palm - handle) - 0.1 * (hinge - 1.57) ** 2 - 1e-5 * np.sum(data.qvel**2)
        assert hinge < 0.2  # no bonus yet
        assert reward == pytest.approx(expected, abs=1e-9)


def test_pen_episode_ends_when_the_pen_is_dropped() -> None:
    env = _make("pen-human-v0")
    simulator: Any = env.unwrapped
    ends = []
    for seed in range(5):
        env.reset(seed=seed)
        done = False
        while not done:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            assert terminated == (simulator.data.xpos[simulator.obj_body_id][2] < 0.075)
            done = terminated or truncated
        ends.append(terminated)
    assert any(ends)


@pytest.mark.parametrize("name", ["qpos", "qvel"])
def test_joint_helpers_of_kitchen_know_all_joint_types(name: str) -> None:
    pytest.importorskip("gymnasium_robotics")
    import mujoco
    from gymnasium_robotics.utils import mujoco_utils

    robotics.fix_kitchen_joint_types()
    body = '<body><joint name="{0}" type="{0}"/><geom size="1"/></body>'
    bodies = "".join(body.format(kind) for kind in ("free", "ball", "hinge", "slide"))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    getattr(data, name)[:] = np.arange(len(getattr(data, name)))
    widths = {"qpos": (7, 4, 1, 1), "qvel": (6, 3, 1, 1)}[name]
    read = [getattr(mujoco_utils, f"get_joint_{name}")(model, data, kind) for kind in ("free", "ball", "hinge", "slide")]
    assert [len(values) for values in read] == list(widths)
    assert np.array_equal(np.concatenate(read), getattr(data, name))
    getattr(mujoco_utils, f"set_joint_{name}")(model, data, "slide", -1.0)
    assert getattr(data, name)[-1] == -1.0


@pytest.mark.parametrize(
    ("dataset_id", "goal"),
    [
        ("kitchen-complete-v0", {17: -0.69, 18: -0.05, 19: 0.37}),
        ("kitchen-partial-v0", {17: -0.69, 18: -0.05, 19: 0.37}),
        ("kitchen-mixed-v0", {11: -0.88, 12: -0.01, 17: -0.69, 18: -0.05}),
    ],
)
def test_kitchen_observation_is_robot_objects_and_goal(dataset_id: str, goal: dict[int, float]) -> None:
    env = _make(dataset_id)
    obs, _ = env.reset(seed=0)
    expected = np.zeros(30)
    expected[22:30] = (-0.75, -0.23, 0.75, 1.62, 0.99, 0.0, 0.0, -0.06)  # microwave and kettle are always targets
    for index, value in goal.items():
        expected[index] = value
    assert np.array_equal(obs[30:], expected)
    simulator: Any = env.unwrapped
    assert np.allclose(obs[:9], simulator.data.qpos[:9], atol=0.011)  # D4RL's noise is about 0.01 on the robot
    assert np.allclose(obs[9:30], simulator.data.qpos[9:], atol=1e-4)
    assert np.abs(obs[:9] - simulator.data.qpos[:9]).max() > 1.1e-3  # ten times that of Gymnasium-Robotics


def test_kitchen_pays_once_per_task_and_ends_when_all_are_done() -> None:
    env = _make("kitchen-complete-v0")
    env.reset(seed=0)
    simulator: Any = env.unwrapped
    for task, goal in simulator.goal.items():
        simulator.data.qpos[_kitchen_indices()[task]] = goal
    _, reward, terminated, _, _ = env.step(np.zeros(9, np.float32))
    assert (reward, terminated) == (4.0, True)


def _kitchen_indices() -> dict[str, np.ndarray]:
    from gymnasium_robotics.envs.franka_kitchen.kitchen_env import OBS_ELEMENT_INDICES

    return OBS_ELEMENT_INDICES


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dataset_id", "n_episodes", "tolerance"),
    [
        # without the reward fix the three means lie 7 to 16 above D4RL's, with a double one as far below
        ("door-human-v0", 30, 3.0),
        ("hammer-human-v0", 30, 3.0),
        ("relocate-human-v0", 30, 3.0),
        ("pen-human-v0", 300, 40.0),  # single episodes pay up to thousands: three standard errors
        ("halfcheetah-random-v2", 30, 30.0),
        ("walker2d-random-v2", 300, 2.0),
    ],
)
def test_random_policy_scores_about_zero(dataset_id: str, n_episodes: int, tolerance: float) -> None:
    returns = _random_returns(_make(dataset_id), n_episodes)
    assert np.mean(returns) == pytest.approx(catalog.resolve(dataset_id).ref_min_score, abs=tolerance)


@pytest.mark.slow
def test_random_policy_of_hopper_pays_more_than_d4rls() -> None:
    """D4RL's constant, -20.3, cannot be met here: each step pays 1 for being upright."""
    returns = _random_returns(_make("hopper-random-v2"), 300)
    assert np.mean(returns) == pytest.approx(18.7, abs=3.0) and min(returns) > 0.0
    assert 0.5 < catalog.normalized_score("hopper-random-v2", np.mean(returns)) < 1.5


@pytest.mark.slow
def test_random_policy_of_the_kitchen_does_no_task() -> None:
    assert _random_returns(_make("kitchen-mixed-v0"), 3) == [catalog.resolve("kitchen-mixed-v0").ref_min_score] * 3
