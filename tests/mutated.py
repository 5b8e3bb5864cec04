"""Which modules are changed to see whether tests notice it, and the tests that concern each."""

from collections import defaultdict
from pathlib import Path

from mutations import Mutant, mutants_of, sample

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent

METRIC_TESTS = (
    "metrics/test_comfort.py",
    "metrics/test_examples.py",
    "metrics/test_errors.py",
    "metrics/test_open_loop.py",
    "metrics/test_navsim.py",
    "parity/test_metric_worlds.py::test_world",
    "parity/test_nuplan_runs.py",
)
EDITED = "parity/test_scenario_edits.py::test_edits"
OFFICIAL_PLANNERS = "parity/test_pdm.py"
PDM_TESTS = (
    "planners/pdm/test_scorer.py",
    "planners/pdm/test_rollout.py",
    "planners/proposals/test_contacts.py",
    *(f"{OFFICIAL_PLANNERS}::{name}" for name in ("test_kernel", "test_steps")),
    "planners/pdm/test_pdm.py",
    f"{OFFICIAL_PLANNERS}::test_loops",
)
IDM_TESTS = (
    "planners/routes/test_lights.py",
    "planners/routes/test_graph.py",
    "planners/test_idm.py",
    f"{OFFICIAL_PLANNERS}::test_idm_calls",
)
READER_TESTS = (
    "data/readers/test_build.py",
    "data/readers/test_samples.py",
    "data/readers/test_windows.py",
    "data/readers/test_dsc3d.py",
    "data/readers/test_scenarios.py",
)
OPEN_DATA_TESTS = (
    "data/readers/test_build.py",
    "data/readers/test_open_data_samples.py",
    "data/readers/test_open_data.py",
    "data/readers/test_open_data_faults.py",
)
TABLE_TESTS = tuple(
    f"data/readers/tracks/test_{name}.py"
    for name in ("limits", "map_fit", "columns", "reader", "diagnostics")
)
# The tests of each module, fast ones first; a module's own file comes before those of its folder.
# Every group has the same share of a sample.
GROUPS: dict[str, dict[str, tuple[str, ...]]] = {
    "metrics": {"metrics": METRIC_TESTS},
    "sim": {
        "sim.dynamics": ("parity/test_dynamics.py",),
        "sim.noise": (),
        "sim.plan_check": (),
        "sim.loop": (
            "sim/test_plan_check.py",
            "sim/test_lock_step.py",
            "metrics/test_open_loop.py",
        ),
        "sim.traffic": ("sim/traffic/test_own_traffic.py", "sim/traffic/test_learned.py", EDITED),
        "sim.traffic.learned": (
            "sim/traffic/test_learned_features.py",
            "sim/traffic/test_learned.py",
        ),
        "sim.traffic.idm": (
            "sim/traffic/test_idm_paths.py",
            "parity/test_dynamics.py::test_idm_world",
            "sim/traffic/test_idm_buffer.py",
            "sim/traffic/test_idm.py",
            EDITED,
        ),
    },
    "pdm": {
        "planners.pdm": PDM_TESTS,
        "planners.proposals": (*PDM_TESTS, "planners/proposals/test_proposals.py"),
        "planners.routes.correction": (
            "parity/test_route_correction.py",
            f"{OFFICIAL_PLANNERS}::test_routes",
        ),
    },
    "idm": {
        "planners.idm": IDM_TESTS,
        "planners.routes": (
            f"{OFFICIAL_PLANNERS}::test_kernel",
            *IDM_TESTS,
            f"{OFFICIAL_PLANNERS}::test_routes",
        ),
    },
    "readers": {
        "data.readers": READER_TESTS,
        **dict.fromkeys(
            (f"data.readers.{name}" for name in ("av2", "codes", "commonroad", "py123d", "files")),
            OPEN_DATA_TESTS,
        ),
        "data.readers.tracks": TABLE_TESTS,
    },
}
LEFT_OUT = (  # takes long, and notices little more
    "data/readers/tracks/test_diagnostics.py::test_the_map_of_another_place_is_named",
    "data/readers/tracks/test_reader.py::test_a_recording_that_is_converted_again",
    "data/readers/tracks/test_reader.py::test_the_command_converts_and_draws",
    "sim/traffic/test_idm.py::test_order_of_replayed_objects_does_not_matter",
    "planners/pdm/test_pdm.py::test_tracks_of_a_corridor_are_those_its_polygon_touches",
    "planners/proposals/test_proposals.py::test_an_area_holds_the_points_that_shapely_says",
)
TESTS_OF = {f"shiftsim.{name}": tests for group in GROUPS.values() for name, tests in group.items()}


def modules() -> dict[str, str]:
    """The modules that are mutated, and the group of each."""
    found = {}
    for group, names in GROUPS.items():
        for name in names:
            path = ROOT / "shiftsim" / Path(*name.split("."))
            for file in sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]:
                parts = file.relative_to(ROOT).with_suffix("").parts
                found.setdefault(".".join(parts).removesuffix(".__init__"), group)
    return found


def tests_of(module: str) -> list[str]:
    """Tests that concern a module."""
    own = Path(*module.split(".")[1:])
    first = own.parent / f"test_{own.name}.py"
    group = max((name for name in TESTS_OF if f"{module}.".startswith(f"{name}.")), key=len)
    tests = [str(first)] if (TESTS / first).is_file() else []
    tests += [test for test in TESTS_OF[group] if test != str(first)]
    return [str(TESTS / test) for test in tests]


def source_of(module: str) -> str:
    """The text of a module."""
    path = ROOT / Path(*module.split("."))
    return (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text()


def all_mutants() -> list[Mutant]:
    """Every mutant of every module."""
    return [mutant for module in modules() for mutant in mutants_of(module, source_of(module))]


def shared_sample(count: int, seed: int) -> list[Mutant]:
    """A sample in which every group has the same share."""
    group_of, by_group = modules(), defaultdict[str, list[Mutant]](list)
    for mutant in all_mutants():
        by_group[group_of[mutant.module]].append(mutant)
    shares = [sample(by_group[group], count // len(GROUPS), seed) for group in GROUPS]
    return [mutant for share in zip(*shares, strict=True) for mutant in share]
