"""A planner that runs without shiftsim: the name is all that it needs."""

import importlib

import numpy as np

import shiftsim


class Foreign:
    """Uses what every interpreter has: NumPy, and the name `shiftsim`."""

    def __init__(self, speed=5.0):
        self.speed = speed
        self.driven = 0

    def reset(self, scene):
        self.driven += 1
        assert scene.expert is None
        assert scene.map.baselines.at(0).shape[1] == 2
        assert scene.map.edges.ids
        assert scene.map.edges.polygons.xy.shape[1] == 2

    def plan(self, observation):
        assert observation.tracks.poses.shape[0] == 1
        assert observation.traffic_lights == {} or observation.traffic_lights
        x, y, heading = observation.ego.pose
        t = np.arange(81) * 0.1
        d = (self.speed + self.driven) * t
        poses = np.c_[x + d * np.cos(heading), y + d * np.sin(heading), np.full_like(t, heading)]
        return shiftsim.Trajectory.from_poses(t, poses)


class Asks(Foreign):
    """Asks for what is there beside shiftsim only."""

    def __init__(self, what):
        super().__init__()
        self.what = what

    def plan(self, observation):
        if self.what == "observation":
            observation.lead(None)
        elif self.what == "module":
            shiftsim.simulate()
        else:
            importlib.import_module("shiftsim.env")
        return super().plan(observation)
