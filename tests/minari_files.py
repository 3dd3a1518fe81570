"""Small Minari datasets: recorded by minari itself, written by hand to be damaged, and served as the hub serves them."""

from __future__ import annotations

import hashlib
import json
import sys
import threading
import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch.utils._pytree as pytree

Steps = list[tuple[Any, np.ndarray, float, bool, bool, Any]]


def box(size: int, bound: float = 1.0) -> dict[str, Any]:
    """A space as Minari writes it."""
    return {"type": "Box", "dtype": "float32", "shape": [size], "low": [-bound] * size, "high": [bound] * size}


def episode(steps: int, first: float = 0.0, end: str = "truncations") -> dict[str, Any]:
    """Observations count on from ``first``; the flag named ``end`` is set at the last step, the other one nowhere."""
    flags = {key: np.zeros(steps, dtype=bool) for key in ("terminations", "truncations")}
    if end:
        flags[end][-1] = True
    return {
        "observations": np.stack([first + np.arange(steps + 1), np.zeros(steps + 1)], axis=1).astype(np.float32),
        "actions": np.linspace(-1, 1, steps).reshape(steps, 1).astype(np.float32),
        "rewards": 1.0 + first + np.arange(steps, dtype=np.float64),
        **flags,
    }


def write_dataset(folder: Path, episodes: Mapping[str, Mapping[str, Any]], **metadata: Any) -> Path:
    """
    Write a dataset in Minari's layout without its checks.

    :param folder: folder of the dataset
    :param episodes: name of the group to its arrays; a dictionary in them becomes a group
    :param metadata: content of metadata.json besides the counts; a value of None leaves the key out
    :return: the folder
    """
    data = folder / "data"
    data.mkdir(parents=True)
    facts = {
        "total_episodes": len(episodes),
        "data_format": "hdf5",
        "observation_space": json.dumps(box(2, 1e9)),
        "action_space": json.dumps(box(1)),
        **metadata,
    }
    (data / "metadata.json").write_text(json.dumps({key: value for key, value in facts.items() if value is not None}))
    with h5py.File(data / "main_data.hdf5", "w") as file:
        for name, arrays in episodes.items():
            _write_group(file.create_group(name), arrays)
    return folder


def _write_group(group: h5py.Group, arrays: Mapping[str, Any]) -> None:
    for key, array in arrays.items():
        if isinstance(array, Mapping):
            _write_group(group.create_group(key), array)
        else:
            group.create_dataset(key, data=array)


@contextmanager
def tree_map_of_jax() -> Iterator[None]:
    """
    ``minari.DataCollector`` needs nothing of jax (500 MB) but ``jax.tree_util.tree_map``; torch has a function that does the
    same.
    """
    tree_util = types.ModuleType("jax.tree_util")
    tree_util.tree_map = pytree.tree_map  # type: ignore[attr-defined]
    jax = types.ModuleType("jax")
    jax.tree_util = tree_util  # type: ignore[attr-defined]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "jax", jax)
        patch.setitem(sys.modules, "jax.tree_util", tree_util)
        yield


def record(env: gym.Env, name: str, n_episodes: int, *, data_format: str | None = None, steps: int | None = None) -> Steps:
    """
    Let minari record random episodes into its root, and keep every step beside it.

    :param env: environment with a time limit
    :param name: id of the dataset
    :param n_episodes: episodes
    :param data_format: of minari, default HDF5
    :param steps: stop in the middle of an episode after so many steps
    :return: observation, action, reward, terminated, truncated, next observation of each step
    """
    minari = pytest.importorskip("minari")
    kept: Steps = []
    rng = np.random.default_rng(0)
    with tree_map_of_jax(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # minari misses an author, a description and more
        collector = minari.DataCollector(env, data_format=data_format)
        for seed in range(n_episodes):
            obs, _ = collector.reset(seed=seed)
            ended = False
            while not ended and (steps is None or len(kept) < steps):
                low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
                action = rng.uniform(low, high).astype(env.action_space.dtype)
                following, reward, terminated, truncated, _ = collector.step(action)
                kept.append((obs, action, float(reward), terminated, truncated, following))
                obs, ended = following, terminated or truncated
        collector.create_dataset(name)
        collector.close()
    return kept


class Hub(ThreadingHTTPServer):
    """A folder of datasets as Hugging Face serves it, as far as minari asks."""

    daemon_threads = True

    def __init__(self, root: Path) -> None:
        super().__init__(("127.0.0.1", 0), _HubHandler)
        self.root, self.asked = root, list[str]()
        self.url = f"http://127.0.0.1:{self.server_port}"
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()


class _HubHandler(BaseHTTPRequestHandler):
    server: Hub
    protocol_version = "HTTP/1.1"
    revision = "0" * 40

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path).strip("/")
        self.server.asked.append(f"{self.command} {path}")
        parts, root = path.split("/"), self.server.root
        answers: dict[str, Callable[[], Any]] = {
            "": lambda: {},
            "api/datasets": lambda: [{"id": f"farama-minari/{folder.name}"} for folder in root.iterdir()],
        }
        if path in answers:
            return self._answer(json.dumps(answers[path]()).encode())
        if path.startswith("api/datasets/"):
            folder = root / parts[3]
            files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
            names = [file.relative_to(folder).as_posix() for file in files]
            if parts[4] == "revision":
                siblings = [{"rfilename": name} for name in names]
                return self._answer(json.dumps({"id": parts[3], "sha": self.revision, "siblings": siblings}).encode())
            tree = [
                {"type": "file", "path": name, "size": file.stat().st_size, "oid": "0" * 40}
                for name, file in zip(names, files, strict=True)
            ]
            return self._answer(json.dumps(tree).encode())
        file = root / parts[2] / "/".join(parts[5:]) if path.startswith("datasets/") else root / "none"
        if file.is_file():
            return self._answer(file.read_bytes())
        self._answer(b"", 404, X_Error_Code="EntryNotFound")

    do_HEAD = do_GET

    def _answer(self, body: bytes, status: int = 200, **headers: str) -> None:
        self.send_response(status)
        kind = {"Content_Type": "application/json", "ETag": f'"{hashlib.sha256(body).hexdigest()}"'}
        for name, value in {**kind, "X_Repo_Commit": self.revision, **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        pass
