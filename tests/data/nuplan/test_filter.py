"""Scenario filters: nuPlan's YAML files and plain token lists."""

from pathlib import Path

import pytest

from shiftsim.data.nuplan.filter import ScenarioFilter, read_filter
from shiftsim.errors import ConfigError

FILTER = """
_target_: nuplan.planning.scenario_builder.scenario_filter.ScenarioFilter
_convert_: 'all'

scenario_types: # List of scenario types to include
  - starting_left_turn
  - changing_lane
scenario_tokens:
  - '026c317cfdcf519a'
  - "1111111111111111"
  - 2222222222222222  # digits only, without quotes
log_names: ${splitter.log_splits.val}
map_names: null
num_scenarios_per_type: 25
limit_total_scenarios: null
timestamp_threshold_s: 15
expand_scenarios: false
remove_invalid_goals: true
shuffle: false
"""


def write(folder: Path, text: str, name: str = "filter.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_genuine_filter_is_read(tmp_path: Path) -> None:
    assert read_filter(write(tmp_path, FILTER)) == ScenarioFilter(
        tokens=frozenset(["026c317cfdcf519a", "1111111111111111", "2222222222222222"]),
        types=frozenset(["starting_left_turn", "changing_lane"]),
        remove_invalid_goals=True,
        per_type=25,
        min_gap_s=15,
        source=str(tmp_path / "filter.yaml"),
    )


def test_a_token_list_may_have_comments(tmp_path: Path) -> None:
    path = write(tmp_path, "# mine\n026c317cfdcf519a # a\n\n1111111111111111\n", "tokens.txt")
    assert read_filter(path).tokens == frozenset(["026c317cfdcf519a", "1111111111111111"])


def test_inline_lists_and_items_that_are_not_indented_are_read(tmp_path: Path) -> None:
    text = "scenario_types: [x, 'y']\nmap_names:\n- z\nlog_names: []\n"
    found = read_filter(write(tmp_path, text))
    assert (found.types, found.maps) == (frozenset("xy"), frozenset("z"))
    assert found.logs == frozenset()


def test_a_token_of_digits_without_quotes_keeps_its_zeros(tmp_path: Path) -> None:
    path = write(tmp_path, "scenario_tokens: [0123456701234567, 12e4567890123456]")
    assert read_filter(path).tokens == frozenset(["0123456701234567", "12e4567890123456"])


@pytest.mark.parametrize(
    "text",
    [
        "map_names: [1, 2\n",
        "map_names: !!python/object:os.system x\n",
        "- map_names\n",
        "map_names: 'b\n",
        "map_names: [a]\nmap_names: [b]\n",
        "map_names: *x\n",
        "map_names: @x\n",
    ],
)
def test_what_cannot_be_read_is_refused_with_its_line(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"filter\.yaml: line \d"):
        read_filter(write(tmp_path, text))


@pytest.mark.parametrize(
    "text",
    [
        "num_scenarios_per_type: 0\n",
        "num_scenarios_per_type: 0.5\n",
        "limit_total_scenarios: 1.0\n",
        "limit_total_scenarios: -3\n",
        "expand_scenarios: true\n",
        "ego_start_speed_threshold: fast\n",
        "timestamp_threshold_s: .nan\n",
        "fraction_in_token_set_threshold: 1.5\n",
        "token_set_path: nowhere.json\nfraction_in_token_set_threshold: 0.5\n",
        "something_new: 1\n",
        "scenario_tokens:\n  - abc\n",
        "scenario_types: left\n",
        "map_names:\n  b: 1\n",
        "map_names: {b: 1}\n",
        "map_names: |\n  text\n",
        "map_names: &x 1\n",
    ],
)
def test_what_is_not_supported_is_named(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"filter\.yaml"):
        read_filter(write(tmp_path, text))


def test_a_missing_file_and_an_empty_list_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="not readable"):
        read_filter(tmp_path / "nothing.yaml")
    with pytest.raises(ConfigError, match="no token"):
        read_filter(write(tmp_path, "", "tokens.txt"))
