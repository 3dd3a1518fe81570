"""What is shipped, and what an import needs."""

from __future__ import annotations

import configparser
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
OPTIONAL = ["gymnasium_robotics", "matplotlib", "mujoco", "optuna", "rl_zoo3", "tensorboard"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Names of the files in the wheel, built from a copy so that the checkout stays clean."""
    pytest.importorskip("build")
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("sb3_dce", "zoo_hyperparams"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml", "LICENSE", "README.md"):
        if (ROOT / name).is_file():
            shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(source)]
    run = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    (path,) = folder.glob("*.whl")
    return set(zipfile.ZipFile(path).namelist())


def _files(folder: str, pattern: str) -> set[str]:
    return {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob(pattern)}


def test_wheel_contains_every_module_and_data_file(wheel: set[str]) -> None:
    assert {name for name in _files("sb3_dce", "*.*") if not name.endswith(".pyc")} <= wheel


def test_wheel_contains_embedded_datasets(wheel: set[str]) -> None:
    assert {name for name in wheel if name.endswith(".hdf5")} == _files("sb3_dce/data/files", "*.hdf5") != set()


def test_wheel_contains_the_hyperparameters_as_a_sub_package(wheel: set[str]) -> None:
    shipped = {name for name in wheel if name.startswith("sb3_dce/zoo_hyperparams/")}
    assert shipped == {f"sb3_dce/{name}" for name in _files("zoo_hyperparams", "*.yml") | {"zoo_hyperparams/__init__.py"}}


def test_wheel_contains_nothing_else(wheel: set[str]) -> None:
    assert {name.split("/")[0].split("-")[0] for name in wheel} == {"sb3_dce"}
    assert any(name.endswith("licenses/LICENSE") for name in wheel)


def test_every_sub_package_is_listed() -> None:
    config = configparser.ConfigParser(interpolation=None)
    config.read(ROOT / "setup.cfg")
    listed = set(config["options"]["packages"].split())
    on_disk = {path.parent.relative_to(ROOT).as_posix().replace("/", ".") for path in (ROOT / "sb3_dce").rglob("__init__.py")}
    assert listed == on_disk | {"sb3_dce.zoo_hyperparams"}


def test_import_needs_no_optional_package() -> None:
    block = f"import sys; sys.modules.update(dict.fromkeys({OPTIONAL!r}))"
    code = f"{block}; import sb3_dce; sb3_dce.OfflineDCE(policy='MlpPolicy', dataset='halfcheetah-tiny-sb3', device='cpu')"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_torch_is_pinned_first() -> None:
    pins = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert pins[0].startswith("torch==")
    assert all("==" in pin and "/" not in pin for pin in pins)
