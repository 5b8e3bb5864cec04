"""The review of a store by people: decisions and corrected routes, as an overlay.

`review/review.jsonl` in the store holds one JSON object per reviewed scenario: `token`, `decision`
(accept, reject or empty), `comment`, `route` (ids of the corrected route, or null), `reviewer`,
`version`. The scenarios themselves keep their bytes.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from shiftsim.data.store.tables import REVIEW
from shiftsim.errors import ConfigError, DataError, one_of
from shiftsim.files import atomic_write, make_table, read_json_lines, safe_join
from shiftsim.world.map import VectorMap

ACCEPT, REJECT, UNDECIDED = "accept", "reject", ""
_DECISIONS = (ACCEPT, REJECT, UNDECIDED)


@dataclass(frozen=True, slots=True)
class Review:
    """What a person says of one scenario."""

    token: str  # the scenario
    # `accept`, `reject`, or empty where there is only a comment or a route
    decision: str = UNDECIDED
    comment: str = ""  # why
    # corrected route roadblock ids; None where the recorded route stands
    route: tuple[str, ...] | None = None
    reviewer: str = ""  # who says so
    version: str = ""  # version of shiftsim it was written with

    @property
    def is_empty(self) -> bool:
        """Whether it says nothing."""
        return self.decision == UNDECIDED and not self.comment and self.route is None


class Reviews(dict[str, Review]):
    """The reviews of a store, by scenario, sorted."""

    def __init__(self, reviews: Iterable[Review] = ()) -> None:
        said = {review.token: review for review in reviews if not review.is_empty}
        super().__init__(sorted(said.items()))

    @property
    def hash(self) -> str:
        """Digest of everything that changes a run: decisions and routes; empty without reviews."""
        decided = [self[t] for t in self if self[t].decision or self[t].route is not None]
        return _digest([[review.token, review.decision, review.route] for review in decided])

    @property
    def route_hash(self) -> str:
        """Digest of the corrected routes; empty without any."""
        return _digest(
            [[token, self[token].route] for token in self if self[token].route is not None]
        )

    def usable(self, tokens: Iterable[str], accepted: Iterable[str]) -> tuple[str, ...]:
        """Those of all `tokens` to use: a decision goes before what the filter `accepted`."""
        passed = set(accepted)
        decided = {token: self[token].decision for token in self}
        return tuple(
            token
            for token in tokens
            if decided.get(token) == ACCEPT or (token in passed and decided.get(token) != REJECT)
        )

    def with_review(self, review: Review) -> "Reviews":
        """The reviews with one replaced, or removed when it says nothing."""
        return Reviews([*(self[t] for t in self if t != review.token), review])


def _digest(rows: list[Any]) -> str:
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest() if rows else ""


def read_reviews(store: Path) -> Reviews:
    """The reviews of a store, none where nobody reviewed it; a DataError if damaged."""
    path = store / REVIEW
    if not path.is_file():
        return Reviews()
    out: dict[str, Review] = {}
    for where, values in read_json_lines(path):
        review = parse_review(values, where)
        if review.token in out:
            what = f"{where}: scenario {review.token!r} is reviewed twice"
            raise DataError(what, hint="keep one of the lines")
        out[review.token] = review
    return Reviews(out.values())


def parse_review(values: Any, where: str) -> Review:
    """A review from JSON values, which are at `where`; a DataError if they are none."""
    try:
        review = make_table(Review, values, where)
        one_of(f"{where}: decision", review.decision, _DECISIONS)
    except ConfigError as error:
        raise DataError(error.message, error.hint or "correct or remove that line") from error
    if review.route == ():
        raise DataError(f"{where}: the route is empty", "leave it out, or list its roadblocks")
    return review


def write_reviews(store: Path, reviews: Reviews) -> Path:
    """Write the reviews of a store, whole or not at all; returns the file."""
    path = safe_join(store, REVIEW)
    path.parent.mkdir(exist_ok=True)
    lines = [json.dumps(asdict(reviews[token]), ensure_ascii=False) + "\n" for token in reviews]
    # half a surrogate pair, for which UTF-8 has no bytes, is written as JSON escapes it
    options: Any = {"encoding": "utf-8", "errors": "backslashreplace", "newline": "\n"}
    with atomic_write(path) as partial, partial.open("w", **options) as file:
        file.write("".join(lines))
        file.flush()
        os.fsync(file.fileno())
    return path


def require_blocks(road: VectorMap, review: Review, where: str) -> None:
    """Every roadblock of a corrected route must be on the map, else a DataError."""
    unknown = [name for name in review.route or () if name not in road.blocks.index]
    if unknown:
        raise DataError(
            f"{where}: the corrected route of {review.token!r} has roadblock {unknown[0]!r}, "
            f"which map {road.name!r} does not have",
            hint=f"correct it with `shiftsim inspect`, or remove its line from {REVIEW}",
        )


def route_problems(road: VectorMap, route: Sequence[str], start: int | None) -> list[str]:
    """What is wrong with a route, in words; the ego's first block is `start`, if any."""
    unknown = [name for name in route if name not in road.blocks.index]
    if unknown:
        return [f"roadblock {unknown[0]} is not on the map"]
    blocks = [road.blocks.index[name] for name in route]
    problems = [] if len(blocks) > 1 else ["a route has at least two roadblocks"]
    twice = sorted({route[i] for i, block in enumerate(blocks) if block in blocks[:i]})
    problems += [f"roadblock {name} is there twice" for name in twice]
    problems += [
        f"{route[i]} does not lead to {route[i + 1]}"
        for i in range(len(blocks) - 1)
        if blocks[i + 1] not in road.block_outgoing.at(blocks[i])
    ]
    if start is not None and start not in blocks:
        problems.append(f"the ego starts on {road.blocks.ids[start]}, which is not on the route")
    return problems
