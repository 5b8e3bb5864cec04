"""Planners that misbehave, for tests of the runner."""

import json
import os
import struct
import sys
import time
import typing
from pathlib import Path

import numpy as np

from shiftsim.planners.basic import ConstantVelocity
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.world.state import Trajectory

BAD = "0001cafe"


class Failing(ConstantVelocity):
    """Raises in one scenario."""

    def reset(self, scene):
        super().reset(scene)
        if scene.token == BAD:
            raise RuntimeError("cannot drive here")


class Dying(ConstantVelocity):
    """Ends its process in one scenario."""

    def reset(self, scene):
        super().reset(scene)
        if scene.token == BAD:
            os._exit(11)


class Interrupting(ConstantVelocity):
    """Presses Ctrl-C in one scenario."""

    def reset(self, scene):
        super().reset(scene)
        if scene.token == BAD:
            raise KeyboardInterrupt


class Sloppy(ConstantVelocity):
    """Answers with something that is no plan."""

    def plan(self, observation):
        return [1, 2, 3]


class Short(ConstantVelocity):
    """Plans for half a second."""

    def plan(self, observation):
        plan = super().plan(observation)
        return Trajectory(plan.time_us[:6], plan.states[:6], plan.relative)


class NoPlan:
    """Has no method plan()."""

    def reset(self, scene):
        pass


class Greedy:
    """Cannot be made."""

    def __init__(self):
        raise ValueError("no weights")


class Slow(ConstantVelocity):
    """Needs a tenth of a second more."""

    def reset(self, scene):
        super().reset(scene)
        time.sleep(0.1)


class Hanging(ConstantVelocity):
    """Never answers in one scenario, and cannot be asked to stop."""

    def plan(self, observation):
        while self.token == BAD:
            pass
        return super().plan(observation)

    def reset(self, scene):
        super().reset(scene)
        self.token = scene.token


class Moody(ConstantVelocity):
    """Fails, or drives, as a file says."""

    def reset(self, scene):
        super().reset(scene)
        if scene.token == BAD and Path(os.environ["MOOD"]).read_text() == "bad":
            raise RuntimeError("not today")


class Together(LearnedPlanner):
    """Answers for several scenarios at once, and misbehaves in one where told to.

    Its plan depends on nothing but its own scenario; the calls and the size of the largest batch
    are noted in a file.
    """

    def __init__(self, trouble: str = "", notes: str = ""):
        self.trouble, self.notes = trouble, notes

    def reset(self, scene):
        self.inner = ConstantVelocity()
        self.inner.reset(scene)
        self.token = scene.token
        if self.trouble == "reset" and scene.token == BAD:
            raise RuntimeError("cannot drive here")

    def features(self, observation):
        if self.token == BAD and observation.iteration == 5:
            if self.trouble == "features":
                raise RuntimeError("cannot look here")
            if self.trouble == "death":
                os._exit(11)
            self.degraded = "lost" if self.trouble == "lost" else ""
        return observation

    def infer(self, features):
        if self.notes:
            with open(self.notes, "a") as file:
                file.write(f"{len(features)}\n")
        if self.trouble == "pass" and len(features) > 1:
            raise RuntimeError("out of memory")
        return features

    def decode(self, output, observation):
        return self.inner.plan(observation)


class Networked(LearnedPlanner):
    """Has a network of one sum, which fails, or ends its process, in one scenario where told to.

    Every pass is noted in a file: the process, and how many scenarios.
    """

    def __init__(self, trouble: str = "", notes: str = ""):
        self.trouble, self.notes = trouble, notes

    def reset(self, scene):
        self.inner = ConstantVelocity()
        self.inner.reset(scene)
        self.is_bad = scene.token == BAD

    def features(self, observation):
        noise = np.full(100_000, observation.ego.speed)  # large enough to be sent apart
        return np.array([observation.iteration, self.is_bad]), noise

    def infer(self, features):
        if self.notes:
            with open(self.notes, "a") as file:
                file.write(f"{os.getpid()} {len(features)}\n")
        if self.trouble and any(tuple(when) == (5, True) for when, _ in features):
            if self.trouble == "fail":
                raise RuntimeError("cannot infer here")
            ended = Path(f"{self.notes}.ended")
            if self.trouble == "die" or not ended.exists():
                ended.touch()
                os.kill(os.getpid(), 9)
        return [1e-3 * noise.mean() for _, noise in features]

    def decode(self, output, observation):
        plan = self.inner.plan(observation)
        plan.states[:, 1] += output
        return plan


class Remembers(ConstantVelocity):
    """Plans differently after every scenario that it has driven, and says so."""

    def __init__(self):
        print("made")
        self.driven = []

    def reset(self, scene):
        print("reset")
        print("as a library writes")
        self.driven.append(scene.token)

    def plan(self, observation):
        plan = super().plan(observation)
        plan.states[:, 1] += 0.1 * len(self.driven)
        return plan


class FollowsItsRoute(ConstantVelocity):
    """Drives along the line of its route, slower the nearer the lead or a red light is."""

    def reset(self, scene):
        self.line = scene.route_line()

    def plan(self, observation):
        times, line = np.arange(41) * 0.1, self.line
        stops = [
            ahead.gap for ahead in (observation.lead(line), observation.lights_on(line)) if ahead
        ]
        speed = min([*stops, 8.0, 1.0 + len(observation.in_ego_frame().tokens)])
        s, d, _ = line.to_frenet(observation.ego.pose)
        poses = line.to_poses(np.c_[s + speed * times, np.full(41, d)])
        return Trajectory.from_poses(times, poses)


class RemembersInItsClass(ConstantVelocity):
    """Plans by how many scenarios were driven in this process: no copy helps, one alone is fine."""

    driven: typing.ClassVar = set()

    def reset(self, scene):
        self.driven.add(scene.token)

    def plan(self, observation):
        plan = super().plan(observation)
        plan.states[:, 1] += 0.1 * len(self.driven)
        return plan


class Odd(ConstantVelocity):
    """Does something odd at iteration 3, something else in every scenario."""

    def __init__(self, odd):
        self.odd = odd

    def reset(self, scene):
        self.what = self.odd.get(scene.token, "")

    def plan(self, observation):
        if observation.iteration == 3:
            if self.what == "exits":
                os._exit(7)
            if self.what == "raises":
                raise KeyError("lane")
            if self.what == "leaves":
                raise SystemExit(3)
            if self.what == "none":
                return None
        return super().plan(observation)


class Intruder(ConstantVelocity):
    """Writes to the socket of its process, as its argument says of the scenario."""

    def __init__(self, odd):
        self.odd = odd

    def reset(self, scene):
        super().reset(scene)
        self.what = self.odd.get(scene.token, "")

    def plan(self, observation):
        if self.what and observation.iteration == 2:
            message = json.dumps([5, "done", None]).encode()
            if self.what == "deep":
                message = b"[" * 100_000
            head = struct.pack("!i", len(message))
            if self.what in ("endless", "large"):
                head = struct.pack("!iQ", -1, 2**62 if self.what == "endless" else 2**40)
            os.write(int(sys.argv[2]), head + message)
        return super().plan(observation)
