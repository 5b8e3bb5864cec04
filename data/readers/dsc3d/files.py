"""Columns of a DSC3D recording: read without trust, and refused with the place and the reason."""

import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.errors import ConversionError
from shiftsim.kernels import FloatArray
from shiftsim.world.ranges import DSC3D, require

POSITION = ("translation_x", "translation_y", "translation_z")
ROTATION = ("rotation_x", "rotation_y", "rotation_z")
DIMENSION = ("dimension_x", "dimension_y", "dimension_z")
VELOCITY = ("velocity_x", "velocity_y")
REPAIR = "get the recording again from its source, or repair the file"


def read_table(path: Path, wanted: tuple[str, ...], max_rows: int) -> pa.Table:
    """The columns wanted, as far as the file has them.

    Raises:
        ConversionError: The file is missing, not Parquet, or has more rows than `max_rows`.
    """
    if not os.path.isfile(path):  # a name may be too long to ask for
        raise ConversionError(f"{path} is missing", "copy the whole recording folder")
    try:
        file = pq.ParquetFile(path)
        if file.metadata.num_rows > max_rows:
            raise ConversionError(
                f"{path}: {file.metadata.num_rows} rows, at most {max_rows} can be read",
                "split the recording",
            )
        names = [name for name in wanted if name in file.schema_arrow.names]
        names_only = [name for name in ("category",) if name in names]
        file = pq.ParquetFile(path, read_dictionary=names_only)  # long names are not repeated
        return file.read(names, use_threads=False)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise ConversionError(f"{path}: not a readable Parquet file ({error})", REPAIR) from error


def numbers(table: pa.Table, key: str, path: Path) -> FloatArray:
    """One numeric column as float64, finite and without nulls.

    Raises:
        ConversionError: It is missing, or a value cannot be.
    """
    if key not in table.column_names:
        raise ConversionError(f"{path}: column {key!r} is missing", REPAIR)
    column = table[key]
    if column.null_count:
        raise ConversionError(f"{path}: column {key!r} holds {column.null_count} nulls", REPAIR)
    try:
        values = column.cast(pa.float64()).to_numpy().astype(np.float64, copy=False)
    except (pa.ArrowException, ValueError, TypeError) as error:
        what = f"{path}: column {key!r} is {column.type}, need numbers"
        raise ConversionError(what, REPAIR) from error
    require(DSC3D, key, values, f"{path}: column", error=ConversionError)
    return values
