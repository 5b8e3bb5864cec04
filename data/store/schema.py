"""What the Parquet files of a store hold: every column with its type; its range is in `STORE`.

    store.json                        format, version, content hash, digest of every file, and what
                                      made the content up, where it was generated
    scenarios.parquet                 one row per scenario
    maps/<city>.arrow                 the arrays of a map (`shiftsim.data.store.map`)
    recordings/<log>/frames.parquet   one row per row of the recording
    recordings/<log>/lights.parquet   one row per listed traffic light and row of the recording
    recordings/<log>/tracks.parquet   one row per track and row of the recording
    recordings/<log>/ego-<name>.parquet  states of one ego, for some rows of the recording

A recording is stored once; a scenario is a window into it. Names of logs and egos are percent
encoded in file names.
"""

import pyarrow as pa

FORMAT = "shiftsim-store"
VERSION = 4
# rows of a recording per row group of tracks and lights, about: a window reads little else
BLOCK_ROWS = 512
FRAME_BLOCK = 2048  # rows per row group of frames and ego states

_F64, _I64, _I32, _I8 = pa.float64(), pa.int64(), pa.int32(), pa.int8()


def make_schema(**columns: pa.DataType) -> pa.Schema:
    """A schema without missing values."""
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in columns.items()])


def list_of(kind: pa.DataType) -> pa.DataType:
    """The type of lists without missing values."""
    return pa.list_(pa.field("item", kind, nullable=False))


SCENARIOS = make_schema(
    token=pa.string(),  # id, unique in the store
    type=pa.string(),  # scenario type
    city=pa.string(),  # map name
    log=pa.string(),  # log name
    recording=pa.string(),  # recording it is a window of
    ego=pa.string(),  # `ego`, or the token of the track that serves as ego
    first_row=_I64,  # first kept row of the recording
    last_row=_I64,  # one past the last kept row
    row_step=_I64,  # rows between iterations
    iteration_rows=list_of(_I64),  # rows of the recording
    route=list_of(pa.string()),  # roadblock ids, start to goal
    goal_pose=list_of(_F64),  # x_m, y_m, heading_rad; or empty
    duration_s=_F64,  # what it was cut with
    offset_s=_F64,
    subsample_ratio=_F64,
    is_short=pa.bool_(),  # the log ended before the duration did
    metadata=pa.string(),  # JSON
)
# columns that a `Window` has under the same names
SAME = ("token", "ego", "first_row", "last_row", "row_step", "is_short")

FRAMES = make_schema(row=_I32, time_us=_I64)  # times never decrease; increase over iterations

LIGHTS = make_schema(
    row=_I32,  # row of the recording
    light=_I32,  # number of the light: one connector may have several
    connector=pa.string(),  # id of the lane connector
    status=_I8,  # LightStatus code
)

MOTION = ("x_m", "y_m", "heading_rad", "vx_mps", "vy_mps")  # of a box's centre, in the map frame
BOX = (*MOTION, "length_m", "width_m")
TRACKS = make_schema(
    row=_I32,  # row of the recording
    track=_I32,  # number of the track: those of one row are in the order of the source
    token=pa.string(),  # id of the track
    kind=_I8,  # AgentKind code
    **dict.fromkeys(BOX, _F64),
)
MAY_BE_NAN = ("vx_mps", "vy_mps")  # in tracks: of static objects

EGO_COLUMNS = (
    *(*MOTION, "ax_mps2", "ay_mps2"),
    *("steering_angle_rad", "steering_rate_radps", "yaw_rate_radps", "yaw_accel_radps2"),
)
EGO = make_schema(row=_I32, **dict.fromkeys(EGO_COLUMNS, _F64))
