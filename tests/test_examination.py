"""``sb3-dce datasets check``: each check speaks up about the fault it is made for, and keeps quiet about clean data."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pandas as pd
import pytest
from commands import sb3_dce
from dataset_files import N_ROWS, base_arrays, write_plain

from sb3_dce import Transitions
from sb3_dce.data.catalog import resolve
from sb3_dce.data.examination import _RULES, Check, Examination, Penalty, examine, row_penalty, share_at_bounds, survival
from sb3_dce.data.records import CheckName, Finding
from sb3_dce.errors import ConfigError, DatasetError

Arrays = dict[str, np.ndarray]
# The reward of the base file has mean about 0; living must pay for clean data.
CLEAN_REWARD = 3.0


def clean_arrays() -> Arrays:
    """The base file, with rewards above the penalty of the default row and no action on its bounds."""
    arrays = base_arrays()
    arrays["actions"] *= np.float32(0.99)
    arrays["rewards"] += np.float32(CLEAN_REWARD)
    return arrays


def checked(tmp_path: Path, arrays: Arrays, **options: Any) -> Examination:
    return examine(write_plain(tmp_path / "data.hdf5", arrays), **options)


def named(examination: Examination, name: str) -> Check:
    (check,) = [check for check in examination.checks if check.name == name]
    return check


def test_clean_data_pass_every_check(tmp_path: Path) -> None:
    examination = checked(tmp_path, clean_arrays())
    assert [check for check in examination.checks if check.verdict != "ok"] == []
    assert examination.verdict == "ok" and examination.error is None
    names = [check.name for check in examination.checks]
    assert len(names) == len(set(names)) == 21


def _set(key: str, index: Any, value: Any) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[key][index] = value

    return change


def _shift_next(arrays: Arrays) -> None:
    arrays["next_observations"] = np.roll(arrays["next_observations"], -1, axis=0)


def _break_sequence(arrays: Arrays) -> None:
    arrays["next_observations"][10] += 1.0


def _shuffle(arrays: Arrays) -> None:
    order = np.random.default_rng(1).permutation(N_ROWS)
    for key in arrays:
        arrays[key] = arrays[key][order]


def _repeat(arrays: Arrays) -> None:
    for key in arrays:
        arrays[key][100:120] = arrays[key][80:100]


def _integers(arrays: Arrays) -> None:
    for key in ("observations", "next_observations"):
        arrays[key] = (100 * arrays[key]).round().astype(np.int64)


def _no_timeouts(arrays: Arrays) -> None:
    del arrays["timeouts"]


def _no_flags(arrays: Arrays) -> None:
    arrays["timeouts"][:], arrays["terminals"][:] = False, False
    del arrays["next_observations"]  # whose jumps would show the ends


def _open(arrays: Arrays) -> None:
    arrays["timeouts"][-1] = False


def _terminals_at_limit(arrays: Arrays) -> None:
    arrays["terminals"] = arrays["timeouts"] | arrays["terminals"]
    arrays["timeouts"] = np.zeros(N_ROWS, dtype=bool)


def _all_terminal(arrays: Arrays) -> None:
    arrays["terminals"][:], arrays["timeouts"][:] = True, False


def _both(arrays: Arrays) -> None:
    arrays["terminals"][39] = True


def _huge(arrays: Arrays) -> None:
    arrays["observations"][7, 1] = arrays["next_observations"][6, 1] = 2e6


def _constant_column(arrays: Arrays) -> None:
    arrays["observations"][:, 2] = arrays["next_observations"][:, 2] = 0.5


def _equal_returns(arrays: Arrays) -> None:
    arrays["rewards"] = np.tile(arrays["rewards"][:40], 5)


FAULTS: dict[str, tuple[Callable[[Arrays], None], str, str, int | None]] = {
    # fault: what is done to clean data, the check that must speak up, its verdict, its number
    "NaN": (_set("observations", (5, 1), np.nan), "finite values", "error", 1),
    "infinite reward": (_set("rewards", [3, 4], np.inf), "finite values", "error", 2),
    "far outside": (_set("actions", (3, 0), 55.0), "action bounds", "error", 1),
    "just outside": (_set("actions", (3, 0), 1.001), "action bounds", "warning", 1),
    "tiny actions": (lambda a: a["actions"].__imul__(0.4), "action scale", "note", None),
    "one-sided action": (lambda a: np.abs(a["actions"][:, 1], out=a["actions"][:, 1]), "action scale", "note", 1),
    "constant action": (_set("actions", (slice(None), 1), 0.25), "constant actions", "note", 1),
    "saturated": (_set("actions", (slice(0, 50), 0), 1.0), "actions at the bounds", "note", 50),
    "integers": (_integers, "observation type", "warning", None),
    "constant column": (_constant_column, "constant observations", "note", 1),
    "huge column": (_huge, "huge observations", "warning", 1),
    "constant reward": (_set("rewards", slice(None), 3.0), "rewards", "warning", N_ROWS),
    "all terminal": (_all_terminal, "flags", "warning", None),
    "terminal and timeout": (_both, "flags", "warning", 1),
    "displaced": (_shift_next, "next observations", "error", None),
    "jump": (_break_sequence, "next observations", "note", 1),
    "shuffled": (_shuffle, "next observations", "warning", None),
    "repeated rows": (_repeat, "duplicated rows", "warning", 20),
    "no timeouts": (_no_timeouts, "episode ends", "note", None),
    "open end": (_open, "last episode", "note", None),
    "no flags": (_no_flags, "terminals or timeouts", "note", None),
    "time limits as terminals": (_terminals_at_limit, "terminals or timeouts", "warning", 5),
    "equal returns": (_equal_returns, "episode returns", "note", 5),
    "life does not pay": (lambda a: a["rewards"].__isub__(2.0), "survival condition", "warning", 1),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_found_by_its_check(fault: str, tmp_path: Path) -> None:
    change, name, verdict, count = FAULTS[fault]
    arrays = clean_arrays()
    change(arrays)
    examination = checked(tmp_path, arrays)
    check = named(examination, name)
    assert check.verdict == verdict, check
    assert count is None or check.count == count, check
    assert check.remedy
    assert "other" not in [check.name for check in examination.checks]
    assert (examination.error is not None) == (verdict == "error")


@pytest.mark.parametrize(
    ("fault", "place"),
    [
        ("NaN", r"\(5, 1\)"),
        ("far outside", "key actions"),
        ("huge column", r"observation columns 1$"),
        ("repeated rows", "transition 100 repeats transition 80"),
        ("constant action", "action entries 1$"),
        ("saturated", "action entry 0"),
        ("displaced", "key next_observations"),
    ],
)
def test_the_place_is_named(fault: str, place: str, tmp_path: Path) -> None:
    change, name, _, _ = FAULTS[fault]
    arrays = clean_arrays()
    change(arrays)
    where = named(checked(tmp_path, arrays), name).where
    assert where is not None and re.search(place, where), where


@pytest.mark.parametrize("drop_nonfinite", [False, True])
def test_what_no_transition_shows_is_a_note(drop_nonfinite: bool, tmp_path: Path) -> None:
    arrays = clean_arrays()
    del arrays["next_observations"]
    arrays["rewards"][39], arrays["actions"][159, 1] = np.nan, np.inf  # at time limits, which cannot be used
    examination = checked(tmp_path, arrays, drop_nonfinite=drop_nonfinite)
    check = named(examination, "finite values")
    assert (check.verdict, check.count) == ("note", 2)
    assert check.what == "2 NaN or infinite values are in rows that are not used"
    assert examination.transitions is not None and examination.transitions.info.episodes == 4  # one return is not known


@pytest.mark.parametrize(("row", "place"), [(40, "rows that are not used"), (39, "observation columns 1")])
def test_huge_observation_is_found_where_it_is_used(row: int, place: str, tmp_path: Path) -> None:
    """Row 39 is left out, but it is what follows row 38; what follows row 39 is not known, and row 40 is not finite."""
    arrays = clean_arrays()
    del arrays["next_observations"]
    arrays["rewards"][40], arrays["observations"][row, 1] = np.nan, 2e6
    check = named(checked(tmp_path, arrays, drop_nonfinite=True), "huge observations")
    assert check.verdict == "warning" and check.where == place and check.count == (place != "rows that are not used")


def test_ends_that_only_jumps_show_are_ends(tmp_path: Path) -> None:
    arrays = clean_arrays()
    arrays["timeouts"][:], arrays["terminals"][:] = False, False
    examination = checked(tmp_path, arrays)
    check = named(examination, "terminals or timeouts")
    assert (check.verdict, check.what) == ("ok", "0 terminals, 4 ends without one")
    assert "4 whole episodes" in named(examination, "episode ends").what


def test_the_other_checks_go_on_after_a_refusal(tmp_path: Path) -> None:
    arrays = clean_arrays()
    arrays["observations"][5, 1], arrays["actions"][3, 0] = np.nan, 55.0
    _constant_column(arrays)
    examination = checked(tmp_path, arrays)
    assert [check.name for check in examination.checks if check.verdict == "error"] == ["finite values", "action bounds"]
    assert named(examination, "constant observations").verdict == "note"
    # They would describe clipped actions.
    assert "actions at the bounds" not in [check.name for check in examination.checks]


def test_a_finding_of_the_reader_without_a_row_in_the_table_is_shown(transitions: Transitions) -> None:
    from dataclasses import replace

    from sb3_dce.data.examination import examine_transitions

    unknown = replace(transitions.info, findings=(Finding("other", "warning", "something new", 3),))
    found = examine_transitions(replace(transitions, info=unknown), row_penalty(None))
    assert [check for check in found if check.name == "other"] == [Check("other", "warning", "something new", 3)]


def test_episodes_beyond_the_time_limit_are_counted(tmp_path: Path) -> None:
    arrays = clean_arrays()
    assert named(checked(tmp_path, arrays, max_episode_steps=40), "time limit").verdict == "ok"
    check = named(checked(tmp_path, arrays, max_episode_steps=39), "time limit")
    assert (check.verdict, check.count) == ("note", 5) and "39" in check.what


def test_catalogue_limit_is_used_and_said_once(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n, spec = 500, resolve("door-human-v0")
    arrays = {
        "observations": rng.standard_normal((n, spec.obs_dim)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (n, spec.act_dim)).astype(np.float32),
        "rewards": rng.standard_normal(n).astype(np.float32),
        "terminals": np.zeros(n, dtype=bool),
        "timeouts": np.arange(n) % 250 == 249,
    }
    examination = examine(write_plain(tmp_path / spec.file_name, arrays))
    limit = [check for check in examination.checks if "limit of" in check.what]
    assert [(check.name, check.verdict, check.count) for check in limit] == [("time limit", "note", 2)]
    assert examination.penalty.source == "the row of door-human-v0"


def test_survival_condition_both_ways() -> None:
    # beta_eff = 4 / (2 * 1) = 2 reward units per step.
    penalty = Penalty(beta=4.0, td_loss_coef=1.0, source="a test")
    assert penalty.shift == 2.0
    assert survival(2.6, 10, penalty).verdict == "ok"
    assert survival(2.4, 10, penalty).verdict == "note"
    assert survival(1.9, 10, penalty).verdict == "warning"
    assert survival(1.9, 0, penalty).verdict == "ok", "without true terminals there is nothing to survive"
    assert survival(1.9, 10, Penalty(4.0, 2.0, "a test")).verdict == "ok", "c = 2 halves the shift"
    assert survival(-0.5, 10, Penalty(0.0, 1.0, "a test")).verdict == "warning", "living costs without any penalty"


def test_survival_remedy_is_a_beta_that_passes() -> None:
    remedy = survival(1.5, 10, Penalty(4.0, 1.0, "a test")).remedy
    assert remedy is not None
    beta = float(remedy.split("below ")[1].split(",")[0])
    assert beta == pytest.approx(2 * 0.8 * 1.5)  # where the note about a narrow margin begins
    assert survival(1.5, 10, Penalty(beta, 1.0, "a test")).verdict == "ok"


def test_survival_remedy_where_living_costs_is_a_shift_that_passes() -> None:
    remedy = survival(-0.5, 10, Penalty(4.0, 1.0, "a test")).remedy
    assert remedy is not None and "more than 2.5 per step with reward_shift" in remedy
    assert survival(-0.5 + 2.6, 10, Penalty(4.0, 1.0, "a test")).verdict != "warning"


def test_penalty_comes_from_the_row_or_from_the_user() -> None:
    assert row_penalty(resolve("halfcheetah-medium-expert-v2"))[:2] == (18.0, 1.0), "the schedule rises from 4 to 18"
    assert row_penalty(resolve("hopper-medium-expert-v2")).beta == 6.0
    assert row_penalty(None, 1.5).shift == 0.75
    with pytest.raises(ConfigError, match="at least 0"):
        row_penalty(None, -1.0)


def test_share_at_bounds_uses_the_bounds_of_the_data() -> None:
    actions = np.array([[-2.0, 0.0], [2.0, 0.0], [1.9999, 1.0], [0.0, 1.0]])
    data = Transitions.from_arrays(
        np.arange(4.0), actions, np.arange(4.0), np.zeros(4), [0, 0, 0, 1], np.arange(1.0, 5.0), action_low=-2, action_high=2
    )
    assert share_at_bounds(data).tolist() == [[0.25, 0.0], [0.5, 0.0]]


@pytest.mark.parametrize("dataset_id", ["halfcheetah-tiny-sb3", "halfcheetah-demo-sb3"])
def test_embedded_data_have_no_warnings(dataset_id: str) -> None:
    examination = examine(dataset_id)
    assert examination.verdict in ("ok", "note") and examination.transitions is not None
    assert "does not apply" in named(examination, "survival condition").what


# The command


def test_command_prints_a_line_per_check_and_returns_0_for_notes() -> None:
    outcome = sb3_dce("datasets", "check", "halfcheetah-tiny-sb3")
    assert outcome.code == 0 and outcome.stderr == ""
    for word in ("ok", "note", "finite values", "survival condition", "remedy: ", "verdict: note"):
        assert word in outcome.stdout


def test_command_returns_1_for_warnings(tmp_path: Path) -> None:
    arrays = clean_arrays()
    _repeat(arrays)
    outcome = sb3_dce("datasets", "check", str(write_plain(tmp_path / "data.hdf5", arrays)))
    assert outcome.code == 1 and outcome.stderr == ""
    assert "warning  duplicated rows" in outcome.stdout and "(number: 20)" in outcome.stdout


def test_command_returns_2_for_unusable_data_and_says_why_on_stderr(tmp_path: Path) -> None:
    arrays = clean_arrays()
    arrays["rewards"][3] = np.nan
    path = str(write_plain(tmp_path / "data.hdf5", arrays))
    outcome = sb3_dce("datasets", "check", path)
    assert outcome.code == 2
    assert "error" in outcome.stdout and "survival condition" in outcome.stdout
    assert outcome.stderr.startswith("Error: ") and "drop_nonfinite" in outcome.stderr and "Traceback" not in outcome.stderr
    assert sb3_dce("datasets", "check", path, "--drop-nonfinite").code == 0


@pytest.mark.parametrize("content", [b"not a dataset", b""])
def test_damaged_file_is_one_error_line(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "data.hdf5"
    path.write_bytes(content)
    outcome = sb3_dce("datasets", "check", str(path))
    assert outcome.code == 2 and outcome.stderr.startswith("Error: ")
    assert outcome.stdout.startswith("error  readable")


def test_unknown_name_is_refused() -> None:
    outcome = sb3_dce("datasets", "check", "halfcheetah-medum")
    assert outcome.code == 2 and "Did you mean" in outcome.stderr


def test_bounds_given_on_the_command_line_apply(tmp_path: Path) -> None:
    arrays = clean_arrays()
    arrays["actions"] *= 2.0
    path = str(write_plain(tmp_path / "data.hdf5", arrays))
    assert sb3_dce("datasets", "check", path).code == 2
    assert sb3_dce("datasets", "check", path, "--action-low", "-2", "--action-high", "2").code == 0
    assert sb3_dce("datasets", "check", path, "--clip-actions").code == 1


def test_beta_given_on_the_command_line_applies(tmp_path: Path) -> None:
    path = str(write_plain(tmp_path / "data.hdf5", clean_arrays()))
    assert sb3_dce("datasets", "check", path, "--beta", "4").code == 0
    assert sb3_dce("datasets", "check", path, "--beta", "7").code == 1


def test_json_says_the_same(tmp_path: Path) -> None:
    arrays = clean_arrays()
    _repeat(arrays)
    path = write_plain(tmp_path / "data.hdf5", arrays)
    outcome = sb3_dce("datasets", "check", str(path), "--json")
    found = json.loads(outcome.stdout)
    assert outcome.code == found["exit_code"] == 1 and found["verdict"] == "warning"
    assert (found["rows"], found["obs_dim"], found["act_dim"], len(found["sha256"])) == (N_ROWS, 3, 2, 64)
    assert found["penalty"]["beta_eff"] == 2.0
    examination = examine(path)
    assert [check["name"] for check in found["checks"]] == [check.name for check in examination.checks]
    (duplicates,) = [check for check in found["checks"] if check["name"] == "duplicated rows"]
    assert duplicates["verdict"] == "warning" and duplicates["count"] == 20


@pytest.mark.parametrize("fault", [name for name, fault in FAULTS.items() if fault[2] == "error"])
def test_json_is_complete_for_unusable_data(fault: str, tmp_path: Path) -> None:
    arrays = clean_arrays()
    FAULTS[fault][0](arrays)
    outcome = sb3_dce("datasets", "check", str(write_plain(tmp_path / "data.hdf5", arrays)), "--json")
    found = json.loads(outcome.stdout)
    assert outcome.code == found["exit_code"] == 2 and "error" in [check["verdict"] for check in found["checks"]]


def test_every_format_of_the_front_door_gives_the_same_verdicts(tmp_path: Path) -> None:
    data = Transitions.from_hdf5(write_plain(tmp_path / "data.hdf5", clean_arrays()))
    data.to_npz(tmp_path / "data.npz")
    arrays = clean_arrays()
    columns = {f"obs_{i}": arrays["observations"][:, i] for i in range(3)}
    columns |= {f"action_{i}": arrays["actions"][:, i] for i in range(2)}
    columns |= {"reward": arrays["rewards"], "terminal": arrays["terminals"] * 1, "timeout": arrays["timeouts"] * 1}
    columns |= {f"next_obs_{i}": arrays["next_observations"][:, i] for i in range(3)}
    frame = pd.DataFrame(columns)
    frame.to_csv(tmp_path / "data.csv", index=False)
    expected = [(check.name, check.verdict) for check in examine(tmp_path / "data.hdf5").checks]
    files = ["data.npz", "data.csv"]
    if importlib.util.find_spec("pyarrow"):
        frame.to_parquet(tmp_path / "data.parquet")
        files.append("data.parquet")
    for name in files:
        examination = examine(tmp_path / name)
        assert [(check.name, check.verdict) for check in examination.checks] == expected, name


def test_help_states_the_exit_codes() -> None:
    outcome = sb3_dce("datasets", "check", "--help")
    assert outcome.code == 0 and "exit code" in outcome.stdout and "cannot be used" in outcome.stdout.replace("\n", " ")


def test_examination_keeps_the_first_error(tmp_path: Path) -> None:
    arrays = clean_arrays()
    arrays["rewards"][3] = np.nan
    error = checked(tmp_path, arrays).error
    assert isinstance(error, DatasetError) and error.key == "rewards" and error.count == 1


def test_every_check_of_the_reader_has_a_line() -> None:
    assert {rule.name for rule in _RULES} | {"time limit", "other"} == set(get_args(CheckName))
