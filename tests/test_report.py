"""``sb3-dce datasets report``: estimates against closed forms, the sentences against known data, and a page that is safe."""

from __future__ import annotations

import re
import subprocess
import sys
import warnings
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from commands import sb3_dce
from dataset_files import base_arrays, write_plain

from sb3_dce import Transitions
from sb3_dce.data.examination import Penalty, examine
from sb3_dce.errors import ConfigError, DatasetError, DatasetWarning
from sb3_dce.report import Behaviour, advise, estimate_behaviour, write_report
from sb3_dce.report.advice import observation_scales
from sb3_dce.report.behaviour import _smallest
from sb3_dce.report.page import MARKER

PENALTY = Penalty(beta=4.0, td_loss_coef=1.0, source="a test")
LENGTH = 50


def episodes_of(
    states: np.ndarray,
    actions: np.ndarray,
    rewards: np.ndarray | None = None,
    *,
    terminal: bool = False,
    length: int = LENGTH,
    **options: Any,
) -> Transitions:
    """Transitions in episodes of ``length`` rows whose next observations are those of the next rows."""
    n = len(states)
    ends = np.arange(n) % length == length - 1
    none = np.zeros(n, dtype=bool)
    rewards = np.random.default_rng(5).standard_normal(n) + 3.0 if rewards is None else rewards
    flags = (ends, none) if terminal else (none, ends)
    return Transitions.from_arrays(states, actions, rewards, *flags, **options)


def gaussian_policy(n_dims: int, sigma: float, n: int = 12_000, **options: Any) -> Transitions:
    """States from a normal distribution, action = smooth function of the state + N(0, sigma^2)."""
    rng = np.random.default_rng(n_dims)
    states = rng.standard_normal((n, n_dims))
    mean = np.column_stack([np.sin(states[:, 0]), 0.5 * np.tanh(states[:, -1])])
    return episodes_of(states, mean + sigma * rng.standard_normal((n, 2)), action_low=-4.0, action_high=4.0, **options)


def estimated(data: Transitions) -> Behaviour:
    behaviour = estimate_behaviour(data)
    assert behaviour is not None
    return behaviour


def sentences(data: Transitions, penalty: Penalty = PENALTY, behaviour: Behaviour | None = None) -> dict[str, str]:
    return dict(advise(data, penalty, behaviour))


# Behaviour policy


@pytest.mark.parametrize(("n_dims", "sigma"), [(1, 0.05), (1, 0.4), (3, 0.2), (6, 0.4)])
def test_noise_of_a_gaussian_policy_is_found(n_dims: int, sigma: float) -> None:
    behaviour = estimated(gaussian_policy(n_dims, sigma))
    expected = sigma / 4.0  # the bounds +-4 are scaled to +-1
    assert behaviour.std == pytest.approx(expected, rel=0.15)
    assert (behaviour.nearest_std >= behaviour.std).all()
    assert behaviour.entropy == pytest.approx(2 * 0.5 * np.log(2 * np.pi * np.e * expected**2), abs=0.3)
    assert behaviour.mean_std == pytest.approx(expected, rel=0.15)


def test_deterministic_policy_has_no_noise() -> None:
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (8_000, 2))
    behaviour = estimated(episodes_of(states, 0.5 * states[:, :1] + 0.2))
    assert behaviour.std.max() < 0.01 < 0.2 < behaviour.marginal_std.min()


def test_uniform_actions_have_the_entropy_of_the_uniform_distribution() -> None:
    rng = np.random.default_rng(0)
    behaviour = estimated(episodes_of(rng.standard_normal((8_000, 2)), rng.uniform(-1, 1, (8_000, 3))))
    assert behaviour.std == pytest.approx(1 / np.sqrt(3), rel=0.05)
    assert behaviour.entropy == pytest.approx(3 * np.log(2.0), abs=0.1)


def test_estimate_is_not_above_that_of_the_nearest_neighbours() -> None:
    # Pairs of near states have one action; those that are farther away have nothing in common, so that no line fits.
    rng = np.random.default_rng(0)
    states, actions = rng.standard_normal((4_000, 2)), rng.uniform(-1, 1, (4_000, 1))
    behaviour = estimated(episodes_of(np.concatenate([states, states + 1e-4]), np.concatenate([actions, actions])))
    assert behaviour.std == behaviour.nearest_std < 0.01


