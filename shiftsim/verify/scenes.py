"""The scenes that reference folders refer to: logs and maps in nuPlan's own formats."""

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path

from shiftsim.data.nuplan.mapping import Mapping as LogMapping
from shiftsim.data.nuplan.scenarios import find_maps, load_map, read_scenario
from shiftsim.errors import DataError
from shiftsim.verify.files import Source, read_json
from shiftsim.verify.report import Report
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario

MAPPING: LogMapping = (15.0, 0.0, 0.5)  # the reference scenes start at their tag


class Scenes(Mapping[str, Scenario]):
    """The scenarios of a nuplan reference folder by scene name, each read when first asked for.

    Attributes:
        folder: Holds `scenes.json`, `logs` and `maps`; without `scenes.json` there are no scenes.
        entries: What `scenes.json` says, by scene name; `report` takes what is compared with it.
        mapping: Duration [s], offset [s] and subsample ratio that the scenarios are cut with.
    """

    def __init__(
        self, folder: Path, report: Report | None = None, mapping: LogMapping = MAPPING
    ) -> None:
        path, used = folder / "scenes.json", report or Report()
        listed = read_json(path) if path.is_file() else []
        entries = [Source("scenes.json", "field", entry, used) for entry in listed]
        self.folder, self.entries = folder, {entry["scene"]: entry for entry in entries}
        self.mapping, self._read = mapping, dict[str, Scenario]()

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __contains__(self, scene: object) -> bool:
        return scene in self.entries

    def __getitem__(self, scene: str) -> Scenario:
        if scene not in self._read:
            entry = self.entries[scene]
            if entry["map"] not in self.maps:
                raise DataError(f"{self.folder / 'scenes.json'}: unknown map {entry['map']!r}")
            path, road = self.folder / entry["db"], self.maps[entry["map"]]
            self._read[scene] = read_scenario(path, entry["token"], road, self.mapping)
        return self._read[scene]

    @cached_property
    def maps(self) -> dict[str, VectorMap]:
        """All maps of the folder by name."""
        files = find_maps(self.folder / "maps")
        return {name: load_map(files, name) for name in files}

    def sources(self, scene: str) -> tuple[Path, Path]:
        """Log and map file of a scene."""
        entry = self.entries[scene]
        return self.folder / entry["db"], find_maps(self.folder / "maps")[entry["map"]]
