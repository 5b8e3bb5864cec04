"""Runs planners written for nuPlan: subclasses of its `AbstractPlanner`, unchanged.

Where nuPlan's devkit is installed, planners get its own objects. Where it is not, shims take
the `nuplan.*` module names in this process.

    shiftsim run --planner nuplan:my_package.planner:MyPlanner --planner-arg horizon=8
    shiftsim.run(wrap(MyPlanner(horizon=8)), store="demo")
"""

import functools
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from shiftsim.compat.nuplan.finder import install as install
from shiftsim.compat.nuplan.finder import with_all_missing as with_all_missing
from shiftsim.errors import ConfigError, MissingExtraError
from shiftsim.planners.registry import planner_factory

if TYPE_CHECKING:
    from shiftsim.compat.nuplan.bridge.planner import NuplanPlanner

_METHODS = ("name", "initialize", "observation_type", "compute_planner_trajectory")


def wrap(planner: Any, **arguments: Any) -> "NuplanPlanner":
    """A planner for shiftsim from one for nuPlan.

    Args:
        planner: An instance, which is initialized again for every scenario, or a class, of which
            every scenario gets a new instance, as in nuPlan.
        arguments: For the constructor of a class.

    Raises:
        ConfigError: It is no nuPlan planner, or asks for what shiftsim does not have.
    """
    install()
    from shiftsim.compat.nuplan.bridge.planner import NuplanPlanner

    kind = planner if inspect.isclass(planner) else type(planner)
    _check(kind)
    if kind is not planner and arguments:
        what = f"arguments {', '.join(arguments)} were given for an instance of {kind.__name__}"
        raise ConfigError(what, hint=f"wrap({kind.__name__}, …) or wrap({kind.__name__}(…))")
    return NuplanPlanner(planner, arguments)


def from_spec(spec: str) -> Callable[..., "NuplanPlanner"]:
    """What makes the planner `nuplan:package.module:Class`; a ShiftsimError if it is none."""
    if spec.count(":") != 2:
        what = f"planner {spec!r} is not of the form nuplan:package.module:Class"
        raise ConfigError(what, hint="for example nuplan:my_package.my_module:MyPlanner")
    install()
    inner = spec.removeprefix("nuplan:")
    try:
        return factory(planner_factory(inner))
    except MissingExtraError as error:
        raise with_all_missing(error, inner.rpartition(":")[0]) from error


def factory(kind: Any) -> Callable[..., "NuplanPlanner"]:
    """What makes wrapped planners of a class, by its arguments; a ConfigError if it is none."""
    if not inspect.isclass(kind):
        what = f"{getattr(kind, '__name__', kind)!r} is not a class"
        raise ConfigError(what, hint="nuplan:package.module:Class")
    _check(kind)

    def make(**arguments: Any) -> "NuplanPlanner":
        return wrap(kind, **arguments)

    functools.update_wrapper(make, kind, updated=())
    # said, for `AbstractPlanner.__new__` hides the constructor from some versions of `inspect`
    parameters = [*inspect.signature(kind.__init__, eval_str=True).parameters.values()][1:]
    if kind.__init__ is object.__init__:
        parameters = []
    vars(make)["__signature__"] = inspect.Signature(parameters)
    return make


def _check(kind: type) -> None:
    missing = [name for name in _METHODS if not callable(getattr(kind, name, None))]
    abstract = sorted(getattr(kind, "__abstractmethods__", ()))
    if missing or abstract:
        raise ConfigError(
            f"{kind.__name__} has no method {(missing or abstract)[0]}()",
            hint="a nuPlan planner is a subclass of AbstractPlanner with "
            + ", ".join(f"{name}()" for name in _METHODS),
        )
    if getattr(kind, "requires_scenario", False):
        raise ConfigError(
            f"{kind.__name__} has requires_scenario = True: it wants nuPlan's scenario object with "
            "the recorded future, which shiftsim does not have",
            hint="what a planner is given: route, goal, map, history, traffic lights; "
            "the oracle of shiftsim is log-future",
        )
