"""What the files of a store hold: every column with its type and unit.

    store.json                        format, version, content hash, digest of every file, and what
                                      made the content up, where it was generated
    scenarios.parquet                 one row per scenario
    maps/<city>.parquet               one row: the arrays of the map, flat
    recordings/<log>/frames.parquet   one row per row of the recording: time, traffic lights
    recordings/<log>/tracks.parquet   one row per box, in blocks of `BLOCK_ROWS` rows of time
    recordings/<log>/ego-<name>.parquet  states of one ego, for some rows of the recording

A recording is stored once; a scenario is a window into it. Names of logs and egos are percent
encoded in file names. Lists that belong to a whole file (tokens and kinds of the tracks, ids of
the connectors) are JSON in its footer.
"""

import pyarrow as pa

from shiftsim.data.arrow import defer_pandas

defer_pandas()  # before the first array

FORMAT = "shiftsim-store"
VERSION = 3
READABLE = (1, 2, 3)
# rows of a recording per row group of tracks, about: what opening one costs is that of 80 more rows
BLOCK_ROWS = 512
FIRST_BLOCK_ROWS = 128  # in version 1, whose footers do not say it
FRAME_BLOCK = 2048  # rows per row group of frames and ego states

_F64, _I64, _I32 = pa.float64(), pa.int64(), pa.int32()


def _schema(**columns: pa.DataType) -> pa.Schema:
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in columns.items()])


SCENARIOS = _schema(
    token=pa.string(),  # id, unique in the store
    type=pa.string(),  # scenario type
    city=pa.string(),  # map name
    log=pa.string(),  # log name
    recording=pa.string(),  # recording it is a window of
    ego=pa.string(),  # `ego`, or the token of the track that serves as ego
    first_row=_I64,  # first kept row of the recording
    last_row=_I64,  # one past the last kept row
    row_step=_I64,  # rows between iterations
    iteration_rows=pa.list_(pa.field("item", _I64, nullable=False)),  # rows of the recording
    route=pa.list_(pa.field("item", pa.string(), nullable=False)),  # roadblock ids, start to goal
    goal_pose=pa.list_(pa.field("item", _F64, nullable=False)),  # x_m, y_m, heading_rad; or empty
    duration_s=_F64,  # what it was cut with
    offset_s=_F64,
    subsample_ratio=_F64,
    is_short=pa.bool_(),  # the log ended before the duration did
    metadata=pa.string(),  # JSON
)

# Columns of a scenario that its `Window` is made of, and those of them that hold one number each.
WINDOW = tuple(name for name in SCENARIOS.names if name not in ("city", "log"))
NUMBERS = (
    *("first_row", "last_row", "row_step", "duration_s", "offset_s", "subsample_ratio"),
    "is_short",
)
# … that it has as they are
SAME = ("token", "ego", "first_row", "last_row", "row_step", "is_short")

FRAMES = _schema(
    time_us=_I64,  # never decreasing, and strictly increasing over iterations
    light_status=pa.list_(pa.field("item", pa.int8(), nullable=False)),
    # … one LightStatus code per connector of the footer, -1 not listed
)

# Columns that change evenly in time are stored as second differences of their bits, in the order of
# the rows and from the beginning of each row group (`shiftsim.data.store.boxes`).
CODED = "_diff2"  # how the names of these columns end
MOTION = ("x_m", "y_m", "heading_rad", "vx_mps", "vy_mps")  # of a box's centre, in the map frame
_INDICES = {"row": _I32, "track": _I32}  # row of the recording; in the footer's tokens and kinds
_SIZES = {"length_m": _F64, "width_m": _F64}
TRACKS = _schema(**{f"{name}{CODED}": _I64 for name in MOTION}, **_INDICES, **_SIZES)
FORMER_TRACKS = _schema(**dict.fromkeys(MOTION, _F64), **_INDICES, **_SIZES)  # up to version 2

EGO_COLUMNS = (
    "x_m",
    "y_m",
    "heading_rad",
    "vx_mps",
    "vy_mps",
    "ax_mps2",
    "ay_mps2",
    "steering_angle_rad",
    "steering_rate_radps",
    "yaw_rate_radps",
    "yaw_accel_radps2",
)
EGO = _schema(states_diff2=_I64)  # in each row group all of the first column, then of the next, …
FORMER_EGO = _schema(**dict.fromkeys(EGO_COLUMNS, _F64))  # up to version 2

# Columns of few values in any file.
REPEATING = (
    *("log", "recording", "ego", "type", "city", "duration_s", "offset_s", "subsample_ratio"),
    *("length_m", "width_m"),
)
