"""The files that come with the package."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_dce.data import (
    D4RLFile,
    Transitions,
    all_specs,
    content_hash,
    file_sha256,
    find_file,
    load_transitions,
    normalized_score,
    resolve,
)

IDS = [spec.id for spec in all_specs() if spec.embedded]
MAX_BYTES = {"halfcheetah-tiny-sb3": 450_000, "halfcheetah-demo-sb3": 7_400_000}


@pytest.fixture(scope="module", params=IDS)
def dataset_id(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def transitions(dataset_id: str) -> Transitions:
    return load_transitions(dataset_id)


def test_bytes_are_those_of_the_catalogue(dataset_id: str) -> None:
    path, spec = find_file(dataset_id)
    assert spec is not None and file_sha256(path) == spec.sha256
    assert path.stat().st_size < MAX_BYTES[dataset_id]


def test_loads_without_warning(dataset_id: str, transitions: Transitions) -> None:
    assert transitions.info.warnings == ()
    assert transitions.info.id == dataset_id and transitions.info.sha256 == resolve(dataset_id).sha256
    assert np.abs(transitions.actions).max() <= 1.0
    assert np.isfinite(transitions.rows).all()


def test_attributes_and_card_describe_the_content(dataset_id: str, transitions: Transitions) -> None:
    path, spec = find_file(dataset_id)
    with D4RLFile(path) as file:
        attrs, arrays = file.attributes(), file.select(file.keys)
        assert attrs["content_hash"] == content_hash(arrays)
    info = transitions.info
    assert spec is not None and attrs["generated"] and attrs["dataset_id"] == dataset_id and attrs["env_id"] == spec.env_id
    assert (attrs["rows"], attrs["episodes"]) == (info.file_rows, info.episodes)
    assert attrs["return_mean"] == pytest.approx(info.episode_returns.mean())
    card = path.with_suffix(".md").read_text()
    score = normalized_score(dataset_id, info.episode_returns.mean())
    for fact in (spec.sha256, "MIT", f"{info.file_rows:,}", f"{score:.1f}", attrs["behaviour_policy"]):
        assert str(fact) in card


def test_next_observation_is_the_next_rows_inside_each_episode(transitions: Transitions) -> None:
    same_episode = transitions.episodes[1:] == transitions.episodes[:-1]
    following = transitions.next_observations[:-1] == transitions.observations[1:]
    assert following[same_episode].all() and same_episode.sum() > 4_000


def test_flags_stand_only_at_ends_of_episodes(dataset_id: str, transitions: Transitions) -> None:
    with D4RLFile(find_file(dataset_id)[0]) as file:
        timeouts = np.flatnonzero(file.select(["timeouts"])["timeouts"][:])
    assert np.array_equal(timeouts, 1000 * np.arange(1, transitions.info.episodes + 1) - 1)
    assert transitions.info.n_terminals == 0 and not transitions.terminals.any()
    assert set(transitions.info.episode_lengths) == {1000}
