"""Where vehicles are put on the lane graph: all at once as one by one."""

import numpy as np

from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.world.lanes import find_start, find_starts


def test_starts_of_many_vehicles_are_those_of_each() -> None:
    scenario = bench_scene(100, 1)
    poses = scenario.tracks.poses[scenario.iteration_rows[0]]
    poses = np.concatenate([poses, poses[:1] + 1e6])  # one off the map
    found = find_starts(scenario.map, poses)
    assert len({start.edge for start in found if start is not None}) > 10
    assert found[-1] is None
    for pose, start in zip(poses, found, strict=True):
        alone = find_start(scenario.map, pose)
        if start is None or alone is None:
            assert start is alone
            continue
        assert (start.edge, start.progress) == (alone.edge, alone.progress)
        assert start.pose.tolist() == alone.pose.tolist()


def test_nobody_starts_nowhere() -> None:
    assert find_starts(bench_scene(10, 0).map, np.zeros((0, 3))) == []
