"""Import paths of earlier versions work for one version more, and say where things are now."""

import importlib

import pytest

from shiftsim._moved import MODULES


@pytest.mark.parametrize(("old", "new"), MODULES.items())
def test_a_module_that_moved_is_found(old, new):
    with pytest.warns(DeprecationWarning, match=f"{old} is now {new}"):
        earlier = importlib.reload(importlib.import_module(old))
    current = importlib.import_module(new)
    public = {name for name in vars(current) if not name.startswith("_")}
    assert public
    assert all(vars(earlier)[name] is vars(current)[name] for name in public)


@pytest.mark.parametrize(
    ("package", "name", "new"),
    [
        ("shiftsim.data.maps.opendrive", "read_opendrive", "shiftsim.data.maps.opendrive.reading"),
        ("shiftsim.data.store", "StoreWriter", "shiftsim.data.store.writing"),
        ("shiftsim.data.store", "open_store", "shiftsim.data.store.reading"),
        ("shiftsim.planners", "load_planner", "shiftsim.planners.registry"),
    ],
)
def test_a_name_that_moved_is_found(package, name, new):
    with pytest.warns(DeprecationWarning, match=f"{name} is now {new}"):
        found = getattr(importlib.import_module(package), name)
    assert found is getattr(importlib.import_module(new), name)


def test_other_names_are_unknown():
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("shiftsim.simulations")
    with pytest.raises(AttributeError, match="no attribute 'load'"):
        importlib.import_module("shiftsim.planners").load  # noqa: B018
