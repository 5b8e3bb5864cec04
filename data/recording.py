"""What a reader hands to the store: a recording once, and scenarios as windows into it."""

from dataclasses import dataclass, field

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.state import Tracks, TrafficLights


@dataclass(frozen=True)
class Recording:
    """Everything observed during one recorded drive, except the ego. R rows.

    Attributes:
        log_name: Name of the recording, unique in a store.
        city: Name of the map it was recorded on.
        time_us: (R,) time stamps, strictly increasing [us].
        tracks: All tracks over the rows; a track that serves as ego in some scenario is among
            them, and is left out of that scenario's tracks when it is read.
        lights: Traffic lights over the rows.
    """

    log_name: str
    city: str
    time_us: IntArray
    tracks: Tracks
    lights: TrafficLights


@dataclass(frozen=True)
class EgoTrace:
    """The ego's own states over a span of a recording.

    Attributes:
        log_name: The recording.
        name: `ego` for the recording vehicle, else the token of the track that serves as ego.
        first_row: Row of the recording of the first state.
        states: (R', 11) columns of `state.STATE_COLUMNS`, one per row of the recording.
    """

    log_name: str
    name: str
    first_row: int
    states: FloatArray


@dataclass(frozen=True)
class Window:
    """One scenario: a span of a recording, seen from one ego.

    Attributes:
        token: Id of the scenario, unique in a store.
        scenario_type: Its tag; `unknown` without one.
        log_name: The recording.
        ego: Name of its `EgoTrace`.
        first_row: First row that is kept (history before iteration 0 included).
        last_row: One past the last row that is kept.
        iteration_rows: (T,) rows of the iterations, counted from the start of the recording.
        row_step: Rows between iterations.
        route: Route roadblock ids.
        mission_goal: (3,) goal x [m], y [m], heading [rad], or None.
        mapping: Duration [s], offset [s], subsample ratio.
        is_short: Whether the recording ended before the duration did.
        metadata: Anything else worth keeping, JSON values only.
    """

    token: str
    scenario_type: str
    log_name: str
    ego: str
    first_row: int
    last_row: int
    iteration_rows: IntArray
    row_step: int
    route: tuple[str, ...]
    mission_goal: FloatArray | None
    mapping: tuple[float, float, float]
    is_short: bool = False
    metadata: dict[str, object] = field(default_factory=dict)
