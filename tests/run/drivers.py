"""Planners that misbehave, for tests of the runner."""

import os

from shiftsim.planners.constant_velocity import ConstantVelocity

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


class NoPlan:
    """Has no method plan()."""

    def reset(self, scene):
        pass


class Greedy:
    """Cannot be made."""

    def __init__(self):
        raise ValueError("no weights")