def test_copied_rows_do_not_pass_for_determinism() -> None:
    rng = np.random.default_rng(0)
    states, noise = rng.standard_normal((3_000, 1)), rng.standard_normal((3_000, 1))
    behaviour = estimated(episodes_of(np.tile(states, (4, 1)), np.tile(0.3 * noise, (4, 1)), action_low=-4.0, action_high=4.0))
    assert behaviour.std == pytest.approx(0.3 / 4.0, rel=0.15)
    assert behaviour.n_references < 3_100


def test_neighbours_of_the_same_episode_do_not_count() -> None:
    # Within an episode the action is a constant of its own; between episodes it is N(0, 0.3^2).
    rng = np.random.default_rng(0)
    actions = np.repeat(0.3 * rng.standard_normal(200), LENGTH)[:, None]
    states = np.repeat(rng.standard_normal(200), LENGTH)[:, None] + 0.01 * rng.standard_normal((200 * LENGTH, 1))
    behaviour = estimated(episodes_of(states, actions, action_low=-4.0, action_high=4.0))
    assert behaviour.std == pytest.approx(0.3 / 4.0, rel=0.3)


def mixture(grouped: bool, rewards_tell: bool) -> Transitions:
    """Two policies of opposite sign, one after the other or in turns, with different or equal rewards."""
    rng = np.random.default_rng(0)
    n = 12_000
    episode = np.arange(n) // LENGTH
    sign = np.where(episode < episode[-1] / 2 if grouped else episode % 2 == 0, 1.0, -1.0)
    states = rng.standard_normal((n, 2))
    actions = 0.5 * sign * np.tanh(states[:, 0]) + 0.1 * rng.standard_normal(n)
    rewards = rng.standard_normal(n) + (3.0 * sign if rewards_tell else 3.0)
    return episodes_of(states, actions[:, None], rewards, action_low=-2.0, action_high=2.0)


@pytest.mark.parametrize("width", [10, 640, 705, 5000])
def test_smallest_distances_are_those_of_a_full_sort(width: int) -> None:
    distances = np.random.default_rng(0).permuted(np.tile(np.arange(width, dtype=np.float32), (20, 1)), axis=1)
    distances[3, distances[3] >= 4] = np.inf  # fewer neighbours than wanted
    distances[5, :9] = -1.0  # side by side
    found = np.take_along_axis(distances, _smallest(distances, 10), axis=1)
    assert np.array_equal(np.sort(found, axis=1), np.sort(distances, axis=1)[:, :10])


def test_one_policy_is_not_taken_for_a_mixture() -> None:
    behaviour = estimated(gaussian_policy(3, 0.3))
    assert behaviour.mix_by_position is not None and behaviour.mix_by_position < 0.1
    assert behaviour.mix_by_return is not None and behaviour.mix_by_return < 0.1


def test_policies_one_after_the_other_show_over_the_file() -> None:
    behaviour = estimated(mixture(grouped=True, rewards_tell=False))
    assert behaviour.mix_by_position is not None and behaviour.mix_by_position > 0.8
    assert behaviour.mix_by_return is not None and behaviour.mix_by_return < 0.1


def test_policies_in_turns_show_with_the_return() -> None:
    behaviour = estimated(mixture(grouped=False, rewards_tell=True))
    assert behaviour.mix_by_position is not None and behaviour.mix_by_position < 0.1
    assert behaviour.mix_by_return is not None and behaviour.mix_by_return > 0.8


def test_few_episodes_say_nothing_about_mixing() -> None:
    behaviour = estimated(gaussian_policy(2, 0.3, n=2_000, length=400))
    assert behaviour.mix_by_position is None and behaviour.mix_by_return is None


def test_nothing_is_estimated_without_different_states() -> None:
    rng = np.random.default_rng(0)
    assert estimate_behaviour(episodes_of(np.ones((100, 2)), rng.uniform(-1, 1, (100, 1)))) is None
    assert estimate_behaviour(episodes_of(rng.standard_normal((12, 2)), rng.uniform(-1, 1, (12, 1)), length=4)) is None


# Sentences


@pytest.fixture(scope="module")
def states() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((400, 2))


def test_beta_sentence_gives_the_limit_of_the_survival_condition(states: np.ndarray) -> None:
    data = episodes_of(states, 0.1 * states, np.full(400, 1.5) + 0.01 * states[:, 0], terminal=True)
    mean = data.info.reward_mean
    text = sentences(data)["beta"]
    assert f"beta below {2 * mean:.3g}" in text and "too much" in text  # beta_eff = 2 > 1.5
    assert "too much" not in sentences(data, Penalty(2.0, 1.0, "a test"))["beta"]
    assert "little room" in sentences(data, Penalty(2.8, 1.0, "a test"))["beta"]


