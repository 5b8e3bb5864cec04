"""What runs say about planners: tables in five formats, with intervals and comparisons; pictures.

`score_table` is what a run prints; `build_report` makes everything from several runs.
"""

from shiftsim.report.groups import COLUMNS, Group, KnownSet, read_groups
from shiftsim.report.scores import (
    GROUPINGS,
    ScoreRow,
    failures,
    score_rows,
    score_table,
    summary,
    worst_rollouts,
)
from shiftsim.report.tables import Table
from shiftsim.report.writers import ENDINGS, FORMATS, render

__all__ = [
    "COLUMNS",
    "ENDINGS",
    "FORMATS",
    "GROUPINGS",
    "Group",
    "KnownSet",
    "ScoreRow",
    "Table",
    "failures",
    "read_groups",
    "render",
    "score_rows",
    "score_table",
    "summary",
    "worst_rollouts",
]
