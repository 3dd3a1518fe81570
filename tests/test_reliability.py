"""Kills, damage and second processes: what is lost is little, and what is wrong is said, never used."""

from __future__ import annotations

import errno
import json
import os
import random
import signal
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch as th
from commands import sb3_dce
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback

from sb3_dce import OfflineDCE, OfflineIQL, files, runs, saving
from sb3_dce.errors import CheckpointError, ConfigError, DatasetWarning, DivergenceError, SB3DCEWarning
from sb3_dce.evaluation import EvaluationCallback
from sb3_dce.execution import Engine
from sb3_dce.locking import held
from sb3_dce.population import Population
from sb3_dce.population_runs import BatchedRuns
from sb3_dce.processes import UninterruptedBlock, threads_from_environment
from sb3_dce.run_files import RunSpec, read_divergence, read_result
from sb3_dce.runs import alone, run
from sb3_dce.saving import saved_algo

TINY = "halfcheetah-tiny-sb3"
SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "execution": "eager"}


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.zip"
    OfflineDCE.load_dataset(TINY, seed=0, **SMALL).learn(3).save(path)
    return path


# -- damaged models ----------------------------------------------------------------------------------------------------


def flipped(saved: Path, offset: int, target: Path) -> Path:
    content = bytearray(saved.read_bytes())
    content[offset] ^= 0x10
    target.write_bytes(content)
    return target