def test_beta_sentence_without_terminals_states_the_lowering_of_q(states: np.ndarray) -> None:
    text = sentences(episodes_of(states, 0.1 * states))["beta"]
    assert "no true terminals" in text and "lowers Q by up to 200" in text  # 2 / (1 - 0.99)


def test_beta_sentence_where_living_costs(states: np.ndarray) -> None:
    data = episodes_of(states, 0.1 * states, np.full(400, -1.0) + 0.01 * states[:, 0], terminal=True)
    assert "reward_shift" in sentences(data)["beta"]


@pytest.mark.parametrize(
    ("scale", "words"),
    [(1.0, "Leave them"), (1e4, "reward_scale = 0.0001"), (1e-4, "reward_scale = 10000"), (0.0, "Every reward is 0")],
)
def test_reward_sentence_follows_their_size(scale: float, words: str, states: np.ndarray) -> None:
    rewards = scale * (1.0 + 0.01 * states[:, 0])  # values of about 100 * scale
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DatasetWarning)  # a constant reward
        data = episodes_of(states, 0.1 * states, rewards)
    assert words in sentences(data)["rewards"]


def test_reward_sentence_gives_the_factor_of_iql() -> None:
    states = np.random.default_rng(0).standard_normal((100, 1))
    rewards = np.where(np.arange(100) < 50, 10 / 50, 30 / 50)  # returns 10 and 30
    assert "multiplies them by 50," in sentences(episodes_of(states, 0.1 * states, rewards))["rewards"]


def test_observation_sentence_follows_the_scales(states: np.ndarray) -> None:
    assert sentences(episodes_of(states, 0.1 * states))["normalize_obs"].startswith("Not needed")
    wide = states * np.array([1.0, 50.0])
    assert "normalize_obs=True" in sentences(episodes_of(wide, 0.1 * states))["normalize_obs"]
    # Far from zero, where a naive sum of squares in float32 would cancel.
    far = Transitions.from_arrays(
        **(base_arrays() | {"next_observations": None, "observations": 1e4 + base_arrays()["observations"]})
    )
    assert observation_scales(far) == pytest.approx(far.observations.std(axis=0, dtype=np.float64), rel=1e-6)


def test_action_sentence_names_bounds_and_saturation(states: np.ndarray) -> None:
    assert "Only 0.0%" in sentences(episodes_of(states, 0.1 * np.tanh(states)))["actions"]
    clipped = sentences(episodes_of(states, np.clip(states, -1, 1)))["actions"]
    assert "must clip" in clipped
    scaled = sentences(episodes_of(states, states, action_low=-5.0, action_high=5.0))["actions"]
    assert "from [-5, 5] to [-1, 1]" in scaled


def test_behaviour_sentence_follows_noise_and_mixing(states: np.ndarray) -> None:
    data = episodes_of(states, 0.1 * np.tanh(states))

    def text(std: float, mix: float | None) -> str:
        behaviour = Behaviour(np.full(2, std), np.full(2, std), np.full(2, 0.6), mix, None, 400, 400)
        return sentences(data, behaviour=behaviour)["behaviour"]

    assert text(0.05, 0.0).startswith("Nearly deterministic") and "one policy" in text(0.05, 0.0)
    assert text(0.3, 0.5).startswith("Noisy") and "mix several policies" in text(0.3, 0.5)
    assert "mix several policies" not in text(0.3, 0.15) and "15%" in text(0.3, 0.15)
    assert text(0.58, None).startswith("Close to random") and "so few episodes" in text(0.58, None)
    assert "Too few" in sentences(data)["behaviour"]


def test_compat_sentence_counts_the_rows_it_would_cost() -> None:
    arrays = base_arrays()
    assert "drop 4 rows" in sentences(Transitions.from_arrays(**arrays))["d4rl_compat"]
    assert "On:" in sentences(Transitions.from_arrays(**arrays, d4rl_compat=True))["d4rl_compat"]


def test_there_are_three_to_six_sentences_for_embedded_data() -> None:
    examination = examine("halfcheetah-tiny-sb3")
    assert examination.transitions is not None
    advice = advise(examination.transitions, examination.penalty, estimate_behaviour(examination.transitions))
    assert 3 <= len(advice) <= 6


# The page


