"""The verdicts of the filter: which scenarios of a store may be used, and why others may not."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from shiftsim.data.store.tables import Table, digest
from shiftsim.errors import DataError

VERDICTS = "filter/verdicts.parquet"
ACCEPTED, DROPPED, FAILED = "accepted", "dropped", "failed"
COLLISION, AREA = "at-fault collision", "drivable area"
STANDING, OFF_ROUTE = "path too short", "progress along the route"

SCHEMA = pa.schema(
    [
        pa.field("token", pa.string(), nullable=False),
        pa.field("verdict", pa.string(), nullable=False),  # accepted, dropped or failed
        pa.field("reason", pa.string(), nullable=False),  # rules broken, or the error
        pa.field("no_at_fault_collisions", pa.float64()),  # score
        pa.field("drivable_area_compliance", pa.float64()),  # score
        pa.field("max_outside_m", pa.float64()),  # furthest corner outside the drivable area
        pa.field("path_m", pa.float64()),  # travelled from iteration 0 to the last one
        pa.field("progress_m", pa.float64()),  # of it along the route driven
        pa.field("partner_token", pa.string()),  # of the first at-fault collision
        pa.field("first_violation_s", pa.float64()),  # since iteration 0, of the first rule broken
    ]
)


@dataclass(frozen=True)
class Verdicts:
    """The verdicts of a store."""

    path: Path  # the file
    # one row per scenario, sorted by token; the columns of the file
    rows: tuple[Mapping[str, Any], ...]
    hash: str  # digest of the file
    config: Mapping[str, Any]  # what the scenarios had to satisfy

    @property
    def accepted(self) -> tuple[str, ...]:
        """Tokens of the accepted scenarios, sorted."""
        return tuple(row["token"] for row in self.rows if row["verdict"] == ACCEPTED)

    @property
    def rejected(self) -> tuple[Mapping[str, Any], ...]:
        """Rows of the scenarios that were dropped or could not be driven."""
        return tuple(row for row in self.rows if row["verdict"] != ACCEPTED)

    def counts(self) -> dict[str, int]:
        """How many scenarios there are by verdict, and how many break each rule."""
        names = (ACCEPTED, DROPPED, FAILED, COLLISION, AREA, STANDING, OFF_ROUTE)
        out = dict.fromkeys(names, 0)
        for row in self.rows:
            out[row["verdict"]] += 1
            for reason in row["reason"].split(", ") if row["verdict"] == DROPPED else ():
                out[reason] += 1
        return out


def read(store: Path) -> Verdicts:
    """The verdicts that a store holds.

    Raises:
        DataError: The file is missing or damaged.
    """
    path = store / VERDICTS
    table = Table(path, SCHEMA)
    config = table.footer.get("config")
    if not isinstance(config, dict):
        raise DataError(f"{path}: the footer has no 'config'", hint=f"shiftsim filter {store}")
    return Verdicts(path, tuple(table.read().to_pylist()), digest(path), config)


def read_verdicts(store: str | Path, store_hash: str) -> Verdicts | None:
    """The verdicts of a store, whose content has a hash; None where it was not filtered.

    Raises:
        DataError: The file is damaged, or of another content of the store.
    """
    path = Path(store)
    if not (path / VERDICTS).is_file():
        return None
    found = read(path)
    if Table(found.path, SCHEMA).footer.get("store") != store_hash:
        raise DataError(
            f"{found.path}: the verdicts are of another content of the store",
            hint=f"shiftsim filter {path}, or --all to use every scenario",
        )
    return found
