"""Who may import whom, so that a file can be read without the rest."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import sb3_dce

PACKAGE = Path(sb3_dce.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
ALGORITHMS = ("dce.py", "dce_variants.py", "dce_probe.py", "bc.py", "td3_bc.py", "iql.py", "sac.py", "cql.py", "pbrl.py")
ALGORITHMS += ("uwac.py",)


def imported(path: Path) -> set[str]:
    """Full names of all modules a file imports, at its top or inside a function, for more than its annotations."""
    names: set[str] = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    blocks = [node for node in ast.walk(tree) if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    for block in blocks:
        block.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def beginning_with(path: Path, *modules: str) -> set[str]:
    """What a file imports of some modules or of what is below them."""
    return {name for name in imported(path) if any(name == m or name.startswith(f"{m}.") for m in modules)}


def roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imported(path)}


def test_losses_import_torch_only() -> None:
    assert roots(PACKAGE / "losses.py") <= {"__future__", "collections", "math", "torch"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_its_own_module_imports_a_special_package(path: Path) -> None:
    relative = path.relative_to(PACKAGE).as_posix()
    if relative != "data/hdf5.py":
        assert "h5py" not in roots(path)
    if not relative.startswith(("experiments/", "cli")):
        assert not beginning_with(path, "sb3_dce.experiments")
    if not relative.startswith("zoo/"):
        assert "rl_zoo3" not in roots(path)
        assert not beginning_with(path, "sb3_dce.zoo")
    if relative not in ("plots.py", "report/figures.py", "experiments/figures.py"):
        assert "matplotlib" not in roots(path)


def test_no_module_imports_itself_through_others() -> None:
    """Imports inside functions included, since these only hide a circle; those for type checkers are none."""
    modules = {".".join(("sb3_dce", *path.relative_to(PACKAGE).with_suffix("").parts)): path for path in FILES}
    imports = {name: imported(path) & (modules.keys() - {name}) for name, path in modules.items()}
    TopologicalSorter(imports).prepare()  # CycleError names the circle


@pytest.mark.parametrize("path", sorted((PACKAGE / "data").glob("*.py")), ids=lambda path: path.name)
def test_data_know_no_algorithm(path: Path) -> None:
    assert "torch" not in roots(path) and "stable_baselines3" not in roots(path)
    others = [
        f"sb3_dce.{name.removesuffix('.py')}" for name in (*ALGORITHMS, "base.py", "attaching.py", "buffers.py", "runs.py")
    ]
    assert not beginning_with(path, *others)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_algorithms_know_neither_files_nor_commands(name: str) -> None:
    # choosing rows of a dataset in memory is theirs; what it was read from is not
    memory = ("sb3_dce.data.transitions", "sb3_dce.data.selection")
    known = beginning_with(PACKAGE / name, "sb3_dce.data") - beginning_with(PACKAGE / name, *memory)
    assert not known
    assert not beginning_with(PACKAGE / name, *(f"sb3_dce.{m}" for m in ("runs", "launch", "cli", "plots", "training", "zoo")))
    assert not {"pandas", "h5py"} & roots(PACKAGE / name)


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


@cache
def own_errors() -> set[str]:
    """Names of this package's errors, wherever they are defined."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in FILES]
    classes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    family = {"SB3DCEError"}
    for _ in classes:  # more rounds than there are generations
        family |= {node.name for node in classes if family & {ast.unparse(base) for base in node.bases}}
    return family


def errors_without_hint(path: Path) -> list[int]:
    """Lines in which one of this package's errors is made without saying what to do."""
    family = own_errors()
    calls = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    made = [call for call in calls if isinstance(call.func, ast.Name) and call.func.id in family]
    keywords = {call.lineno: {keyword.arg for keyword in call.keywords} for call in made}
    return [line for line, names in keywords.items() if not names & {"hint", None}]  # None stands for **keywords


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_every_error_says_what_to_do(path: Path) -> None:
    assert {"ConfigError", "StoppedError", "ResultsError"} <= own_errors()
    assert errors_without_hint(path) == []


def test_rules_find_what_breaks_them(tmp_path: Path) -> None:
    path = tmp_path / "bad.py"
    path.write_text(
        "from sb3_dce.data.hdf5 import D4RLFile\nfrom sb3_dce.iql import update\nraise ConfigError('no', key='x')\n",
        encoding="utf-8",
    )
    assert beginning_with(path, "sb3_dce.data") == {"sb3_dce.data.hdf5", "sb3_dce.data.hdf5.D4RLFile"}
    assert beginning_with(path, "sb3_dce.iql") and not beginning_with(path, "sb3_dce.iq")
    assert errors_without_hint(path) == [3]
