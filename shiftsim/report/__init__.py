"""What runs say about planners: tables in five formats, with intervals and comparisons; pictures.

`scores.score_table` is what a run prints; `build.make_tables` makes all tables of several runs.
"""
