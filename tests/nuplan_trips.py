"""From logs to a store, out as logs again, and back: for tests of the export to nuPlan."""

import json

from shiftsim.data.nuplan.convert import convert_nuplan
from shiftsim.data.nuplan.export import export_nuplan
from shiftsim.data.store.reading import open_store

FROM_START = (15.0, 0.0, 0.5)
# the scenes with lights, with static objects and jittered stamps, and with a car park
SCENES = ("s02_curve_objects", "s04_left_turn", "s09_carpark_exit")


def round_trip(reference, folder, mapping, scenes):
    """Two stores: from the reference, and from its export."""
    listed = json.loads((reference / "scenes.json").read_text())
    entries = listed if isinstance(listed, list) else listed.get("scenes", listed)
    entries = entries.values() if isinstance(entries, dict) else entries
    tokens = [entry["token"] for entry in entries]
    for scene in scenes:
        convert_nuplan(
            reference / "logs" / f"{scene}.db",
            reference / "maps",
            folder / "first",
            tokens=tokens,
            mapping=mapping,
        )
    store = open_store(folder / "first")
    report = export_nuplan(store, folder / "out")
    done = convert_nuplan(
        report.logs, report.maps, folder / "second", tokens=report.tokens.values(), mapping=mapping
    )
    assert done.failed == {}
    assert len(store) == len(scenes) == len(done.converted)
    return store, open_store(folder / "second"), report
