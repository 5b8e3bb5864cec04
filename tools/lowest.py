"""The oldest packages that pyproject.toml allows, one requirement a line."""

import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent


def lowest(requirement: str) -> str:
    """`torch>=2.6,<2.14` becomes `torch>=2.6,==2.6.*`: the newest patch of the oldest version."""
    parsed = Requirement(requirement)
    (bound,) = (each.version for each in parsed.specifier if each.operator == ">=")
    major_minor = [*bound.split("."), "0"][:2]
    return f"{parsed.name}>={bound},=={'.'.join(major_minor)}.*"


if __name__ == "__main__":
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    names = [name for group in (project["dependencies"], *extras) for name in group]
    print("\n".join(sorted({lowest(name) for name in names if not name.startswith("shiftsim")})))
