"""What a source of recordings offers to the converter, and what it hands over of each."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.maps.lights import LightStates
from shiftsim.data.maps.opendrive.map import build_road_map, require_lanes
from shiftsim.data.maps.opendrive.records import OpenDrive
from shiftsim.data.readers.samples import TrackSamples
from shiftsim.data.readers.windows import ConversionConfig, Span


@dataclass(frozen=True)
class SourceRecording:
    """One recording with its map, and how scenarios are made of it (`make_scenarios`)."""

    samples: TrackSamples
    map: BuiltMap
    config: ConversionConfig | None = None
    scenario_type: str = "unlabelled"
    egos: Sequence[str] | None = None  # ids of the egos; None for every vehicle that can be one
    spans: Sequence[Span] | None = None  # windows; None for all that fit
    left_out_s: float = 0.0  # time at its end that no scenario reaches [s]
    needs_scenario: bool = False  # whether it is an error if none is left
    lights: LightStates | None = None
    # routes that the source has itself, of the recording car: time from which on [s], and by block
    # the ids of the lanes in it; where there is none, or none on the map, routes are found
    routes: Sequence[tuple[float, Sequence[Sequence[str]]]] = ()
    metadata: Mapping[str, object] = field(default_factory=dict)  # source, licence and so on
    warnings: Mapping[str, int] = field(default_factory=dict)  # what the reader left out, by kind
    details: Mapping[str, Any] = field(default_factory=dict)  # for the report, JSON values only


class Reader(ABC):
    """A source of recordings. It must pickle."""

    name: str  # of the site or of the data set
    source: Path  # where it is
    site: BuiltMap | None  # the map that all recordings share, whose report the store gets
    settings: Mapping[str, Any]  # what the result depends on beside the files, JSON values only

    @abstractmethod
    def recordings(self) -> Sequence[str]:
        """Names of the recordings, in the order of the report; a ConversionError without any."""

    @abstractmethod
    def files(self, recording: str) -> Sequence[Path]:
        """The files that a recording is read from."""

    @abstractmethod
    def read(self, recording: str) -> SourceRecording:
        """One recording; a DataError where a file is missing or broken, or contradicts itself."""

    def summarise(self, entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """What the report says of all recordings, from the entry of each, details included.

        Raises ConversionError: they and the map contradict each other; nothing is written then.
        """
        return {}


def opendrive_site(drive: OpenDrive, *, name: str, **how: Any) -> BuiltMap:
    """The map of a site from OpenDRIVE, as `build_road_map`; else a ConversionError."""
    road, report = build_road_map(drive, name=name, **how)
    require_lanes(drive, report)
    return BuiltMap(road, report.warnings)  # none of its connectors has a known light
