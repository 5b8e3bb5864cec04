"""Edits of recorded scenarios: what may be edited, and how a new scenario is made.

`Scenario.edited` is attached here: the world knows nothing of edits, and `shiftsim.api`, through
which users get scenarios, imports this module.
"""

from shiftsim.world.scenario import Scenario


def edited(scenario: Scenario, name: str = "edited", **tables: object) -> Scenario:
    """This scenario with something changed, as one `[[edit]]` of `edits.toml` would.

    Args:
        scenario: The recorded scenario.
        name: Ends the token of the new scenario.
        tables: What to change, as in the file: `spawn`, `remove`, `walk`, … (docs/edits.md).

    Raises:
        ConfigError: A table is wrong, or cannot be applied.

    Example:
        ```python
        scenario = shiftsim.open_store("demo")["03b23c"]
        place = {"ahead_m": 30.0, "left_m": -3.0}
        parked = scenario.edited(spawn={"at": place, "behavior": "stopped"})
        print(parked.token, parked.script.words)
        ```
    """
    from shiftsim.edits.apply import apply_edit  # a rollout without edits loads none of it
    from shiftsim.edits.spec import make_edit

    return apply_edit(scenario, make_edit({"name": name, **tables}, "edited"))


Scenario.edited = edited
