"""
Damaged files by the thousand: each gives the same dataset, an error of this package, or, where the format has no checksum and
no hash is known, other numbers, which are counted.

Mutants are read in a child process of their own, limited to 8 GiB, in which a mutant that takes 10 s is a hang; when the child
dies, the next one goes on behind the mutant that killed it. ``SB3_DCE_FUZZ=10000`` tries that many HDF5 files in place of
2,000. ``python tests/test_fuzz.py table 10000`` prints the table of docs/reliability.md.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pandas as pd
import pytest
from dataset_files import base_arrays, write_plain

from sb3_dce.data import Transitions, file_sha256, load_transitions, write_hdf5
from sb3_dce.data.hash_record import record_path, write_record
from sb3_dce.data.layout import MATRIX_KEYS
from sb3_dce.errors import ConfigError, DatasetError

SEED = 20
ADDRESS_SPACE = 8 * 2**30
N_HDF5 = int(os.environ.get("SB3_DCE_FUZZ", "2000"))

Mutate = Callable[[bytes, np.random.Generator], bytes]


# -- mutations -----------------------------------------------------------------------------------------------------


def flip(content: bytes, rng: np.random.Generator, n: int = 1) -> bytes:
    changed = bytearray(content)
    for position in rng.choice(len(content), n, replace=False):
        changed[position] ^= int(rng.integers(1, 256))
    return bytes(changed)


def flip_several(content: bytes, rng: np.random.Generator) -> bytes:
    return flip(content, rng, int(rng.integers(2, 9)))


def cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: rng.integers(len(content))]


def insert(content: bytes, rng: np.random.Generator) -> bytes:
    position = int(rng.integers(len(content)))
    return content[:position] + rng.bytes(int(rng.integers(1, 9))) + content[position:]


def lose_block(content: bytes, rng: np.random.Generator) -> bytes:
    """Zeros in place of 512 bytes, as after a lost sector."""
    start = int(rng.integers(max(1, len(content) - 512)))
    return content[:start] + bytes(min(512, len(content) - start)) + content[start + 512 :]


BYTE_MUTATIONS: dict[str, Mutate] = {
    "one byte": flip,
    "2 to 8 bytes": flip_several,
    "cut short": cut,
    "inserted": insert,
    "lost block": lose_block,
}
# The last ones would execute code, or grow without end, in a reader that is not careful.
ODD_VALUES: list[Any] = [None, True, -1, 10**30, 1e308, float("nan"), "", "x" * 10_000, "../../etc/passwd", [], {}, [[]] * 3]
ODD_TEXTS = [
    "[" * 100_000,
    '{"a":' * 20_000,
    "9" * 10_000,
    "!!python/object/apply:os.mkdir [executed]",
    "!!python/name:os.mkdir",
    "{a: !!python/object/new:os.mkdir [executed]}",
    "a: &a [x, x]\nb: &b [*a, *a, *a, *a]\nc: &c [*b, *b, *b, *b]\nd: [*c, *c, *c, *c]",
    "&a [*a]",
    "\0",
    "\ufeff{}",
    "- - - :",
    '"\\ud800"',
    "=1+1",
    "2026-99-99",
    "__import__('os').mkdir('executed')",
]


def odd_value(content: bytes, rng: np.random.Generator) -> bytes:
    """JSON with another value somewhere."""
    document = json.loads(content)
    place: Any = document
    while True:
        keys = list(place) if isinstance(place, dict) else range(len(place))
        key = keys[int(rng.integers(len(keys)))]
        if not (isinstance(place[key], dict | list) and place[key] and rng.random() < 0.8):
            break
        place = place[key]
    if rng.random() < 0.2 and isinstance(place, dict):
        del place[key]
    else:
        place[key] = ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
    return json.dumps(document).encode()


def odd_text(content: bytes, rng: np.random.Generator) -> bytes:
    text = ODD_TEXTS[int(rng.integers(len(ODD_TEXTS)))].encode("utf-8", "surrogatepass")
    position = int(rng.integers(len(content) + 1))
    return (text, content[:position] + text + content[position:])[int(rng.integers(2))]


# -- what is read --------------------------------------------------------------------------------------------------


def write_csv(path: Path, arrays: dict[str, np.ndarray]) -> None:
    columns = {}
    for key, array in arrays.items():
        columns |= {f"{key}_{i}": array[:, i] for i in range(array.shape[1])} if key in MATRIX_KEYS else {key: array}
    pd.DataFrame(columns).to_csv(path, index=False)


def write_with_record(path: Path, arrays: dict[str, np.ndarray]) -> None:
    data = path.with_name("data.hdf5")
    write_plain(data, arrays)
    write_record(data, file_sha256(data), "https://example.org/data.hdf5")
    record = record_path(data)
    fields = json.loads(record.read_text()) | {"mtime_ns": 1}  # so that the hash is looked at
    path.write_text(json.dumps(fields))
    record.unlink()


def read_with_record(path: Path) -> Transitions:
    data = path.with_name("data.hdf5")
    os.replace(path, record_path(data))
    return load_transitions(data)


def write_minari(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """The metadata; the episodes of the dataset are written beside them."""
    with h5py.File(path.with_name("main_data.hdf5"), "w") as file:
        for number in range(5):
            group, rows = file.create_group(f"episode_{number}"), slice(40 * number, 40 * number + 40)
            last = arrays["next_observations"][rows][-1:]
            group["observations"] = np.concatenate([arrays["observations"][rows], last])
            group["actions"], group["rewards"] = arrays["actions"][rows], arrays["rewards"][rows]
            group["terminations"], group["truncations"] = arrays["terminals"][rows], arrays["timeouts"][rows]
            group.attrs.update(id=number, total_steps=40)
    box = {"type": "Box", "dtype": "float32", "shape": [3], "low": [-10.0] * 3, "high": [10.0] * 3}
    metadata = {
        "dataset_id": "mine/data-v0",
        "total_episodes": 5,
        "total_steps": 200,
        "data_format": "hdf5",
        "observation_space": json.dumps(box),
        "action_space": json.dumps(box | {"shape": [2], "low": [-1.0] * 2, "high": [1.0] * 2}),
        "env_spec": json.dumps({"id": "Hopper-v4", "entry_point": "nowhere:Env", "kwargs": {}}),
        "minari_version": "0.5.3",
    }
    path.write_text(json.dumps(metadata))


def read_minari(path: Path) -> Transitions:
    return Transitions.from_minari(path.parent)


def write_yaml(path: Path, arrays: dict[str, np.ndarray]) -> None:
    path.write_text("beta: 2.0\nnet_arch: [256, 256]\nname: dce\n")


def read_yaml(path: Path) -> Any:
    from sb3_dce.cli import _parse_overrides

    return _parse_overrides([f"key={path.read_bytes().decode('utf-8', 'surrogateescape')}"])


@dataclass(frozen=True)
class Target:
    """
    A kind of file.

    :param file_name: of the mutant
    :param write: writes the undamaged file
    :param read: reads a mutant
    :param mutations: name to function
    :param has_hash: whether the file can be recorded with its hash
    :param share: mutants, as a share of those of both kinds of HDF5 together
    :param hang_seconds: time after which a mutant is a hang
    """

    file_name: str
    write: Callable[[Path, dict[str, np.ndarray]], object]
    read: Callable[[Path], Any]
    mutations: dict[str, Mutate] = field(default_factory=lambda: BYTE_MUTATIONS)
    has_hash: bool = True
    share: float = 0.5
    hang_seconds: int = 10

    def count(self, n_hdf5: int) -> int:
        """
        :param n_hdf5: mutants of both kinds of HDF5 together
        :return: mutants of this kind
        """
        return int(self.share * n_hdf5)


TEXT_MUTATIONS: dict[str, Mutate] = {**BYTE_MUTATIONS, "odd text": odd_text}
JSON_MUTATIONS: dict[str, Mutate] = {**TEXT_MUTATIONS, "odd value": odd_value}
TARGETS = {
    "HDF5, plain": Target("mine.hdf5", write_plain, Transitions.from_hdf5),
    "HDF5, gzip and fletcher32": Target("mine.hdf5", write_hdf5, Transitions.from_hdf5),
    "NPZ": Target("mine.npz", lambda path, arrays: np.savez(path, **arrays), Transitions.from_npz, share=0.15),
    "CSV": Target("mine.csv", write_csv, Transitions.from_csv, TEXT_MUTATIONS, share=0.15),
    "hash record (JSON)": Target("record.json", write_with_record, read_with_record, JSON_MUTATIONS, False, 0.1),
    "Minari metadata (JSON)": Target("metadata.json", write_minari, read_minari, JSON_MUTATIONS, False, 0.1),
    "settings (YAML)": Target("settings.yml", write_yaml, read_yaml, TEXT_MUTATIONS, False, 0.1),
}


def misbehaving(how: Callable[[], object]) -> Target:
    """A reader that misbehaves at each mutant with one changed byte."""

    def read(path: Path) -> str:
        if path.read_bytes() != b"0" * 100 and path.stat().st_size == 100:
            how()
        return "read"

    mutations: dict[str, Mutate] = {"one byte": flip, "inserted": insert}
    return Target("mine.txt", lambda path, arrays: path.write_bytes(b"0" * 100), read, mutations, False, hang_seconds=1)


def hang() -> None:
    while True:
        pass


MISBEHAVING = {
    "crash, signal 11": misbehaving(lambda: os.kill(os.getpid(), signal.SIGSEGV)),
    "hang": misbehaving(hang),
    "escaped": misbehaving(lambda: {}["x"]),
    "escaped: memory": misbehaving(lambda: bytearray(9 * 2**30)),
    "escaped: code": misbehaving(lambda: os.mkdir("executed")),
}


# -- the child -----------------------------------------------------------------------------------------------------


def mutant(target: Target, content: bytes, number: int) -> tuple[str, bytes]:
    """
    :param target: kind of file
    :param content: undamaged file
    :param number: of the mutant
    :return: kind of mutation and damaged file; always the same for the same number
    """
    rng = np.random.default_rng([SEED, number])
    names = list(target.mutations)
    while True:
        # Half of them have one changed byte.
        name = names[0] if number % 2 else names[1 + number // 2 % (len(names) - 1)]
        damaged = target.mutations[name](content, rng)
        if damaged != content:
            return name, damaged


def outcome_of(read: Callable[[Path], Any], path: Path, expected: Any, seconds: int) -> str:
    """What reading a mutant gives, in a word; an error that is none of this package with its text."""
    signal.alarm(seconds)  # by default this signal ends the process, also in the middle of C code
    try:
        result = read(path)
    except (DatasetError, ConfigError):
        return "refused"
    except Exception as exc:
        return f"escaped: {type(exc).__name__}: {str(exc)[:200]!r}"
    finally:
        signal.alarm(0)
    return "same" if fingerprint(result) == expected else "changed"


def fingerprint(result: Any) -> Any:
    if not isinstance(result, Transitions):
        return repr(result)
    return result.rows.tobytes(), result.timeouts.tobytes(), result.episodes.tobytes()


def child(name: str, folder: Path, start: int, stop: int) -> None:
    """Read mutants ``start`` to ``stop - 1`` and print a line for each."""
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    warnings.simplefilter("ignore")
    os.chdir(folder)
    target = {**TARGETS, **MISBEHAVING}[name]
    path = folder / target.file_name
    target.write(path, base_arrays())
    content = path.read_bytes()
    if target.has_hash:
        write_record(path, file_sha256(path), "https://example.org/data")
    expected = fingerprint(target.read(path))
    for number in range(start, stop):
        kind, damaged = mutant(target, content, number)
        path.write_bytes(damaged)
        known = outcome_of(load_transitions, path, expected, target.hang_seconds) if target.has_hash else "refused"
        outcome = outcome_of(target.read, path, expected, target.hang_seconds)
        line = {"number": number, "kind": kind, "outcome": outcome, "known": known}
        if (folder / "executed").exists():
            line["outcome"] = "escaped: a file was executed"
        os.write(1, f"{json.dumps(line)}\n".encode())


class Results(NamedTuple):
    """
    :param outcomes: (kind of mutation, outcome) to number of mutants
    :param findings: texts about mutants that are neither refused, nor the same, nor changed, or that pass a known hash
    """

    outcomes: Counter[tuple[str, str]]
    findings: list[str]


def hunt(name: str, count: int) -> Results:
    """
    :param name: of a target
    :param count: mutants
    :return: what became of them
    """
    results, start = Results(Counter(), []), 0
    while start < count:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-X", "faulthandler", __file__, "child", name, folder, str(start), str(count)]
            done = subprocess.run(command, capture_output=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        for line in lines:
            outcome = line["outcome"].partition(":")[0]
            results.outcomes[line["kind"], outcome] += 1
            if outcome not in ("refused", "same", "changed") or line["known"] != "refused":
                results.findings.append(f"{name}: {line}")
        start += len(lines)
        if done.returncode == 0:
            break
        if done.returncode > 0:
            raise RuntimeError(done.stderr.decode())
        outcome = "hang" if done.returncode == -signal.SIGALRM else f"crash, signal {-done.returncode}"
        results.outcomes["any", outcome] += 1
        results.findings.append(f"{name}: mutant {start}: {outcome}\n{done.stderr.decode()[-2000:]}")
        start += 1
    return results


# -- the tests -----------------------------------------------------------------------------------------------------

needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="limits of memory and time as Linux has them")


@needs_linux
@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_never_crash_hang_or_pass_for_the_recorded_one(name: str) -> None:
    count = TARGETS[name].count(N_HDF5)
    results = hunt(name, count)
    assert results.findings == []
    assert sum(results.outcomes.values()) == count
    changed = sum(n for (_, outcome), n in results.outcomes.items() if outcome == "changed")
    if name == "HDF5, plain":
        assert changed > 0.2 * count  # it has no checksum: this test would notice if nothing was damaged
    elif name == "HDF5, gzip and fletcher32":
        assert changed <= 0.02 * count
    elif name == "NPZ":
        assert changed == 0  # zip has a checksum


@needs_linux
@pytest.mark.parametrize("name", MISBEHAVING)
def test_the_hunt_notices_a_reader_that_misbehaves(name: str) -> None:
    results = hunt(name, 2)
    outcomes = {outcome: n for (kind, outcome), n in results.outcomes.items() if kind != "inserted"}
    assert outcomes == {name.partition(":")[0]: 1} and results.findings


# -- the command line ----------------------------------------------------------------------------------------------


def print_table(n_hdf5: int) -> None:
    """Markdown, a row for each kind of file and of damage."""
    print("| file | damage | files | refused | same data | other data, unnoticed | crash, hang or other error |")
    print("|---|---|---|---|---|---|---|")
    for name, target in TARGETS.items():
        results = hunt(name, target.count(n_hdf5))
        for kind in (*target.mutations, "any"):
            numbers = {outcome: n for (k, outcome), n in results.outcomes.items() if k == kind}
            total = sum(numbers.values())
            good = [numbers.pop(outcome, 0) for outcome in ("refused", "same", "changed")]
            if total:
                cells = [name, kind, f"{total:,}", *(f"{n:,} ({n / total:.2%})" for n in good), f"{sum(numbers.values()):,}"]
                print(f"| {' | '.join(cells)} |", flush=True)
        for text in results.findings:
            print(text, file=sys.stderr)


if __name__ == "__main__":
    if sys.argv[1] == "child":
        child(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]))
    else:
        print_table(int(sys.argv[2]))
