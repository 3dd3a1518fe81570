"""Recording a policy: the rows are those of its episodes, whatever happens on the way."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from commands import sb3_dce
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from typer.testing import CliRunner

from sb3_dce import cli, load_dataset
from sb3_dce.data import D4RLFile, content_hash, file_sha256, normalized_score
from sb3_dce.envs import make_env_if_possible
from sb3_dce.errors import CheckpointError, ConfigError, DatasetSemanticsError
from sb3_dce.numpy_policy import MLPPolicy
from sb3_dce.recording import RecordingSpec, record
from sb3_dce.recording.episodes import SIDE_BY_SIDE, EpisodeRunner, concatenate, make_env
from sb3_dce.recording.policy_files import read_npz_policy, write_npz_policy

RANDOM = RecordingSpec("random", "Hopper-v4", seed=5)


def hopper_npz(path: Path, width: int = 16) -> Path:
    """A stochastic policy for Hopper, with weights that make it fall at different times."""
    rng = np.random.default_rng(0)
    shapes, scale = ((11, width), (width, width), (width, 3)), 0.3 * (16 / width) ** 0.5
    layers = [(scale * rng.normal(size=shape), np.zeros(shape[1])) for shape in shapes]
    std = (0.1 * rng.normal(size=(width, 3)), np.full(3, -1.0))
    write_npz_policy(
        MLPPolicy(layers, "tanh", -np.ones(3), np.ones(3), squash="draw", log_std=std),
        path,
        {"algo": "sac", "source": "a test", "licence": "MIT"},
    )
    return path


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hopper_npz(tmp_path_factory.mktemp("policy") / "hopper.npz")


def read(path: Path) -> dict[str, np.ndarray]:
    with D4RLFile(path) as file:
        return {key: array[slice(None)] for key, array in file.select(file.keys).items()}


def attributes(path: Path) -> dict[str, Any]:
    with D4RLFile(path) as file:
        return file.attributes()


def ends(arrays: dict[str, np.ndarray]) -> np.ndarray:
    return np.flatnonzero(arrays["terminals"] | arrays["timeouts"])


def test_rows_are_exactly_as_many_and_episodes_follow_each_other(tmp_path: Path) -> None:
    made = record(RANDOM, tmp_path / "r.hdf5", n_rows=333)
    arrays = read(made.path)
    assert {key: array.dtype for key, array in arrays.items()} == {
        "observations": np.float32,
        "actions": np.float32,
        "rewards": np.float32,
        "terminals": bool,
        "timeouts": bool,
    }
    assert all(len(array) == 333 for array in arrays.values())
    assert len(ends(arrays)) >= 5 and not (arrays["terminals"] & arrays["timeouts"]).any()
    # each episode, simulated again from its seed with the recorded actions through Gymnasium's own wrappers
    env = make_env_if_possible("hopper-medium-v2")
    row = 0
    for number in range(len(ends(arrays)) + 1):
        obs, _ = env.reset(seed=5 + number)
        over = False
        while not over and row < 333:
            assert np.array_equal(arrays["observations"][row], obs.astype(np.float32))
            obs, reward, terminated, truncated, _ = env.step(arrays["actions"][row])
            over = terminated or truncated
            assert arrays["rewards"][row] == np.float32(reward)
            assert (arrays["terminals"][row], arrays["timeouts"][row]) == (terminated, truncated and not terminated)
            row += 1
    assert row == 333


def test_actions_are_the_policys_with_the_episodes_own_noise(policy: Path, tmp_path: Path) -> None:
    made = record(RecordingSpec(str(policy), "Hopper-v4", seed=7), tmp_path / "p.hdf5", n_episodes=3)
    arrays, actor = read(made.path), read_npz_policy(policy)[0]
    stops = ends(arrays) + 1
    assert len(stops) == 3
    for number, (start, stop) in enumerate(zip([0, *stops[:-1]], stops, strict=True)):
        noise = np.random.default_rng([7, number]).standard_normal((1000, 3))[: stop - start]
        expected = actor.act(arrays["observations"][start:stop].astype(np.float64), noise)
        # observations are stored in float32, and actions are rounded to 1e-4
        assert np.abs(arrays["actions"][start:stop] - expected).max() <= 0.5e-4 + 1e-5
        assert np.array_equal(
            arrays["actions"][start:stop], np.round(arrays["actions"][start:stop].astype(float), 4).astype("f4")
        )


def test_deterministic_actions_are_the_means(policy: Path, tmp_path: Path) -> None:
    made = record(RecordingSpec(str(policy), "Hopper-v4", deterministic=True), tmp_path / "p.hdf5", n_episodes=1)
    arrays = read(made.path)
    expected = read_npz_policy(policy)[0].act(arrays["observations"].astype(np.float64))
    assert np.abs(arrays["actions"] - expected).max() <= 0.5e-4 + 1e-5
    assert made.attrs["behaviour_policy"] == "sac (hopper.npz), deterministic"


def test_added_noise_is_in_units_of_half_the_range_and_clipped(policy: Path) -> None:
    quiet = EpisodeRunner(RecordingSpec(str(policy), "Hopper-v4", deterministic=True)).run(0)
    noisy = EpisodeRunner(RecordingSpec(str(policy), "Hopper-v4", deterministic=True, noise=0.5)).run(0)
    added = 0.5 * np.random.default_rng([0, 0, 1]).standard_normal((1000, 3))[0]
    assert np.allclose(noisy["actions"][0], np.clip(quiet["actions"][0] + added, -1, 1), atol=1.01e-4)
    assert np.abs(noisy["actions"]).max() <= 1.0
    # a pendulum's torque goes from -2 to 2: the same noise is twice as large
    random = RecordingSpec("random", "Pendulum-v1")
    plain = EpisodeRunner(random).run(0)["actions"]
    wide = EpisodeRunner(RecordingSpec("random", "Pendulum-v1", noise=0.1)).run(0)["actions"]
    shift = 0.2 * np.random.default_rng([0, 0, 1]).standard_normal((200, 1))
    assert np.allclose(wide, np.clip(plain + shift, -2, 2), atol=1.01e-4)


def test_file_is_the_same_for_any_number_of_workers(policy: Path, tmp_path: Path) -> None:
    spec = RecordingSpec(str(policy), "Hopper-v4", seed=1)
    made = [record(spec, tmp_path / f"{n}.hdf5", n_rows=700, name="x-sb3", workers=n) for n in (1, 2)]
    assert made[0].path.read_bytes() == made[1].path.read_bytes()


def test_episodes_of_a_large_policy_side_by_side_are_those_one_by_one(tmp_path: Path) -> None:
    large = hopper_npz(tmp_path / "large.npz", width=256)
    runner = EpisodeRunner(RecordingSpec(str(large), "Hopper-v4", seed=2, noise=0.1))
    assert runner.width == SIDE_BY_SIDE > 1 == EpisodeRunner(RANDOM).width
    together, lengths = runner.run_many(0, 11)
    assert len(lengths) == 11 and len(set(lengths)) > 3
    single = concatenate([runner.run(number) for number in range(11)])
    assert all(np.array_equal(together[key], single[key]) for key in single)
    made = record(runner.spec, tmp_path / "x.hdf5", n_episodes=11)
    assert all(np.array_equal(array, single[key]) for key, array in read(made.path).items())


@pytest.mark.parametrize("size", [{"n_rows": 5}, {"n_episodes": 1}])
def test_small_recordings_run_no_episodes_beside_the_one_they_need(
    size: dict[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    widths, run = [], EpisodeRunner._run_side_by_side
    monkeypatch.setattr(EpisodeRunner, "_run_side_by_side", lambda self, them: widths.append(len(them)) or run(self, them))
    large = hopper_npz(tmp_path / "large.npz", width=256)
    record(RecordingSpec(str(large), "Hopper-v4"), tmp_path / "x.hdf5", **size)
    assert widths == [1]


def test_longer_recording_begins_with_the_shorter_one(tmp_path: Path) -> None:
    short, long = (read(record(RANDOM, tmp_path / f"{n}.hdf5", n_rows=n).path) for n in (50, 120))
    assert all(np.array_equal(long[key][:50], short[key]) for key in short)


def test_time_limit_is_a_timeout_and_no_terminal(tmp_path: Path) -> None:
    spec = RecordingSpec("random", "Pendulum-v1", max_episode_steps=5, next_observations=True)
    arrays = read(record(spec, tmp_path / "p.hdf5", n_rows=23).path)
    assert np.array_equal(np.flatnonzero(arrays["timeouts"]), [4, 9, 14, 19]) and not arrays["terminals"].any()
    inner = ~arrays["timeouts"][:-1]
    assert np.array_equal(arrays["next_observations"][:-1][inner], arrays["observations"][1:][inner])
    assert not np.isclose(arrays["next_observations"][:-1][~inner], arrays["observations"][1:][~inner]).all(axis=1).any()


def test_attributes_describe_the_file(policy: Path, tmp_path: Path) -> None:
    spec = RecordingSpec(str(policy), "hopper-medium-v2", seed=3, noise=0.1)
    made = record(spec, tmp_path / "mine-sb3.hdf5", n_rows=300)
    attrs, data = attributes(made.path), load_dataset(made.path)
    assert attrs == made.attrs
    assert (attrs["dataset_id"], attrs["generated"], attrs["env_id"]) == ("mine-sb3", True, "Hopper-v4")
    assert (attrs["behaviour_policy"], attrs["behaviour_source"]) == ("sac (hopper.npz), stochastic", "a test")
    assert attrs["behaviour_sha256"] == file_sha256(policy) and attrs["behaviour_licence"] == "MIT"
    assert (attrs["seed"], attrs["action_noise"], attrs["rows"], attrs["max_episode_steps"]) == (3, 0.1, 300, 1000)
    assert attrs["content_hash"] == content_hash(read(made.path))
    returns = data.info.episode_returns
    assert attrs["episodes"] == data.info.episodes == len(returns)
    for name, value in (("mean", returns.mean()), ("std", returns.std()), ("min", returns.min()), ("max", returns.max())):
        assert attrs[f"return_{name}"] == pytest.approx(value, rel=1e-6)
    assert f"numpy {np.__version__}" in attrs["versions"] and attrs["cpu_features"]
    assert made.score == pytest.approx(normalized_score("hopper-medium-v2", returns.mean()))


def test_recording_without_a_whole_episode_has_no_returns(tmp_path: Path) -> None:
    made = record(RecordingSpec("random", "Pendulum-v1"), tmp_path / "p.hdf5", n_rows=10)
    assert made.attrs["episodes"] == 0 and "return_mean" not in made.attrs and made.score is None


class Interrupt:
    """Presses Ctrl-C when so many rows are there."""

    def __init__(self, at: int) -> None:
        self.at = at

    def __call__(self, done: int, total: int) -> None:
        if done >= self.at:
            raise KeyboardInterrupt


@pytest.fixture
def frequent_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_dce.recording.recorder._PROGRESS_SECONDS", 0.0)


@pytest.mark.usefixtures("frequent_progress")
@pytest.mark.parametrize("flush_rows", [40, 10_000], ids=["many-parts", "one-part"])
def test_interrupted_recording_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flush_rows: int) -> None:
    monkeypatch.setattr("sb3_dce.recording.parts.FLUSH_ROWS", flush_rows)
    whole, out = record(RANDOM, tmp_path / "whole.hdf5", n_rows=400, name="x-sb3"), tmp_path / "x.hdf5"
    for at in (100, 250):
        with pytest.raises(KeyboardInterrupt):
            record(RANDOM, out, n_rows=400, progress=Interrupt(at))
        assert not out.exists()
    made = record(RANDOM, out, n_rows=400)
    assert out.read_bytes() == whole.path.read_bytes()
    assert 0 < made.new_rows < whole.new_rows - 200
    assert sorted(path.name for path in tmp_path.iterdir()) == ["whole.hdf5", "x.hdf5"]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="children are found as on Linux")
def test_workers_of_a_killed_recording_end_with_it(tmp_path: Path) -> None:
    code = (
        "import pathlib, sys; from sb3_dce.recording import RecordingSpec, parts, record; parts.FLUSH_ROWS = 1000; "
        "record(RecordingSpec('random', 'Pendulum-v1'), pathlib.Path(sys.argv[1]), n_rows=10**9, workers=2)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "x.hdf5")]) as parent:
        try:
            wait_until(lambda: len(list((tmp_path / "x.hdf5.parts").glob("*.npz"))) > 0)
            children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
        finally:
            parent.kill()
    workers = [Path("/proc") / pid for pid in children]
    assert len(workers) >= 2
    wait_until(lambda: not any(worker.exists() for worker in workers))


def wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.usefixtures("frequent_progress")
def test_interrupted_recording_is_not_mixed_with_another(tmp_path: Path) -> None:
    out, other = tmp_path / "x.hdf5", RecordingSpec("random", "Hopper-v4", seed=6)
    with pytest.raises(KeyboardInterrupt):
        record(RANDOM, out, n_rows=400, progress=Interrupt(100))
    with pytest.raises(ConfigError, match="seed=5 there, 6 now"):
        record(other, out, n_rows=100)
    assert record(other, out, n_rows=100, force=True).attrs["seed"] == 6


@pytest.mark.usefixtures("frequent_progress")
def test_damaged_part_is_reported(tmp_path: Path) -> None:
    out = tmp_path / "x.hdf5"
    with pytest.raises(KeyboardInterrupt):
        record(RANDOM, out, n_rows=400, progress=Interrupt(100))
    (part,) = (tmp_path / "x.hdf5.parts").glob("*.npz")
    part.write_bytes(part.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="damaged"):
        record(RANDOM, out, n_rows=400)


def test_existing_file_is_kept_unless_forced(tmp_path: Path) -> None:
    out = tmp_path / "x.hdf5"
    out.write_text("precious")
    with pytest.raises(ConfigError, match=r"the file exists.*--force"):
        record(RANDOM, out, n_rows=10)
    assert out.read_text() == "precious"
    assert record(RANDOM, out, n_rows=10, force=True).attrs["rows"] == 10


@pytest.mark.parametrize(
    ("name", "file", "env", "message"),
    [
        ("hopper-medium-v2", "x.hdf5", "Hopper-v4", "cannot be the id of generated data"),
        (None, "hopper_medium-v2.hdf5", "Hopper-v4", "official D4RL dataset"),
        ("halfcheetah-tiny-sb3", "x.hdf5", "HalfCheetah-v4", "comes with the package"),
        ("walker2d-medium-sb3", "x.hdf5", "Hopper-v4", "recorded in Walker2d-v4, not in Hopper-v4"),
        ("hopper-medium-sb3", "hopper-expert-sb3.hdf5", "Hopper-v4", "the file name says hopper-expert-sb3"),
        ("Not an id", "x.hdf5", "Hopper-v4", "cannot be the id"),
    ],
)
def test_names_of_other_data_are_refused(name: str | None, file: str, env: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        record(RecordingSpec("random", env), tmp_path / file, n_rows=10, name=name)
    assert list(tmp_path.iterdir()) == []


def test_folder_that_cannot_be_written_is_said_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="cannot write"):
        record(RANDOM, tmp_path / "file" / "x.hdf5", n_rows=10**9)
    (tmp_path / "folder").mkdir()
    with pytest.raises(CheckpointError, match=r"folder: a folder is no file to write\. Name a file in it"):
        record(RANDOM, tmp_path / "folder", n_rows=10**9)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"env": "Hoper-v4"}, "cannot make the environment 'Hoper-v4'.*Hopper"),
        ({"env": "CartPole-v1"}, "only vectors"),
        ({"env": "antmaze-umaze-v2"}, "no simulator"),
        ({"env": "Hopper-v4", "deterministic": True}, "no deterministic action"),
        ({"env": "Hopper-v4", "noise": -1.0}, "must not be negative"),
        ({"env": "Hopper-v4", "seed": -1}, "must not be negative"),
        ({"env": "Hopper-v4", "max_episode_steps": 0}, "at least 1"),
    ],
)
def test_impossible_recordings_are_refused(spec: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        record(RecordingSpec("random", **spec), tmp_path / "x.hdf5", n_rows=10)


@pytest.mark.parametrize("sizes", [{}, {"n_rows": 5, "n_episodes": 5}, {"n_rows": 0}, {"n_rows": 5, "workers": 0}])
def test_sizes_must_make_sense(sizes: dict[str, int], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="either rows or episodes"):
        record(RANDOM, tmp_path / "x.hdf5", **sizes)  # type: ignore[arg-type]


class Explodes(gym.Env):
    """Returns NaN in its third step; has no time limit."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space: ClassVar[spaces.Box] = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.n = 0
        return np.zeros(2), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.n += 1
        return np.full(2, np.nan if self.n == 3 else 0.0), 0.0, False, False, {}


