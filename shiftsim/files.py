"""Where users' files are, and how files are read and written: settings in TOML, whole files only.

Nothing else in the project looks at environment variables for folders, and no file is ever seen
half written: `whole_file` is the one way to replace one.
"""

import os
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from shiftsim.errors import ConfigError


def store_path(name: str) -> Path:
    """Folder of a store: a path, or a name below `SHIFTSIM_DATA` (`./shiftsim-data`).

    A store in the current directory may be named without `./`, unless the name is taken below.
    """
    path = Path(name).expanduser()
    if path.is_absolute() or len(path.parts) != 1 or name in (".", ".."):
        return path
    below = Path(os.environ.get("SHIFTSIM_DATA", "shiftsim-data")) / name
    return path if (path / "store.json").is_file() and not below.exists() else below


def checkpoint_folder() -> Path:
    """Folder where checkpoints are found by name: `SHIFTSIM_CHECKPOINTS`, or below the cache."""
    default = "~/.cache/shiftsim/checkpoints"
    return Path(os.environ.get("SHIFTSIM_CHECKPOINTS", default)).expanduser()


def remote_store_folder() -> Path:
    """Folder of what was copied from stores behind a URL: `SHIFTSIM_CACHE`, or below the cache."""
    return Path(os.environ.get("SHIFTSIM_CACHE", "~/.cache/shiftsim")).expanduser() / "stores"


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file to be written, which then takes its place: whole or not at all."""
    partial = path.with_name(f".{path.name}.tmp")
    try:
        yield partial
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def read_toml(path: Path) -> dict[str, Any]:
    """The table in a TOML file.

    Raises:
        ConfigError: There is no such file, or it is not TOML.
    """
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise ConfigError(
            f"cannot read {str(path)!r}: {error.strerror or error}", hint="check the path"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{str(path)!r} is not TOML: {error}", hint="repair the line named above"
        ) from error
