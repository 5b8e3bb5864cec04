"""Reference tables: Parquet files whose rows belong to keyed groups (a scene, a run)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from shiftsim.errors import DataError

Group: TypeAlias = dict[str, NDArray[Any]]
RUN_KEY = ("scene", "challenge", "planner")


def read_groups(path: Path, key: Sequence[str] = RUN_KEY) -> dict[tuple[str, ...], Group]:
    """Rows of a table by key, in the order of the file.

    Args:
        path: Parquet file.
        key: Columns that name the group.

    Returns:
        Key values → column → array of the group's rows; strings are object arrays, a column of
        nothing but nulls is full of None.

    Raises:
        DataError: The file cannot be read or a key column is missing.
    """
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise DataError(f"{path}: not a readable Parquet file ({error})") from error
    missing = [name for name in key if name not in table.column_names]
    if missing:
        raise DataError(f"{path}: column {missing[0]!r} is missing")
    columns = {name: table[name].to_numpy() for name in table.column_names}
    groups: dict[tuple[str, ...], list[int]] = {}
    for row, values in enumerate(zip(*(columns[name].tolist() for name in key), strict=True)):
        groups.setdefault(tuple(map(str, values)), []).append(row)
    return {
        values: {name: column[np.array(rows)] for name, column in columns.items()}
        for values, rows in groups.items()
    }
