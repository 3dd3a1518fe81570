"""Who may import whom, so that a file can be read without the rest."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_dce

PACKAGE = Path(sb3_dce.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
ALGORITHMS = ("dce.py", "dce_variants.py", "dce_probe.py", "bc.py", "td3_bc.py", "iql.py", "sac.py", "cql.py", "pbrl.py")
ALGORITHMS += ("uwac.py",)


def imported(path: Path) -> set[str]:
    """Full names of all modules a file imports, at its top or inside a function."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imported(path)}


def test_losses_import_torch_only() -> None:
    assert roots(PACKAGE / "losses.py") <= {"__future__", "collections", "math", "torch"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_its_own_module_imports_a_special_package(path: Path) -> None:
    relative = path.relative_to(PACKAGE).as_posix()
    if not relative.startswith("data/"):
        assert "h5py" not in roots(path)
    if not relative.startswith("zoo/"):
        assert "rl_zoo3" not in roots(path)
        assert not any(name.startswith("sb3_dce.zoo.") for name in imported(path))
    if relative not in ("plots.py", "report/figures.py", "experiments/figures.py"):
        assert "matplotlib" not in roots(path)


@pytest.mark.parametrize("path", sorted((PACKAGE / "data").glob("*.py")), ids=lambda path: path.name)
def test_data_know_no_algorithm(path: Path) -> None:
    assert "torch" not in roots(path) and "stable_baselines3" not in roots(path)
    assert not any(name.startswith(("sb3_dce.dce", "sb3_dce.bc", "sb3_dce.base")) for name in imported(path))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_algorithms_know_neither_files_nor_commands(name: str) -> None:
    own = {part for part in imported(PACKAGE / name) if part.startswith("sb3_dce.")}
    assert not own & {"sb3_dce.data", "sb3_dce.runs", "sb3_dce.launch", "sb3_dce.cli", "sb3_dce.plots"}
    assert "pandas" not in roots(PACKAGE / name)


def test_the_package_is_imported_without_torch_and_adds_little_to_stable_baselines3() -> None:
    """Help texts and errors about files must not wait for it; agents and evaluation wait for no simulator or compiler."""
    code = (
        "import sys, sb3_dce; assert 'torch' not in sys.modules\n"
        "import stable_baselines3; before = set(sys.modules)\n"
        "sb3_dce.OfflineDCE; import sb3_dce.evaluation; assert 'torch' in sys.modules\n"
        "heavy = {'mujoco', 'torch._dynamo', 'torch._inductor', 'scipy', 'pandas', 'matplotlib', 'minari'}\n"
        "added = heavy & set(sys.modules) - before; assert not added, added"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_bare_exception_is_raised(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and isinstance(node.exc.func, ast.Name):
            assert node.exc.func.id not in ("Exception", "BaseException"), f"line {node.lineno}"