class Page(HTMLParser):
    """What a browser would make of the page: elements with their attributes, and the visible text."""

    VOID = frozenset({"meta", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def demo_page(tmp_path_factory: pytest.TempPathFactory) -> str:
    pytest.importorskip("matplotlib")
    path, _ = write_report("halfcheetah-demo-sb3", tmp_path_factory.mktemp("report") / "demo.html")
    return path.read_text(encoding="utf-8")


def small_report(path: Path, out: Path, **options: Any) -> str:
    pytest.importorskip("matplotlib")
    return write_report(path, out, **options)[0].read_text(encoding="utf-8")


def test_page_is_well_formed_and_shows_everything(demo_page: str) -> None:
    page = Page(demo_page)
    assert page.open == []
    headings = re.findall(r"<h3>(.*?)</h3>", demo_page)
    assert headings == [
        "Returns",
        "Episode lengths",
        "Return over the file",
        "Reward by step",
        "Actions at the bounds",
        "Randomness of the behaviour policy",
        "Action histograms",
        "States covered",
        "Actions covered",
    ]
    assert [tag for tag, _ in page.elements].count("svg") == len(headings)
    for text in ("halfcheetah-demo-sb3", "59,940", "60,000", "a47d8b88e9d9", "survival condition", "mix several policies"):
        assert text in page.text
    assert "A sample of 50,000 of 59,940" in page.text
    assert len(demo_page) < 1_000_000


def test_page_needs_nothing_from_elsewhere(demo_page: str) -> None:
    page = Page(demo_page)
    assert not {"script", "link", "iframe", "object", "embed", "img", "base", "form"} & {tag for tag, _ in page.elements}
    for tag, attributes in page.elements:
        for name, value in attributes.items():
            assert not name.startswith("on"), (tag, name)
            if name in ("href", "xlink:href", "src"):
                assert value is not None and value.startswith(("#", "data:image/png;base64,")), (tag, value)
    assert re.search(r"url\((?!#)|@import", demo_page) is None


def test_pictures_follow_the_theme(demo_page: str) -> None:
    assert "prefers-color-scheme: dark" in demo_page and "var(--ink)" in demo_page
    for stand_in in ("#010101", "#020202", "#030303", "#040404"):
        assert stand_in not in demo_page


def test_names_inside_of_pictures_are_unique_and_resolve(demo_page: str) -> None:
    names = [attributes["id"] for _, attributes in Page(demo_page).elements if "id" in attributes]
    assert len(names) == len(set(names))
    assert set(re.findall(r"url\(#(.*?)\)", demo_page)) | set(re.findall(r'href="#(.*?)"', demo_page)) <= set(names)


def test_same_data_give_the_same_page_whatever_the_settings_of_the_user(tmp_path: Path) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    path = write_plain(tmp_path / "data.hdf5", base_arrays())
    plain = small_report(path, tmp_path / "a.html")
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "red", "svg.fonttype": "path"}):
        assert small_report(path, tmp_path / "b.html") == plain
        assert matplotlib.rcParams["font.size"] == 30


def test_text_from_a_file_cannot_become_markup(tmp_path: Path) -> None:
    evil = '<script>alert(1)</script><img src=x onerror=alert(2)>"&'
    path = write_plain(tmp_path / '<b onclick=alert(3)>"$x$.hdf5', base_arrays())
    with h5py.File(path, "a") as file:
        file.attrs[evil] = evil
        file.attrs["bytes"] = np.bytes_(evil.encode())
        file.attrs["long"] = "x" * 100_000
        file.attrs["array"] = [1, 2, 3]
    text = small_report(path, tmp_path / "report.html")
    page = Page(text)
    assert page.open == []
    assert not {"script", "img", "b"} & {tag for tag, attributes in page.elements if attributes}
    assert "<script" not in text and evil in page.text and path.stem in page.text
    assert len(text) < 500_000


def test_default_name_is_a_plain_file_in_this_folder_and_beta_is_the_given_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    arrays = base_arrays()
    arrays["rewards"] += np.float32(3.0)
    path, _ = write_report(write_plain(tmp_path / "data" / "my logs;1.hdf5", arrays), beta=7.0)
    assert path.name == "my-logs-1-report.html"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["data", path.name]
    text = path.read_text(encoding="utf-8")
    assert "Planned is beta = 7 at most (the given beta), which is too much" in text and "1 warning" in text


def test_another_file_is_not_overwritten_without_force(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "data.hdf5", base_arrays())
    other = tmp_path / "page.html"
    other.write_text("my notes")
    with pytest.raises(ConfigError, match="not a dataset report"):
        write_report(path, other)
    assert other.read_text() == "my notes"
    with pytest.raises(ConfigError, match="is a folder"):
        write_report(path, tmp_path)


