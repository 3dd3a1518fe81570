"""Whether data that were made again are the same, or at least samples of the same thing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import sb3_dce
from dataset_files import base_arrays

from sb3_dce.data import DatasetCard, Transitions, compare_datasets, resolve
from sb3_dce.errors import DatasetFormatError, DatasetNotFoundError, DatasetSemanticsError

CARDS = Path(__file__).parents[1] / "docs" / "results" / "cards"


def made(
    seed: int, episodes: int = 60, *, length: int = 25, drift: float = 0.0, noise: float = 0.3, bonus: float = 0.0
) -> Transitions:
    """Episodes with rows that depend on each other: a walk of an offset per episode, a constant entry, and noisy actions."""
    rng = np.random.default_rng(seed)
    n = episodes * length
    offset = np.repeat(rng.standard_normal((episodes, 1)), length, axis=0)
    observations = np.hstack([1e4 + offset + 0.1 * rng.standard_normal((n, 1)), np.full((n, 1), 0.7)])
    actions = np.clip(rng.normal(drift, noise, (n, 2)), -1, 1)
    ends = np.arange(1, n + 1) % length == 0
    return Transitions.from_arrays(observations, actions, rng.standard_normal(n) + bonus, np.zeros(n), ends)


def verdict(first: Transitions, second: Transitions) -> str:
    return compare_datasets(DatasetCard.of(first), DatasetCard.of(second)).verdict


def test_same_numbers_in_another_format_are_identical(tmp_path: Path) -> None:
    transitions = Transitions.from_arrays(**base_arrays())
    transitions.to_hdf5(tmp_path / "a.hdf5")
    transitions.to_npz(tmp_path / "b.npz")
    assert verdict(Transitions.from_hdf5(tmp_path / "a.hdf5"), Transitions.from_npz(tmp_path / "b.npz")) == "identical"


def test_one_changed_bit_is_not_identical() -> None:
    arrays = base_arrays()
    changed = {**arrays, "rewards": np.nextafter(arrays["rewards"], np.float32(9))}
    first, second = (DatasetCard.of(Transitions.from_arrays(**given)) for given in (arrays, changed))
    assert first.content_hash != second.content_hash


@pytest.mark.parametrize("episodes", [10, 30])
def test_samples_of_the_same_thing_are_called_different_as_rarely_as_promised(episodes: int) -> None:
    cards = [DatasetCard.of(made(seed, episodes)) for seed in range(200)]
    different = sum(
        compare_datasets(a, b).verdict != "statistically equal" for a, b in zip(cards[::2], cards[1::2], strict=True)
    )
    assert different <= 3  # of 100, where 0.3 are expected; four have a chance of one in a few thousand


@pytest.mark.parametrize(("gap", "expected"), [(1.5, "statistically equal"), (1.7, "different")])
def test_few_episodes_explain_more_by_chance(gap: float, expected: str) -> None:
    """
    Two means of ten episodes each, with deviation 1 (divisor n): their standard error is sqrt(2 / 9) = 0.471, and what three
    standard errors are for a normal distribution are 3.4755 for Student's t with 18 degrees of freedom: 1.64 in all.
    """
    facts = {"id": "mine", "rows": 10, "episodes": 10, "sha256": None, "stds": {"return": 1.0}}
    first, second = (DatasetCard(content_hash=f"{mean}", means={"return": mean}, **facts) for mean in (0.0, gap))
    comparison = compare_datasets(first, second)
    assert comparison.verdict == expected and comparison.limit == pytest.approx(3.4755, abs=1e-3)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"drift": 0.05}, "mean of action 1"),
        ({"noise": 0.4}, "spread of action 0"),
        ({"bonus": 0.3}, "return"),
        ({"length": 26}, "length"),
    ],
)
def test_a_difference_is_found_and_named(change: dict[str, float], named: str) -> None:
    comparison = compare_datasets(DatasetCard.of(made(0)), DatasetCard.of(made(1, **change)))  # type: ignore[arg-type]
    assert comparison.verdict == "different"
    assert any(reason.startswith(named + ":") for reason in comparison.reasons)


def test_an_entry_that_never_varies_must_agree() -> None:
    card = DatasetCard.of(made(0))
    assert card.stds["mean of observation 1"] == 0.0
    other = replace(card, content_hash="another", means={**card.means, "mean of observation 1": 0.71})
    reason = compare_datasets(card, other).reasons[0]
    assert reason.startswith("mean of observation 1: 0.7 and 0.71")
    rounded = replace(card, content_hash="another", means={**card.means, "mean of observation 1": 0.7 + 1e-8})
    assert compare_datasets(card, rounded).verdict == "statistically equal"


def test_large_offsets_do_not_swallow_the_spread_within_episodes() -> None:
    assert DatasetCard.of(made(0)).means["spread of observation 0"] == pytest.approx(0.1, rel=0.05)


def test_the_open_last_episode_does_not_count() -> None:
    arrays = base_arrays()
    with_tail = {key: np.concatenate([array, array[:5]]) for key, array in arrays.items()}
    card, longer = (DatasetCard.of(Transitions.from_arrays(**given)) for given in (arrays, with_tail))
    assert (card.rows, longer.rows, card.episodes, longer.episodes) == (200, 205, 5, 5)
    assert longer.means == card.means


def test_episodes_without_a_usable_row_do_not_count() -> None:
    """Of one row, and without a next observation."""
    rng = np.random.default_rng(0)
    ends = np.isin(np.arange(400) % 20, (0, 19))
    arrays = rng.standard_normal((400, 2)), rng.uniform(-1, 1, (400, 1)), rng.standard_normal(400), np.zeros(400), ends
    card = DatasetCard.of(Transitions.from_arrays(*arrays))
    assert card.episodes == 20 and card.means["length"] == 19.0


def test_too_few_episodes_are_said_to_be_too_few() -> None:
    with pytest.raises(DatasetSemanticsError, match=r"9 whole episodes are too few.* 10 episodes"):
        verdict(made(0, episodes=9), made(1))


def test_other_widths_are_different() -> None:
    assert verdict(made(0), Transitions.from_arrays(**base_arrays())) == "different"


def test_a_card_is_a_small_file_that_is_read_again(tmp_path: Path) -> None:
    card = DatasetCard.of(made(0))
    card.write(tmp_path / "card.json")
    assert DatasetCard.read(tmp_path / "card.json") == card
    assert (tmp_path / "card.json").stat().st_size < 5000


@pytest.mark.parametrize("damage", ["", "[]", '{"id": 1}', "\udcff", "wrong number", "missing quantity"])
def test_a_damaged_card_is_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "card.json"
    DatasetCard.of(made(0)).write(path)
    content = json.loads(path.read_bytes())
    if damage == "wrong number":
        content["means"]["return"] = "high"
    elif damage == "missing quantity":
        del content["stds"]["return"]
    text = json.dumps(content) if " " in damage and ":" not in damage else damage
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(DatasetFormatError, match=r"no card of a dataset.*--card"):
        DatasetCard.read(path)


def test_a_missing_card_is_not_called_damaged(tmp_path: Path) -> None:
    with pytest.raises(DatasetNotFoundError, match=r"nothing\.json"):
        DatasetCard.read(tmp_path / "nothing.json")


@pytest.mark.skipif(not CARDS.is_dir(), reason="not a checkout")
def test_cards_of_the_results_are_read() -> None:
    paths = sorted(CARDS.glob("*.json"))
    assert len(paths) > 20
    for path in paths:
        card = DatasetCard.read(path)
        assert card.id == path.stem == resolve(card.id).id and compare_datasets(card, card).verdict == "identical", path


def test_the_command_compares_files_and_cards(tmp_path: Path) -> None:
    made(0).to_hdf5(tmp_path / "mine.hdf5")
    made(1).to_hdf5(tmp_path / "again.hdf5")
    made(2, drift=0.3).to_hdf5(tmp_path / "other.hdf5")
    mine, card = str(tmp_path / "mine.hdf5"), str(tmp_path / "mine.json")
    assert sb3_dce("datasets", "info", mine, "--card", card).code == 0
    same = sb3_dce("datasets", "compare", mine, card)
    assert same.code == 0 and same.stdout.endswith("identical\n")
    again = sb3_dce("datasets", "compare", str(tmp_path / "again.hdf5"), card)
    assert again.code == 0
    assert "statistically equal: none of 10 quantities further apart than by chance, which explains up to 3.8" in again.stdout
    other = sb3_dce("datasets", "compare", card, str(tmp_path / "other.hdf5"))
    assert other.code == 1 and "mean of action 0" in other.stdout and "different: 2 of 10" in other.stdout
    assert sb3_dce("datasets", "compare", mine, str(tmp_path / "no.json")).code == 2
    before = (tmp_path / "mine.hdf5").read_bytes()
    refused = sb3_dce("datasets", "info", "--card", mine, str(tmp_path / "again.hdf5"))
    assert refused.code == 2 and "mine.hdf5: this file exists and is no card" in refused.stderr
    assert (tmp_path / "mine.hdf5").read_bytes() == before
    assert sb3_dce("datasets", "info", str(tmp_path / "again.hdf5"), "--card", card).code == 0, "a card is replaced"
