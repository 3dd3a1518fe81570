"""Machines that are not like ours: no home folder, folders that may not be read, few cores, no headers, other encodings."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch as th

import sb3_dce
from sb3_dce import OfflineDCE, execution, load_dataset, processes
from sb3_dce.data import available, find_file, locate, memory
from sb3_dce.errors import ConfigError, DatasetNotFoundError, DatasetWarning, SB3DCEWarning
from sb3_dce.evaluation import evaluate
from sb3_dce.processes import prepare_worker, usable_cores, worker_pool
from sb3_dce.rollouts import make_rollouts

TINY = "halfcheetah-tiny-sb3"
CHECKOUT = Path(sb3_dce.__file__).parents[1]


def python(code: str, *, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run([sys.executable, "-c", code], cwd=cwd, env=env, capture_output=True, text=True)


# -- files and folders -------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not (CHECKOUT / "zoo_hyperparams").is_dir(), reason="not a checkout")
def test_a_checkout_works_without_being_installed(tmp_path: Path) -> None:
    """As it does when ``pip install .`` was made and Python is started in the checkout."""
    code = f"""
import sys
sys.meta_path = [finder for finder in sys.meta_path if "__editable__" not in repr(finder)]
sys.path.insert(0, {str(CHECKOUT)!r})
from sb3_dce import OfflineDCE
print(OfflineDCE.load_dataset({TINY!r}).beta_rate)
"""
    done = python(code, cwd=tmp_path)
    assert done.stdout.strip() == "0.5", done.stderr


def test_no_home_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(Path, "expanduser", _no_home)
    assert locate.search_folders() == [] and find_file(TINY)[0].is_file()
    assert len(load_dataset(TINY)) > 0
    with pytest.raises(ConfigError, match=r"no home folder.*\$XDG_CACHE_HOME"):
        locate.cache_folder()
    with pytest.raises(DatasetNotFoundError, match="not found"):
        find_file("walker2d-medium")
    with pytest.raises(DatasetNotFoundError, match="no such file"):
        find_file("~nobody/data.hdf5")
    monkeypatch.setenv("SB3_DCE_DATASETS", str(tmp_path))
    assert locate.search_folders() == [tmp_path]


def test_rows_are_kept_without_a_home_folder_where_there_is_a_place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(Path, "expanduser", _no_home)
    copy = shutil.copy(find_file(TINY)[0], tmp_path / "mine.hdf5")
    assert len(load_dataset(copy, cache=True)) > 0 and len(list((tmp_path / ".sb3_dce_rows").iterdir())) == 2
    with pytest.warns(DatasetWarning, match=r"rows not kept.*no home folder"):
        assert len(load_dataset(TINY, cache=True)) > 0


def _no_home(path: Path) -> Path:
    if str(path).startswith("~"):
        raise RuntimeError("Could not determine home directory.")
    return path


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("limits", "free"),
    [
        ({}, 1_024_000),  # what the machine has
        ({"": 900_000}, 600_000),  # 900,000 less 400,000, of which 100,000 are pages of files
        ({"job": 700_000, "": 900_000}, 400_000),
        ({"job": 2**63 - 4096}, 1_024_000),
        ({"job/step": 300_000}, 0),
    ],
    ids=str,
)
def test_free_memory_is_what_a_container_or_a_batch_job_leaves(
    version: int, limits: dict[str, int], free: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    proc, groups = tmp_path / "proc", tmp_path / "cgroup"
    (proc / "self").mkdir(parents=True)
    (proc / "meminfo").write_text("MemTotal: 2000 kB\nMemAvailable: 1000 kB\n")
    lines = {1: "5:cpu,cpuacct:/elsewhere\n4:memory:/job/step\n", 2: "0::/job/step\n"}
    (proc / "self/cgroup").write_text(lines[version])
    limit, usage = {1: ("limit_in_bytes", "usage_in_bytes"), 2: ("max", "current")}[version]
    prefix, root = {1: ("total_", groups / "memory"), 2: ("", groups)}[version]
    for name in ("job/step", "job", ""):
        (root / name).mkdir(parents=True, exist_ok=True)
        (root / name / f"memory.{limit}").write_text(f"{limits.get(name, 'max')}\n")
        (root / name / f"memory.{usage}").write_text("400000\n")
        counts = f"{prefix}active_file 60000\n{prefix}inactive_file 40000\n"
        (root / name / "memory.stat").write_text(f"anon 1\n{counts}")
    monkeypatch.setattr(memory, "PROC", proc)
    monkeypatch.setattr(memory, "CONTROL_GROUPS", groups)
    assert memory.free_memory() == free


def test_a_folder_that_may_not_be_read_is_passed_over(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    original = os.stat

    def stat(path: Any, *args: Any, **kwargs: Any) -> os.stat_result:
        if str(path).startswith(str(tmp_path / "private")):
            raise PermissionError(13, "Permission denied", str(path))
        return original(path, *args, **kwargs)

    monkeypatch.setenv("SB3_DCE_DATASETS", str(tmp_path / "private"))
    monkeypatch.setattr(os, "stat", stat)
    assert TINY in [spec.id for spec, _ in available()]
    with pytest.raises(DatasetNotFoundError):
        find_file("antmaze-large-diverse-v2")


# -- processors and compilers ------------------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be limited here")
def test_cores_that_this_process_may_not_use_do_not_count() -> None:
    code = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
    code += "from sb3_dce.processes import usable_cores; print(usable_cores())"
    assert python(code).stdout.strip() == "1"
    assert usable_cores() == len(os.sched_getaffinity(0))


def test_more_workers_than_windows_can_have_are_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    assert worker_pool(64, prepare_worker)._max_workers == 64
    monkeypatch.setattr(processes, "os", SimpleNamespace(name="nt"))
    assert worker_pool(64, prepare_worker)._max_workers == 61


def test_a_compiler_without_the_headers_of_python_is_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(execution.shutil, "which", lambda name: "/usr/bin/g++")
    monkeypatch.setattr(execution.sysconfig, "get_path", lambda name: str(tmp_path))
    with pytest.warns(SB3DCEWarning, match="headers of Python"):
        assert execution.choose_execution("compile", 10**6, th.device("cpu")) == "eager"
    (tmp_path / "Python.h").touch()
    assert execution.choose_execution("compile", 10**6, th.device("cpu")) == "compile"


def test_the_line_that_says_what_is_wrong_is_shown() -> None:
    text = "CppCompileError: C++ compile error\n\nCommand:\ng++ x.cpp\n\nOutput:\nx.cpp:1:10: fatal error: omp.h: No such file"
    assert execution._cause(RuntimeError(text)) == "x.cpp:1:10: fatal error: omp.h: No such file"
    assert execution._cause(RuntimeError("")) == "RuntimeError" and execution._cause(RuntimeError("a\nb")) == "a"


def test_another_default_device_changes_no_evaluation() -> None:
    model = OfflineDCE.load_dataset(TINY, seed=0, policy_kwargs={"net_arch": [8]}, device="cpu")
    rollouts = make_rollouts(TINY, 1)
    assert rollouts is not None
    expected = evaluate(model, rollouts, seed=0).returns
    with th.device("meta"):
        assert evaluate(model, rollouts, seed=0).returns == expected


# -- terminals ---------------------------------------------------------------------------------------------------------


def test_commands_and_paths_are_printed_to_be_copied(tmp_path: Path) -> None:
    folder = tmp_path / "a folder with blanks and a name that is longer than a line of a terminal would ever want it to be"
    code = "import sys; sys.argv[0] = 'sb3-dce'; from sb3_dce.cli import main; main()"
    small = ["--updates", "2", "--eval-freq", "2", "--eval-episodes", "1", "--set", "policy_kwargs={net_arch: [4]}"]
    arguments = [sys.executable, "-c", code, "train", TINY, "--algo", "bc", *small, "--out", str(folder), "--workers", "1"]
    env = {**os.environ, "COLUMNS": "60", "OMP_NUM_THREADS": "1", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(arguments, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"next   sb3-dce evaluate '{folder}/seed_0/model.zip'\n" in done.stdout
    assert f"saved  {folder}/seed_*/model.zip, config.yml" in done.stdout
    evaluated = subprocess.run(
        [sys.executable, "-c", code, "evaluate", str(folder / "seed_0" / "model.zip"), "--episodes", "1"],
        **{"env": env, "capture_output": True, "text": True},
    )
    assert evaluated.returncode == 0 and "return" in evaluated.stdout, evaluated.stderr  # ± is not ASCII
