"""Recipes of the ``-sb3`` datasets: which policy, how many rows, and SAC where there is no policy."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import sb3_dce

from sb3_dce import load_dataset
from sb3_dce.data import D4RLFile, file_sha256, resolve, write_hdf5
from sb3_dce.errors import CheckpointError, ConfigError, DatasetError, DatasetFormatError, DatasetNotFoundError
from sb3_dce.numpy_policy import MLPPolicy
from sb3_dce.recording import RecordingSpec
from sb3_dce.recording.episodes import EpisodeRunner
from sb3_dce.recording.generate import MEDIUM_TARGETS, POLICIES_VARIABLE, Sources, Training, generate, recipes
from sb3_dce.recording.policy_files import read_npz_policy, write_npz_policy
from sb3_dce.recording.sac_run import SACRun, SACSettings

TINY_SAC = {"eval_freq": 60, "n_eval_episodes": 1, "learning_starts": 20, "batch_size": 8, "net_arch": (8,)}
ANY_RETURN, NO_RETURN = -1e9, 1e9


def write_policy(path: Path, dims: tuple[int, int], seed: int = 0) -> Path:
    rng = np.random.default_rng(seed)
    layers = [(0.3 * rng.normal(size=(dims[0], 8)), np.zeros(8)), (0.3 * rng.normal(size=(8, dims[1])), np.zeros(dims[1]))]
    box = np.ones(dims[1])
    policy = MLPPolicy(layers, "tanh", -box, box, squash="draw", log_std=np.full(dims[1], -1.0))
    path.parent.mkdir(exist_ok=True)
    write_npz_policy(policy, path, {"algo": "test", "source": f"seed {seed}", "licence": "MIT"})
    return path


@pytest.fixture
def policies(tmp_path: Path) -> Path:
    """A folder like that of the known names, with sub-folders."""
    write_policy(tmp_path / "policies" / "sac-Hopper.npz", (11, 3), seed=1)
    write_policy(tmp_path / "policies" / "locomotion" / "tqc-Hopper.npz", (11, 3), seed=2)
    return tmp_path / "policies"


@pytest.fixture(autouse=True)
def no_policies_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(POLICIES_VARIABLE, raising=False)


def read(path: Path) -> dict[str, np.ndarray]:
    with D4RLFile(path) as file:
        return {key: array[slice(None)] for key, array in file.select(file.keys).items()}


def test_recipes_cover_the_stand_ins() -> None:
    known = recipes()
    kinds = ("random", "medium", "medium-replay", "medium-expert", "expert")
    gym = {f"{task}-{kind}-sb3" for task in MEDIUM_TARGETS for kind in kinds}
    adroit = {f"{task}-{kind}-sb3" for task in ("pen", "hammer", "door", "relocate") for kind in ("expert", "noisyexpert25")}
    assert set(known) == gym | adroit | {"hopper-replay-402k-sb3", "door-human-replayed-sb3"}
    rows = {dataset_id: recipe.rows for dataset_id, recipe in known.items()}
    assert rows["walker2d-random-sb3"] == rows["walker2d-medium-sb3"] == rows["walker2d-expert-sb3"] == 1_000_000
    assert rows["walker2d-medium-expert-sb3"] == 2_000_000
    assert (rows["pen-expert-sb3"], rows["door-expert-sb3"]) == (500_000, 1_000_000)
    assert known["pen-noisyexpert25-sb3"].episodes == 25


def test_generated_file_is_found_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SB3_DCE_DATASETS", str(tmp_path))
    made = generate("hopper-random-sb3", rows=150)
    assert made.path == tmp_path / "hopper-random-sb3.hdf5"
    data, spec = load_dataset("hopper-random-sb3"), resolve("hopper-random-sb3")
    assert data.info.id == spec.id and data.info.file_rows == 150
    assert (spec.env_id, spec.max_episode_steps, spec.ref_max_score) == ("Hopper-v4", 1000, 3234.3)
    assert made.attrs["dataset_id"] == "hopper-random-sb3" and made.score is not None


def test_policy_is_found_in_the_folder_and_its_folders(
    policies: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[str] = []
    made = generate("hopper-medium-sb3", tmp_path, Sources(policies=policies), rows=50, note=notes.append)
    assert made.attrs["behaviour_sha256"] == file_sha256(policies / "sac-Hopper.npz")
    assert made.attrs["behaviour_source"] == "seed 1" and "sac-Hopper.npz" in notes[0]
    monkeypatch.setenv(POLICIES_VARIABLE, os.pathsep.join([str(tmp_path / "nowhere"), str(policies)]))
    made = generate("hopper-expert-sb3", tmp_path, rows=50)
    assert made.attrs["behaviour_source"] == "seed 2"


def test_given_policy_wins_over_the_folder(policies: Path, tmp_path: Path) -> None:
    mine = write_policy(tmp_path / "mine.npz", (11, 3), seed=3)
    made = generate("hopper-medium-sb3", tmp_path, Sources(policy=mine, policies=policies), rows=50)
    assert made.attrs["behaviour_policy"] == "test (mine.npz), stochastic" and made.attrs["behaviour_source"] == "seed 3"


def test_sets_of_one_environment_and_seeds_start_in_different_states(policies: Path, tmp_path: Path) -> None:
    sources = Sources(policies=policies)
    firsts = [
        read(generate(name, tmp_path / str(seed), sources, rows=5, seed=seed).path)["observations"][0]
        for name in ("hopper-random-sb3", "hopper-medium-sb3", "hopper-expert-sb3")
        for seed in (0, 1)
    ]
    assert len({first.tobytes() for first in firsts}) == 6


def test_medium_expert_is_whole_expert_episodes_and_then_medium(policies: Path, tmp_path: Path) -> None:
    made = generate("hopper-medium-expert-sb3", tmp_path, Sources(policies=policies), rows=400)
    joined, expert, medium = (read(tmp_path / f"hopper-{kind}-sb3.hdf5") for kind in ("medium-expert", "expert", "medium"))
    cut = int(np.flatnonzero(expert["terminals"] | expert["timeouts"])[-1]) + 1
    assert len(expert["rewards"]) == len(medium["rewards"]) == 200 and cut < 200
    assert set(joined) == {"observations", "actions", "rewards", "terminals", "timeouts"}
    for key, array in joined.items():
        assert np.array_equal(array, np.concatenate([expert[key][:cut], medium[key]])), key
    attrs = made.attrs
    assert (attrs["rows"], attrs["expert_rows"], attrs["medium_rows"]) == (cut + 200, cut, 200)
    assert (attrs["expert_behaviour_source"], attrs["medium_behaviour_source"]) == ("seed 2", "seed 1")
    # its parts are there now: they are joined again, not recorded
    before = (tmp_path / "hopper-expert-sb3.hdf5").stat().st_mtime_ns
    generate("hopper-medium-expert-sb3", tmp_path, rows=300, force=True)
    assert (tmp_path / "hopper-expert-sb3.hdf5").stat().st_mtime_ns == before
    with pytest.raises(DatasetError, match=r"has 200 rows, 500 are wanted"):
        generate("hopper-medium-expert-sb3", tmp_path, rows=1000, force=True)


def test_adroit_expert_is_recorded_with_the_corrections(tmp_path: Path) -> None:
    pytest.importorskip("gymnasium_robotics")
    policy = write_policy(tmp_path / "p.npz", (45, 24))
    made = generate("pen-noisyexpert25-sb3", tmp_path, Sources(policy=policy))
    arrays = read(made.path)
    assert made.attrs["episodes"] == 25 and made.attrs["env_id"] == "AdroitHandPen-v1"
    # the pen falls out of a hand that moves at random: D4RL's end, which the package's environment does not have
    assert arrays["terminals"].sum() > 0 and made.attrs["max_episode_steps"] == 100
    stops = np.flatnonzero(arrays["terminals"] | arrays["timeouts"]) + 1
    assert len(stops) == 25 and np.diff(stops, prepend=0).max() <= 100


@pytest.mark.parametrize(
    ("dataset", "sources", "error", "message"),
    [
        ("hopper-medium-v2", {}, ConfigError, "official D4RL dataset.*Did you mean hopper-medium-sb3"),
        ("halfcheetah-tiny-sb3", {}, ConfigError, "a file of the package"),
        ("hopper-mediun-sb3", {}, DatasetError, "unknown dataset"),
        ("hopper-random-sb3", {"policy": Path("p.npz")}, ConfigError, "not made from a policy.*random"),
        ("hopper-medium-sb3", {"buffer": Path("b.hdf5")}, ConfigError, "not made from a buffer.*--policy"),
        ("hopper-medium-replay-sb3", {"policy": Path("p.npz")}, ConfigError, "not made from a policy.*--buffer"),
        ("hopper-medium-expert-sb3", {"policy": Path("p.npz")}, ConfigError, "hopper-medium-sb3 and hopper-expert-sb3 first"),
        ("pen-expert-sb3", {}, DatasetNotFoundError, r"pen-v0\.npz not found.*--policy"),
        ("door-human-replayed-sb3", {}, DatasetNotFoundError, "door-human_replayed.*--buffer"),
        ("hopper-replay-402k-sb3", {}, DatasetNotFoundError, "--buffer"),
        (
            "hopper-medium-sb3",
            {"policies": Path("nowhere")},
            DatasetNotFoundError,
            "sac-Hopper.*train SAC here, which takes hours",
        ),
    ],
)
def test_what_cannot_be_made_is_said(
    dataset: str, sources: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        generate(dataset, tmp_path, Sources(**sources), rows=10)
    assert list(tmp_path.iterdir()) == []


def buffer_file(path: Path, obs_dim: int = 11) -> Path:
    rng = np.random.default_rng(0)
    ends = np.zeros(60, dtype=bool)
    ends[[19, 39]] = True
    arrays = {
        "observations": rng.normal(size=(60, obs_dim)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (60, 3)).astype(np.float32),
        "rewards": rng.normal(size=60).astype(np.float32),
        "terminals": ends & (np.arange(60) < 30),
        "timeouts": ends & (np.arange(60) >= 30),
        "infos/qpos": np.zeros((60, 6)),
    }
    write_hdf5(path, arrays, {"made_by": "a test"})
    return path


def test_buffer_keeps_its_rows_and_flags(tmp_path: Path) -> None:
    source = buffer_file(tmp_path / "b.hdf5")
    made = generate("hopper-medium-replay-sb3", tmp_path, Sources(buffer=source), rows=50)
    given, written = read(source), read(made.path)
    assert set(written) == {"observations", "actions", "rewards", "terminals", "timeouts"}
    assert all(np.array_equal(written[key], given[key][:50]) for key in written)
    assert made.attrs["behaviour_sha256"] == file_sha256(source) and made.attrs["generated"]
    assert (made.attrs["episodes"], made.attrs["terminals"], made.attrs["timeouts"]) == (2, 1, 1)


def test_buffer_with_fewer_rows_than_are_wanted_is_refused(tmp_path: Path) -> None:
    source = buffer_file(tmp_path / "b.hdf5")
    with pytest.raises(DatasetError, match=r"b\.hdf5: has 60 rows, 70 are wanted.*fewer --rows"):
        generate("hopper-medium-replay-sb3", tmp_path, Sources(buffer=source), rows=70)
    training = Training(ANY_RETURN, {**TINY_SAC, "max_steps": 60})
    with pytest.raises(DatasetError, match=r"hopper-sac-seed0: has 60 rows, 70 are wanted"):
        generate("hopper-medium-replay-sb3", tmp_path, training=training, rows=70)


@pytest.mark.parametrize(("kind", "rows", "fewest"), [("random", 0, 1), ("medium-expert", 1, 2)])
def test_too_few_rows_are_refused_before_anything_is_recorded(kind: str, rows: int, fewest: int, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"must be at least {fewest}, got {rows}"):
        generate(f"hopper-{kind}-sb3", tmp_path, rows=rows)
    assert list(tmp_path.iterdir()) == []


def test_buffer_of_another_environment_is_refused(tmp_path: Path) -> None:
    source = buffer_file(tmp_path / "b.hdf5", obs_dim=17)
    with pytest.raises(DatasetFormatError, match="width 17, 11 is wanted"):
        generate("hopper-medium-replay-sb3", tmp_path, Sources(buffer=source))


# -- training of what is missing -----------------------------------------------------------------------------------------


def sac_run(folder: Path, target: float, max_steps: int = 180, task: str = "hopper", **changes: Any) -> SACRun:
    settings = SACSettings(max_steps=max_steps, **{**TINY_SAC, **changes.pop("settings", {})})
    return SACRun(f"{task}-medium-sb3", target, 0, folder, settings, **changes)


def test_missing_medium_and_replay_are_stages_of_one_run(tmp_path: Path) -> None:
    training = Training(ANY_RETURN, {**TINY_SAC, "max_steps": 120})
    replay = generate("hopper-medium-replay-sb3", tmp_path, training=training)
    state = json.loads((tmp_path / "training" / "hopper-sac-seed0" / "state.json").read_text())
    assert state["steps"] == state["medium_at"] == replay.attrs["rows"] == 60
    medium = generate("hopper-medium-sb3", tmp_path, training=training, rows=40)
    policy = tmp_path / "training" / "hopper-sac-seed0" / "medium.npz"
    assert medium.attrs["behaviour_sha256"] == file_sha256(policy) and "SAC" in medium.attrs["behaviour_source"]
    # nothing was trained a second time; the expert goes on with the same run
    assert json.loads((policy.parent / "state.json").read_text()) == state
    expert = generate("hopper-expert-sb3", tmp_path, training=training, rows=40)
    assert expert.attrs["behaviour_sha256"] == file_sha256(policy.with_name("expert.npz")) != file_sha256(policy)
    assert json.loads((policy.parent / "state.json").read_text())["expert_at"] == 120
    assert (
        len(generate("hopper-medium-replay-sb3", tmp_path, training=training, force=True).attrs)
        and load_dataset(tmp_path / "hopper-medium-replay-sb3.hdf5").info.file_rows == 60
    )


def test_training_is_only_announced_when_there_is_some(tmp_path: Path) -> None:
    training = Training(ANY_RETURN, {**TINY_SAC, "max_steps": 60})
    first, again = [], []
    generate("hopper-medium-replay-sb3", tmp_path, training=training, note=first.append)
    generate("hopper-medium-sb3", tmp_path, training=training, rows=5, note=again.append)
    folder = tmp_path / "training" / "hopper-sac-seed0"
    assert first[0] == f"no buffer given or found: that of the SAC run in {folder}"
    assert first[1].startswith("training SAC from step 0 on") and "return" in first[2]
    assert again == [f"no policy given or found: that of the SAC run in {folder}"]


def test_replay_is_the_buffer_with_true_terminals_and_timeouts(tmp_path: Path) -> None:
    run = sac_run(tmp_path, ANY_RETURN, settings={"eval_freq": 120})
    rows, buffer = run.replay(), run._loaded_model().replay_buffer
    assert buffer is not None and rows["observations"].dtype == np.float32
    assert np.array_equal(rows["actions"], buffer.actions[:120, 0])
    dones, timeouts = buffer.dones[:120, 0] > 0, buffer.timeouts[:120, 0] > 0
    assert np.array_equal(rows["terminals"], dones & ~timeouts) and np.array_equal(rows["timeouts"], timeouts)
    # Hopper falls long before its limit of 1000 steps
    assert rows["terminals"].sum() >= 2 and not rows["timeouts"].any()
    inner = ~rows["terminals"][:-1]
    assert np.allclose(buffer.next_observations[:119, 0][inner], rows["observations"][1:][inner], atol=1e-5)


def test_time_limit_in_the_replay_is_a_timeout(tmp_path: Path) -> None:
    settings = {"eval_freq": 1010, "learning_starts": 2000}
    rows = sac_run(tmp_path, ANY_RETURN, 1010, task="halfcheetah", settings=settings).replay()
    assert np.flatnonzero(rows["timeouts"]).tolist() == [999] and not rows["terminals"].any()


def test_target_out_of_reach_is_said_with_the_best_return(tmp_path: Path) -> None:
    run = sac_run(tmp_path, NO_RETURN, max_steps=60)
    with pytest.raises(ConfigError, match=r"has not reached a mean return of 1e\+09 in 60 steps, its best is \d+.*--seed"):
        run.replay()


def test_policy_of_the_run_is_its_actor_and_evaluations_are_its_returns(tmp_path: Path) -> None:
    run = sac_run(tmp_path, ANY_RETURN)
    policy, facts = read_npz_policy(run.medium())
    model, obs = run._loaded_model(), np.random.default_rng(0).normal(size=(20, 11))
    assert np.abs(policy.act(obs) - model.predict(obs, deterministic=True)[0]).max() <= 1e-5
    assert facts.source is not None and "seed 0" in facts.source
    ((steps, mean, _),) = run.evaluations
    runner = EpisodeRunner(RecordingSpec("given", "Hopper-v4", 2**32, deterministic=True), policy)
    assert steps == 60 and mean == pytest.approx(runner.run(0)["rewards"].sum(), rel=1e-5)


class Interrupt:
    def __init__(self, at: int) -> None:
        self.at = at

    def __call__(self, done: int, total: int) -> None:
        if done >= self.at:
            raise KeyboardInterrupt


def test_interrupted_training_goes_on_from_its_last_evaluation(tmp_path: Path) -> None:
    stopped = sac_run(tmp_path, NO_RETURN, progress=Interrupt(100))
    with pytest.raises(KeyboardInterrupt):
        stopped.expert()
    assert stopped._loaded_model().num_timesteps == 60
    resumed = sac_run(tmp_path, NO_RETURN)
    assert resumed.steps == 60
    before = resumed._rows()
    model = resumed._loaded_model()
    buffer = model.replay_buffer
    assert buffer is not None and model.num_timesteps == buffer.pos == 60
    assert np.array_equal(buffer.observations[:60, 0], before["observations"])
    assert np.array_equal(buffer.next_observations[:60, 0], before["next_observations"])
    # the open episode has ended like at a time limit, in the buffer and for good
    assert buffer.dones[59, 0] == 1
    was_open = not (before["terminals"][59] or before["timeouts"][59])
    assert bool(buffer.timeouts[59, 0]) == was_open
    assert read_npz_policy(resumed.expert())[0].obs_dim == 11
    again = sac_run(tmp_path, NO_RETURN)
    assert [steps for steps, _, _ in again.evaluations] == [60, 120, 180]
    rows = again._rows()
    assert len(rows["rewards"]) == 180 and bool(rows["timeouts"][59]) == was_open
    assert np.array_equal(rows["rewards"][:60], before["rewards"])


def test_part_that_a_killed_run_left_is_no_part_of_the_longer_one(tmp_path: Path) -> None:
    sac_run(tmp_path, NO_RETURN, max_steps=60).expert()
    before = {path: path.read_bytes() for path in (tmp_path / "state.json", tmp_path / "model-60.zip")}
    sac_run(tmp_path, NO_RETURN, max_steps=90).expert()
    for path, content in before.items():  # as if it had been killed when it had written its rows
        path.write_bytes(content)
    longer = sac_run(tmp_path, NO_RETURN, max_steps=120)
    longer.expert()
    assert {path.name for path in (tmp_path / "replay").iterdir()} == {"0-60.npz", "60-90.npz", "60-120.npz"}
    buffer = longer._loaded_model().replay_buffer
    assert buffer is not None and np.array_equal(longer._rows()["actions"], buffer.actions[:120, 0])


@pytest.mark.parametrize("text", ["[]", "1", '"text"', "{", '{"config": {}}', "steps", "evaluations", "cuts"])
def test_damaged_state_of_a_run_is_said(text: str, tmp_path: Path) -> None:
    run = sac_run(tmp_path, ANY_RETURN)
    run.medium()
    state = json.loads((tmp_path / "state.json").read_text())
    if text in state:
        del state[text]
        text = json.dumps(state)
    (tmp_path / "state.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"state\.json: damaged.*Delete the folder"):
        sac_run(tmp_path, ANY_RETURN)


def test_run_is_only_continued_with_its_own_settings(tmp_path: Path) -> None:
    sac_run(tmp_path, ANY_RETURN).medium()
    with pytest.raises(ConfigError, match="batch_size=8 there, 16 now"):
        sac_run(tmp_path, ANY_RETURN, settings={"batch_size": 16})
    with pytest.raises(ConfigError, match="more than 30"):
        sac_run(tmp_path, ANY_RETURN, max_steps=30).expert()
    with pytest.raises(ConfigError, match="eval_freq must be at least 1"):
        SACSettings(eval_freq=0)


def test_command_says_what_it_uses(policies: Path, tmp_path: Path) -> None:
    arguments = ("hopper-medium-sb3", "--policies", str(policies), "--rows", "60", "--folder", str(tmp_path), "--workers", "1")
    code, stdout, stderr = sb3_dce("datasets", "generate", *arguments)
    assert code == 0, stderr
    assert "sac-Hopper.npz" in stdout and "60 rows" in stdout


def test_command_makes_what_its_options_say(tmp_path: Path) -> None:
    mine = write_policy(tmp_path / "mine.npz", (11, 3), seed=3)
    options = ("--rows", "40", "--seed", "5", "--workers", "1", "--folder")
    outcome = sb3_dce("datasets", "generate", "hopper-medium-sb3", "--policy", str(mine), *options, str(tmp_path / "command"))
    assert outcome.code == 0, outcome.stderr
    made = generate("hopper-medium-sb3", tmp_path / "python", Sources(policy=mine), rows=40, seed=5)
    one, other = read(tmp_path / "command" / "hopper-medium-sb3.hdf5"), read(made.path)
    assert all(np.array_equal(one[key], other[key]) for key in other)
    buffer = ("--buffer", str(buffer_file(tmp_path / "buffer.hdf5")), "--folder", str(tmp_path))
    outcome = sb3_dce("datasets", "generate", "hopper-medium-replay-sb3", *buffer)
    assert outcome.code == 0, outcome.stderr
    assert np.array_equal(
        read(tmp_path / "hopper-medium-replay-sb3.hdf5")["rewards"], read(tmp_path / "buffer.hdf5")["rewards"]
    )


def test_command_trains_what_is_missing_as_it_is_told(tmp_path: Path) -> None:
    told = ("--target", "4321", "--train-steps", "20", "--folder", str(tmp_path))
    outcome = sb3_dce("datasets", "generate", "hopper-medium-sb3", *told)
    assert outcome.code == 2 and "4321" in outcome.stderr and "20 steps" in outcome.stderr


# -- the policies the roles name, where they are at hand -----------------------------------------------------------------

# Return and length of one deterministic episode, seed 0, as published with the converted policies.
PROOF = {
    "a2c-HalfCheetah": (3125.6, 1000),
    "a2c-Hopper": (697.5, 267),
    "a2c-Walker2d": (633.6, 254),
    "ppo-HalfCheetah": (5874.0, 1000),
    "ppo-Hopper": (2441.1, 1000),
    "ppo-Walker2d": (599.4, 180),
    "sac-HalfCheetah": (9395.1, 1000),
    "sac-Hopper": (1079.3, 293),
    "sac-Walker2d": (3862.3, 1000),
    "tqc-HalfCheetah": (12078.5, 1000),
    "tqc-Hopper": (3659.0, 1000),
    "tqc-Walker2d": (4486.0, 1000),
    "trpo-HalfCheetah": (1863.8, 1000),
    "trpo-Hopper": (3628.6, 1000),
    "trpo-Walker2d": (5355.4, 1000),
    "pen-v0": (2836.4, 100),
    "hammer-v0": (16373.3, 200),
    "door-v0": (3029.9, 200),
    "relocate-v0": (2296.0, 200),
}
FOLDERS = [Path(folder) for folder in os.environ.get(POLICIES_VARIABLE, "").split(os.pathsep) if folder]


@pytest.mark.slow
@pytest.mark.skipif(not FOLDERS, reason=f"needs the public policies in ${POLICIES_VARIABLE}")
@pytest.mark.parametrize("name", PROOF)
def test_public_policies_reach_their_published_returns(name: str) -> None:
    path = next(found for folder in FOLDERS for found in folder.glob(f"**/{name}.npz"))
    env = f"{name.removesuffix('-v0')}-human-v0" if name.endswith("-v0") else f"{name.partition('-')[2]}-v4"
    rewards = EpisodeRunner(RecordingSpec(str(path), env, deterministic=True)).run(0)["rewards"]
    expected, length = PROOF[name]
    assert len(rewards) == length and rewards.sum(dtype=np.float64) == pytest.approx(expected, abs=0.06)