def test_a_flipped_bit_in_any_part_of_a_model_is_found(saved: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        infos = archive.infolist()
    assert len(infos) > 6
    for info in infos:
        content_at = info.header_offset + 30 + len(info.filename.encode())
        path = flipped(saved, content_at + info.compress_size // 2, tmp_path / "model.zip")
        with pytest.raises(CheckpointError, match=r"damaged|cannot be read|not a saved model"):
            OfflineDCE.load(path)


def test_bits_flipped_anywhere_end_in_words_or_do_no_harm(saved: Path, tmp_path: Path) -> None:
    rng, whole = random.Random(0), OfflineDCE.load(saved).policy.state_dict()
    found = 0
    for _ in range(60):
        path = flipped(saved, rng.randrange(saved.stat().st_size), tmp_path / "model.zip")
        try:
            loaded = OfflineDCE.load(path).policy.state_dict()
        except (CheckpointError, ConfigError):
            found += 1
        else:  # a field of the archive that nobody reads, such as a date
            assert all(th.equal(loaded[key], whole[key]) for key in whole)
    assert found > 50


@pytest.mark.parametrize("name", ["data", "policy.pth", "pytorch_variables.pth", "actor.optimizer.pth"])
def test_model_without_one_of_its_parts(name: str, saved: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(tmp_path / "model.zip", "w") as new:
        assert name in old.namelist()
        for info in old.infolist():
            if info.filename != name:
                new.writestr(info.filename, old.read(info))
    with pytest.raises(CheckpointError, match=r"missing|not a saved model"):
        OfflineDCE.load(tmp_path / "model.zip")


@pytest.mark.parametrize(
    "change", [{"algo": ["x"]}, {"observation_space": 1}, {"dataset": 5}, {"policy_class": None}], ids=str
)
def test_model_with_a_wrong_field_is_refused_by_the_command_in_words(
    change: dict[str, Any], saved: Path, tmp_path: Path
) -> None:
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(tmp_path / "model.zip", "w") as new:
        for info in old.infolist():
            content = old.read(info)
            if info.filename == "data":
                content = json.dumps({**json.loads(content), **change}).encode()
            new.writestr(info.filename, content)
    result = sb3_dce("evaluate", str(tmp_path / "model.zip"))
    assert result.code == 2 and "Traceback" not in result.stderr and "model.zip" in result.stderr


def test_arguments_that_do_not_fit_the_model_are_not_called_damage(saved: Path, make_point_mass: Any) -> None:
    with pytest.raises(ConfigError, match="spaces do not match"):
        OfflineDCE.load(saved, env=make_point_mass())
    with pytest.raises(ConfigError, match="policy kwargs do not equal"):
        OfflineDCE.load(saved, policy_kwargs={"net_arch": [9]})


def test_every_bit_of_the_directory_of_a_model(saved: Path, tmp_path: Path) -> None:
    """Names, sizes, flags of the zip file: refused, or of no consequence; never another error."""
    content, whole = saved.read_bytes(), OfflineDCE.load(saved).policy.state_dict()
    with zipfile.ZipFile(saved) as archive:
        start = archive.start_dir  # the tensors are zip files with directories of their own
    path, passed = tmp_path / "model.zip", 0
    for offset in range(start, min(start + 120, len(content))):
        for bit in range(8):
            damaged = bytearray(content)
            damaged[offset] ^= 1 << bit
            path.write_bytes(damaged)
            try:
                algo = saved_algo(path)
                saving._refuse_damage(path)
            except CheckpointError:
                continue
            passed += 1
            assert algo == "dce", (offset, bit)
            if passed % 40 == 0:  # loading takes most of the time
                loaded = OfflineDCE.load(path).policy.state_dict()
                assert all(th.equal(loaded[key], whole[key]) for key in whole), (offset, bit)
    assert 40 < passed < 500


def test_wrong_arguments_are_not_called_damage(saved: Path) -> None:
    for arguments in ({"device": "foo"}, {"seed": -1}, {"env": 5}, {"custom_objects": [1]}):
        with pytest.raises(Exception) as caught:
            OfflineDCE.load(saved, **arguments)  # type: ignore[arg-type]
        assert not isinstance(caught.value, CheckpointError), arguments


def test_numbers_that_are_not_finite_are_neither_saved_nor_loaded(saved: Path, tmp_path: Path) -> None:
    model = OfflineDCE.load_dataset(TINY, ent_coef="auto", **SMALL).learn(2)
    first = next(iter(model.actor.optimizer.state.values()))["exp_avg"]
    for tensor in (model.log_ent_coef, first):
        kept = tensor.detach().clone()
        with th.no_grad():
            tensor.fill_(float("nan"))
        with pytest.raises(DivergenceError, match=r"refusing to save.*not finite"):
            model.save(tmp_path / "bad.zip")
        with th.no_grad():
            tensor.copy_(kept)
    model.save(tmp_path / "bad.zip")
    policy = th.load(zipfile.ZipFile(tmp_path / "bad.zip").open("policy.pth"))
    policy["actor.mu.bias"].fill_(float("inf"))
    with zipfile.ZipFile(tmp_path / "bad.zip") as old, zipfile.ZipFile(tmp_path / "worse.zip", "w") as new:
        for info in old.infolist():
            if info.filename != "policy.pth":
                new.writestr(info.filename, old.read(info))
        with new.open("policy.pth", "w") as stream:
            th.save(policy, stream)
    with pytest.raises(CheckpointError, match=r"cannot be used.*actor.mu.bias"):
        OfflineDCE.load(tmp_path / "worse.zip")


# -- runs --------------------------------------------------------------------------------------------------------------


def spec(folder: Path, n_updates: int, algo: str = "dce", **overrides: Any) -> RunSpec:
    return RunSpec(algo, TINY, 0, n_updates, str(folder), 10, 1, {**SMALL, **overrides})


def test_a_run_whose_learning_rate_follows_its_length_is_not_made_longer(tmp_path: Path) -> None:
    run(spec(tmp_path / "iql", 20, "offline_iql", actor_lr_schedule="cosine"))
    with pytest.raises(ConfigError, match="n_updates=20 there, 30 now"):
        run(spec(tmp_path / "iql", 30, "offline_iql", actor_lr_schedule="cosine"))
    run(spec(tmp_path / "plain", 20, "offline_iql", actor_lr_schedule="constant"))
    assert run(spec(tmp_path / "plain", 30, "offline_iql", actor_lr_schedule="constant"))["n_updates"] == 30


def test_what_is_resumed_is_executed_as_it_was_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planned: list[int] = []
    original = OfflineDCE._bound_engine

    def note(self: OfflineDCE, planned_updates: int) -> Any:
        planned.append(planned_updates)
        return original(self, planned_updates)

    monkeypatch.setattr(OfflineDCE, "_bound_engine", note)
    run(spec(tmp_path, 20))
    run(spec(tmp_path, 30))
    assert set(planned[:20]) == {20} and set(planned[20:]) == {30}, "not what remains, 10"
    assert OfflineDCE.load(tmp_path / "model.zip").planned_updates is None


def test_a_second_process_leaves_a_run_alone(tmp_path: Path) -> None:
    tmp_path.joinpath("run").mkdir()
    members = [spec(tmp_path / "run", 10), replace(spec(tmp_path / "other", 10), seed=1)]
    with alone(tmp_path / "run"), pytest.raises(CheckpointError, match=r"another process is at this run: process \d+.*--out"):
        run(spec(tmp_path / "run", 10))
    with alone(tmp_path / "run"), pytest.raises(CheckpointError, match="another process is at this run"):
        BatchedRuns(members, th.device("cpu"), "eager", Console(quiet=True)).run()
    assert read_result(tmp_path / "run") is None
    # whatever a process that is gone has written there: the system has freed its lock
    (tmp_path / "run" / ".lock").write_text(json.dumps({"pid": os.getpid(), "host": "another"}))
    assert run(spec(tmp_path / "run", 10))["n_updates"] == 10
    assert not (tmp_path / "run" / ".lock").exists()


def test_lock_of_a_killed_process_is_free(tmp_path: Path) -> None:
    code = "import sys, time\nfrom pathlib import Path\nfrom sb3_dce.locking import held\n"
    code += "with held(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path / ".lock")], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        with pytest.raises(BlockingIOError, match=f"process {other.pid}"), held(tmp_path / ".lock"):
            pass
        other.kill()
        other.wait()
    with held(tmp_path / ".lock"):
        pass
    assert not (tmp_path / ".lock").exists()


def test_file_system_without_locks_is_said_and_worked_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fcntl = pytest.importorskip("fcntl")

    def no_locks(*_: Any) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with pytest.warns(SB3DCEWarning, match=r"has no locks \(No locks available\); let one process at a time work there"):
        run(spec(tmp_path / "run", 10))
    result = read_result(tmp_path / "run")
    assert result is not None and result["n_updates"] == 10 and not (tmp_path / "run" / ".lock").exists()


def test_run_that_another_process_completed_meanwhile_is_not_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = runs._model

    def slow(asked: RunSpec, folder: Path) -> Any:
        model = original(asked, folder)
        monkeypatch.setattr(runs, "_model", original)
        run(spec(tmp_path / "run", 20))
        return model

    monkeypatch.setattr(runs, "_model", slow)
    with pytest.raises(ConfigError, match="n_updates=20 there, 10 now"):
        run(spec(tmp_path / "run", 10))
    result = read_result(tmp_path / "run")
    assert result is not None and result["n_updates"] == 20


def test_run_folder_that_cannot_be_written_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(runs, "held", full)
    with pytest.raises(CheckpointError, match=r"cannot write: No space left on device.*free space"):
        run(spec(tmp_path / "run", 10))


def test_lengths_that_do_not_end_with_an_evaluation_are_refused(tmp_path: Path) -> None:
    result = sb3_dce("train", TINY, "--updates", "30", "--eval-freq", "20", "--out", str(tmp_path / "run"))
    assert result.code == 2 and "do not end with an evaluation" in result.stderr and not (tmp_path / "run").exists()


def test_folder_that_cannot_be_written_is_said_before_training(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    callback = EvaluationCallback(None, None, eval_freq=5, folder=tmp_path / "file" / "below", save_checkpoint=True)
    model = OfflineDCE.load_dataset(TINY, **SMALL)
    with pytest.raises(CheckpointError, match="cannot write"):
        model.learn(10, callback)
    assert model.num_timesteps == 0


def test_member_whose_moments_overflowed_does_not_end_the_others(tmp_path: Path) -> None:
    members = [replace(spec(tmp_path / str(seed), 20), seed=seed) for seed in range(2)]
    batched = BatchedRuns(members, th.device("cpu"), "eager", Console(quiet=True))
    original = Population.commit

    def overflow(self: Population) -> Any:
        models = original(self)
        next(iter(models[1].critic.optimizer.state.values()))["exp_avg_sq"].fill_(float("inf"))
        return models

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Population, "commit", overflow)
        with pytest.raises(DivergenceError, match="1 of 2 members diverged"):
            batched.run()
    assert read_result(tmp_path / "0") is not None and read_result(tmp_path / "1") is None
    assert read_divergence(tmp_path / "1") is not None


# -- interruptions -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_waits_for_the_end_of_an_update() -> None:
    steps: list[str] = []
    with pytest.raises(KeyboardInterrupt), UninterruptedBlock():
        signal.raise_signal(signal.SIGINT)
        steps.append("after the first")
    assert steps == ["after the first"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt), UninterruptedBlock():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        steps.append("never")
    with pytest.raises(ValueError, match="own"), UninterruptedBlock():
        signal.raise_signal(signal.SIGINT)
        raise ValueError("own")
    assert steps == ["after the first"]


@pytest.mark.usefixtures("ctrl_c")
def test_interrupted_model_is_whole_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    model, straight = (OfflineIQL.load_dataset(TINY, seed=0, actor_lr_schedule="constant", **SMALL) for _ in range(2))
    straight.learn(20, log_interval=None)
    original, calls = Engine.step, 0

    def step(self: Engine, *args: Any, **kwargs: Any) -> None:
        """Ctrl-C when the batch is drawn, or when the networks are written and nothing is counted yet."""
        nonlocal calls
        calls += 1
        if calls % 5 == 0:
            signal.raise_signal(signal.SIGINT)
        original(self, *args, **kwargs)
        if calls % 7 == 0:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Engine, "step", step)
    interruptions = 0
    while model._n_updates < 20:
        try:
            model.learn(20 - model._n_updates, reset_num_timesteps=False, log_interval=None)
        except KeyboardInterrupt:
            interruptions += 1
        trained = [getattr(model, name).optimizer for name in ("actor", "critic", "value_net")]
        steps = {float(state["step"]) for optimizer in trained for state in optimizer.state.values()}
        assert steps == {float(model._n_updates)} and model.num_timesteps == model._n_updates
    assert interruptions == 6
    assert all(th.equal(a, b) for a, b in zip(model.policy.parameters(), straight.policy.parameters(), strict=True))


@pytest.mark.usefixtures("ctrl_c")
def test_counters_agree_after_an_interruption_in_a_callback() -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 13:
                raise KeyboardInterrupt
            return True

    model = OfflineDCE.load_dataset(TINY, gradient_steps=10, **SMALL)
    with pytest.raises(KeyboardInterrupt):
        model.learn(40, Stop())
    assert model.num_timesteps == model._n_updates == 20


def test_what_killed_writers_left_is_removed_by_the_next_one(tmp_path: Path) -> None:
    ended = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    old = tmp_path / f".model.zip.{ended.stdout.strip()}.abc.tmp"
    young, other = old.with_name(old.name.replace("abc", "def")), tmp_path / f".else.zip.{ended.stdout.strip()}.abc.tmp"
    ours = tmp_path / f".model.zip.{os.getpid()}.abc.tmp"
    for path in (old, young, other, ours):
        path.write_bytes(b"half")
    for path in (old, other, ours):
        os.utime(path, (0, 0))
    with files.write_atomically(tmp_path / "model.zip") as stream:
        stream.write(b"whole")
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"model.zip", young.name, other.name, ours.name}


@pytest.mark.skipif(os.name == "nt", reason="not everybody may make links there")
@pytest.mark.parametrize("there", [True, False])
def test_link_to_a_file_stays_one(there: bool, tmp_path: Path) -> None:
    link, file = tmp_path / "page.md", tmp_path / "elsewhere" / "page.md"
    link.symlink_to(Path("elsewhere") / "page.md")
    if there:
        files.write_text(file, "old")
    files.check_writable(link)
    files.write_text(link, "new")
    assert link.is_symlink() and file.read_text() == "new" and len(list(file.parent.iterdir())) == 1


def test_names_that_can_be_no_file_are_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="a folder is no file to write"):
        files.check_writable(tmp_path)
    with pytest.raises(CheckpointError, match="cannot write"):
        files.check_writable(tmp_path / ("x" * 300) / "model.zip")


# -- surroundings ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("text", "threads"), [(None, 0), ("", 0), ("2,1", 2), (" 3 ", 3), ("many", 0)])
def test_number_of_threads_from_the_environment(text: str | None, threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if text is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", text)
    assert threads_from_environment() == threads


def test_fewer_rows_than_a_batch_are_said(random_transitions: Any) -> None:
    with pytest.warns(DatasetWarning, match="27 rows for batches of 256"):
        OfflineDCE.load_dataset(random_transitions(30), **{**SMALL, "batch_size": 256}).learn(1)