def test_a_report_is_replaced_without_asking_and_anything_by_force(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "data.hdf5", base_arrays())
    report = tmp_path / "report.html"
    report.write_text(f"<html>{MARKER}</html>")
    assert MARKER in small_report(path, report)
    report.write_text("my notes")
    assert MARKER in small_report(path, report, force=True)


def test_the_data_themselves_are_not_overwritten_even_by_name(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "data.hdf5", base_arrays())
    before = path.read_bytes()
    with pytest.raises(ConfigError, match=r"exists and is not a dataset report.*Choose another name with --out"):
        write_report(path, path)
    assert path.read_bytes() == before


def test_unusable_data_leave_no_page(tmp_path: Path) -> None:
    arrays = base_arrays()
    arrays["rewards"][3] = np.nan
    path = write_plain(tmp_path / "data.hdf5", arrays)
    with pytest.raises(DatasetError, match="NaN"):
        write_report(path, tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()


def _narrow() -> dict[str, np.ndarray]:
    arrays = base_arrays()
    return arrays | {key: arrays[key][:, :1] for key in ("observations", "actions", "next_observations")}


def _wide() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return base_arrays() | {"actions": rng.uniform(-1, 1, (200, 40)).astype(np.float32)}


def _open() -> dict[str, np.ndarray]:
    none = np.zeros(200, dtype=bool)
    arrays = base_arrays() | {"timeouts": none, "terminals": none}
    return {key: array for key, array in arrays.items() if key != "next_observations"}  # whose jumps would show the ends


def _constant() -> dict[str, np.ndarray]:
    arrays = base_arrays()
    return {key: np.full_like(array, 0.5) if array.dtype == np.float32 else array for key, array in arrays.items()}


def _tiny() -> dict[str, np.ndarray]:
    return {key: array[38:42] for key, array in base_arrays().items()}


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (_narrow, "Only one observation column varies"),
        (_wide, "The first 36 of 40 entries"),
        (_open, "everything is one episode"),
        (_constant, "No observation column varies"),
        (_tiny, "Too few different states"),
    ],
)
def test_unusual_data_get_a_page_too(arrays: Any, words: str, tmp_path: Path) -> None:
    page = Page(small_report(write_plain(tmp_path / "data.hdf5", arrays()), tmp_path / "report.html"))
    assert page.open == [] and words in page.text


def test_many_episodes_are_thinned_out_and_this_is_said(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 30_000  # 10,000 episodes of 3 rows
    ends = np.arange(n) % 3 == 2
    arrays = {
        "observations": rng.standard_normal((n, 2)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (n, 1)).astype(np.float32),
        "rewards": rng.standard_normal(n).astype(np.float32),
        "terminals": ends,
        "timeouts": np.zeros(n, dtype=bool),
    }
    text = small_report(write_plain(tmp_path / "data.hdf5", arrays), tmp_path / "report.html")
    assert "One point in 5 is drawn" in text and len(text) < 1_000_000


def test_without_matplotlib_the_error_names_the_command(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "data.hdf5", base_arrays())
    code = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "from sb3_dce.cli import main\n"
        f"sys.argv = ['sb3-dce', 'datasets', 'report', {str(path)!r}, '--out', {str(tmp_path / 'report.html')!r}]\n"
        "main()"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 2 and 'pip install "sb3_dce[plots]"' in run.stderr and "Traceback" not in run.stderr
    assert not (tmp_path / "report.html").exists()


def test_reports_need_neither_torch_nor_a_window_system(tmp_path: Path) -> None:
    code = (
        "import sys; from sb3_dce.report import write_report\n"
        f"write_report('halfcheetah-tiny-sb3', __import__('pathlib').Path({str(tmp_path / 'report.html')!r}))\n"
        "assert 'torch' not in sys.modules and 'matplotlib.pyplot' not in sys.modules"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_command_names_the_file_and_what_deserves_a_look(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "report.html"
    outcome = sb3_dce("datasets", "report", "halfcheetah-tiny-sb3", "--out", str(out))
    assert outcome.code == 0 and outcome.stderr == "" and f"report {out}" in outcome.stdout
    assert MARKER in out.read_text() and "<h1>halfcheetah-tiny-sb3</h1>" in out.read_text()
    assert "note  actions at the bounds" in outcome.stdout and "ok " not in outcome.stdout
