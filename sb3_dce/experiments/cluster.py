"""
Runs on the nodes of a Ray cluster (extra ``[cluster]``). Nothing is shared but the network: a node finds the data by their
id on its own disk, trains in a folder of its own cache, and sends the files of the complete run back.

A node that is given an interrupted run again goes on from its checkpoint; another node begins it anew, and so does one that is
asked by another folder or another version of this package. What has arrived here is never run again.
"""

from __future__ import annotations

import hashlib
import os
import platform
import socket
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch as th
from rich.console import Console

import sb3_dce
from sb3_dce.data import find_file
from sb3_dce.data.hashes import sha256_once
from sb3_dce.data.locate import cache_folder
from sb3_dce.errors import ConfigError, DatasetIntegrityError, DivergenceError, SB3DCEError
from sb3_dce.files import write_atomically
from sb3_dce.launch import train_one
from sb3_dce.processes import threads_from_environment
from sb3_dce.run_files import MARKS, RunSpec, read_result, source_commit


class Outcome(NamedTuple):
    """
    What comes back from a node.

    :param node: name of the machine
    :param files: content by name
    :param error: what went wrong, in words
    :param diverged: whether that was a divergence, which is a result
    """

    node: str
    files: dict[str, bytes]
    error: str | None
    diverged: bool


def run_on_cluster(specs: Sequence[RunSpec], address: str, console: Console) -> list[BaseException]:
    """
    Train all runs on a cluster, one core each.

    :param specs: runs that are not complete here
    :param address: of the cluster: ``auto``, ``host:port`` of its head, or ``ray://host:port``
    :param console: where the end of each run is shown
    :return: errors of the runs that failed
    :raises ConfigError: without Ray, or if no cluster answers
    """
    try:
        import ray
    except ImportError:
        raise ConfigError(
            "--ray-address needs Ray, which is not installed", key="--ray-address", hint='pip install "sb3_dce[cluster]"'
        ) from None
    begun_here = not ray.is_initialized()
    if begun_here:
        try:
            _knock(address)
            ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (OSError, ValueError, RuntimeError) as error:
            raise ConfigError(
                f"no Ray cluster at {address}: {str(error).splitlines()[0]}",
                key="--ray-address",
                hint="Start one: ray start --head, then on each further machine: ray start --address=<head>:6379",
            ) from error
    try:
        return _collect(ray, specs, console)
    finally:
        if begun_here:
            ray.shutdown()


def _knock(address: str) -> None:
    """Ray itself waits for minutes for a machine that does not answer."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), timeout=10).close()


def _collect(ray: Any, specs: Sequence[RunSpec], console: Console) -> list[BaseException]:
    remote = ray.remote(num_cpus=1, max_retries=2, scheduling_strategy="SPREAD")(train_on_node)
    waiting = {remote.remote(spec, asker_of(spec), sha256_once(find_file(spec.dataset)[0])): spec for spec in specs}
    console.print(
        f"{len(specs)} runs wait for the {ray.cluster_resources().get('CPU', 0):g} cores of the cluster", markup=False
    )
    failures: list[BaseException] = []
    while waiting:
        (ready,), _ = ray.wait(list(waiting), num_returns=1)
        spec = waiting.pop(ready)
        try:
            outcome: Outcome = ray.get(ready)
        except ray.exceptions.RayTaskError as error:
            failures.append(not_begun(spec.name, error))
            continue
        except ray.exceptions.RayError as error:
            failures.append(NodeError(f"{spec.name} was lost with its node: {str(error).splitlines()[0]}", hint=AGAIN))
            continue
        receive(Path(spec.folder), outcome.files)
        if outcome.error is not None:
            kind = DivergenceError if outcome.diverged else NodeError
            failures.append(kind(f"{spec.name} on {outcome.node}: {outcome.error}", hint=None if outcome.diverged else AGAIN))
        console.print(f"  {spec.name:<40} from {outcome.node}   {outcome.error or 'complete'}", highlight=False, markup=False)
    return failures


AGAIN = "The same command goes on with what is missing."


class NodeError(SB3DCEError):
    """A run failed on a node of the cluster."""


def not_begun(name: str, error: BaseException) -> NodeError:
    """
    Error of a run that its node could not even begin; once it has begun, :func:`train_on_node` says what went wrong.

    :param name: of the run
    :param error: ``RayTaskError``, a report from the node whose last line is the cause
    :return: what is to be raised
    """
    cause = str(error).strip().splitlines()[-1]
    hint = f"Each node needs this package, in the same version. {AGAIN}"
    return NodeError(f"{name} could not be begun on its node: {cause}", hint=hint)


def asker_of(spec: RunSpec) -> str:
    """
    Hash in the name of a run's folder on a node, so that it is only resumed for whoever has begun it.

    :param spec: run, with its folder on this machine
    :return: 12 hexadecimal digits that tell apart who asks for it: machine, folder, and version of this package
    """
    folder = Path(spec.folder).absolute().as_posix()
    text = f"{platform.node()} {folder} {sb3_dce.__version__} {source_commit()}"
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def train_on_node(spec: RunSpec, asker: str, sha256: str) -> Outcome:
    """
    What a node does.

    :param spec: run, with the folder it has on the machine that asked for it
    :param asker: from :func:`asker_of`
    :param sha256: of the data file there; rows of two files could not be put together
    :return: its files
    """
    th.set_num_threads(threads_from_environment() or 1)
    node = os.environ.get("SB3_DCE_NODE") or platform.node()
    folder = cache_folder().parent / "cluster" / node / f"{Path(spec.folder).name}--{asker}"
    here = replace(spec, folder=str(folder))
    try:
        _refuse_other_data(spec.dataset, sha256)
        train_one(here, lambda progress: None)
    except DivergenceError as error:
        return Outcome(node, send(folder), str(error), diverged=True)
    except SB3DCEError as error:
        return Outcome(node, {}, str(error), diverged=False)
    except Exception as error:  # not of the run, which would have left its report in the folder
        return Outcome(node, {}, f"{type(error).__name__}: {error}", diverged=False)
    assert read_result(folder) is not None
    return Outcome(node, send(folder), None, diverged=False)


def _refuse_other_data(dataset: str, sha256: str) -> None:
    path = find_file(dataset)[0]
    if (own := sha256_once(path)) != sha256:
        raise DatasetIntegrityError(
            f"another file (sha256 {own[:8]}…) than on the machine that asked ({sha256[:8]}…)",
            where=str(path),
            path=path,
            hint="Copy that one to the node: one that a node generates is another file.",
        )


def send(folder: Path) -> dict[str, bytes]:
    """
    Files of a run on the node, to be returned in its :class:`Outcome`; subfolders are left out.

    :param folder: of a run
    :return: content of its files by name
    """
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def receive(folder: Path, files: dict[str, bytes]) -> None:
    """
    Write what a node has sent, the marks of a complete run last; without files nothing is done.

    :param folder: where a run is to be complete; it is made if it is missing
    :param files: content by name
    """
    if not files:
        return
    folder.mkdir(parents=True, exist_ok=True)
    for name in sorted(files, key=lambda name: (name in MARKS, name)):  # the marks of a run that has ended come last
        if Path(name).name == name:  # a node may not write elsewhere
            with write_atomically(folder / name) as stream:
                stream.write(files[name])