@pytest.fixture
def exploding_env() -> str:
    gym.registry.pop("Explodes-v0", None)
    gym.register("Explodes-v0", entry_point=Explodes)
    return "Explodes-v0"


def test_environment_without_time_limit_needs_one(exploding_env: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no time limit"):
        record(RecordingSpec("random", exploding_env), tmp_path / "x.hdf5", n_rows=10)


def test_nan_of_the_simulator_is_never_written(exploding_env: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetSemanticsError, match=r"NaN.*episode 0"):
        record(RecordingSpec("random", exploding_env, max_episode_steps=5), tmp_path / "x.hdf5", n_rows=10)
    assert list(tmp_path.iterdir()) == []


class Reuses(gym.Env):
    """Returns its own array as observation, and limits the action in place."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space: ClassVar[spaces.Box] = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = np.zeros(1)
        return self.state, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = float(action[0])
        np.clip(action, -0.1, 0.1, out=action)
        self.state += 1.0
        return self.state, reward, False, False, {}


def test_arrays_that_the_environment_overwrites_are_recorded_as_they_were() -> None:
    gym.registry.pop("Reuses-v0", None)
    gym.register("Reuses-v0", entry_point=Reuses)
    spec = RecordingSpec("random", "Reuses-v0", max_episode_steps=5, next_observations=True)
    arrays = EpisodeRunner(spec).run(0)
    assert arrays["observations"].ravel().tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert arrays["next_observations"].ravel().tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert np.array_equal(arrays["actions"].ravel(), arrays["rewards"]) and np.abs(arrays["actions"]).max() > 0.1


def test_wrappers_that_change_rewards_stay() -> None:
    pytest.importorskip("gymnasium_robotics")
    raw, fixed = (
        EpisodeRunner(RecordingSpec("random", env, max_episode_steps=20)) for env in ("AdroitHandDoor-v1", "door-human")
    )
    rewards = [runner.run(0)["rewards"] for runner in (raw, fixed)]
    # the correction turns + 0.1 * distance into - 0.1 * distance, and the hand is some 0.2 m away
    assert (rewards[0] - rewards[1] > 0.01).all()
    assert fixed.limit == 20 and EpisodeRunner(RecordingSpec("random", "door-human")).limit == 200
    assert "door-human-v0" in raw.notes()[0] and fixed.notes() == ()


def test_environment_of_a_dataset_id_has_its_time_limit() -> None:
    assert EpisodeRunner(RecordingSpec("random", "walker2d-medium")).limit == 1000
    assert make_env("Pendulum-v1").action_space.shape == (1,)


def test_command_records_into_the_folder_of_datasets(policy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SB3_DCE_DATASETS", str(tmp_path))
    command = ("datasets", "record", "--policy", str(policy), "--env", "Hopper-v4", "--steps", "200", "--workers", "1")
    code, stdout, _ = sb3_dce(*command, "--name", "hopper-medium-sb3")
    assert code == 0 and "200 rows" in stdout and "score" in stdout and "steps per second" in stdout
    assert load_dataset("hopper-medium-sb3").info.file_rows == 200
    assert file_sha256(tmp_path / "hopper-medium-sb3.hdf5") in stdout
    code, _, stderr = sb3_dce(*command, "--name", "hopper-medium-sb3")
    assert code == 2 and stderr.startswith("Error: ") and "the file exists" in stderr
    assert sb3_dce(*command)[0] == 0 and (tmp_path / "hopper-v4-hopper-sb3.hdf5").is_file()


def test_command_interrupted_while_it_writes_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = ("datasets", "record", "--policy", "random", "--env", "Hopper-v4", "--steps", "200", "--workers", "1")
    command += ("--out", str(tmp_path / "x.hdf5"))

    def interrupted(*args: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("sb3_dce.recording.recorder.write_hdf5", interrupted)
        code, _, stderr = sb3_dce(*command)
    assert code == 130 and "the same command goes on" in stderr
    monkeypatch.setattr(EpisodeRunner, "run_many", interrupted)  # nothing is left to be recorded
    assert sb3_dce(*command)[0] == 0
    assert len(read(tmp_path / "x.hdf5")["rewards"]) == 200


@pytest.mark.parametrize("command", ["record", "generate"])
def test_help_warns_of_code_in_zip_files(command: str) -> None:
    result = CliRunner().invoke(cli.app, ["datasets", command, "--help"], env={"COLUMNS": "200"})
    assert result.exit_code == 0 and "runs code stored in it" in result.output


def test_command_records_what_its_options_say(policy: Path, tmp_path: Path) -> None:
    asked = ("--policy", str(policy), "--env", "Hopper-v4", "--workers", "1")
    options = ("--seed", "3", "--deterministic", "--noise", "0.2", "--max-episode-steps", "15", "--next-observations")
    outcome = sb3_dce("datasets", "record", *asked, *options, "--episodes", "3", "--out", str(tmp_path / "command.hdf5"))
    assert outcome.code == 0, outcome.stderr
    spec = RecordingSpec(
        str(policy), "Hopper-v4", seed=3, deterministic=True, noise=0.2, max_episode_steps=15, next_observations=True
    )
    record(spec, tmp_path / "python.hdf5", n_episodes=3)
    one, other = read(tmp_path / "command.hdf5"), read(tmp_path / "python.hdf5")
    assert one.keys() == other.keys() >= {"next_observations"} and len(ends(one)) == 3
    assert all(np.array_equal(one[key], other[key]) for key in one)
    assert ends(one)[0] <= 14
    other_rows = ("datasets", "record", *asked, "--steps", "9", "--out", str(tmp_path / "command.hdf5"))
    assert sb3_dce(*other_rows).code == 2 and sb3_dce(*other_rows, "--force").code == 0
    assert len(read(tmp_path / "command.hdf5")["rewards"]) == 9


def test_command_reads_a_zip_file_as_it_is_told(tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), norm_reward=False)
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu").learn(32)
    model.policy.action_net.weight.data.mul_(100.0)  # so that observations that are not normalised would be seen
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "vecnormalize.pkl"))
    files = ("--policy", str(tmp_path / "model.zip"), "--vecnormalize", str(tmp_path / "vecnormalize.pkl"))
    command = ("datasets", "record", *files, "--env", "Pendulum-v1", "--steps", "5", "--deterministic", "--workers", "1")
    wrong = sb3_dce(*command, "--out", str(tmp_path / "wrong.hdf5"), "--algo", "sac")
    assert wrong.code == 2 and not (tmp_path / "wrong.hdf5").exists()
    right = sb3_dce(*command, "--out", str(tmp_path / "right.hdf5"), "--algo", "ppo")
    assert right.code == 0, right.stderr
    arrays = read(tmp_path / "right.hdf5")
    expected, _ = model.predict(env.normalize_obs(arrays["observations"]), deterministic=True)
    np.testing.assert_allclose(arrays["actions"], expected, atol=2e-4)  # the recorder rounds actions
