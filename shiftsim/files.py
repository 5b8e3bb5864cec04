"""Where users' files are, and how files are read and written: settings in TOML, whole files only.

Nothing else in the project looks at environment variables for folders, and no file is ever seen
half written: `atomic_write` is the one way to replace one. What a file that may be anybody's names
is looked for inside its folder only, with `safe_join`.
"""

import inspect
import json
import os
import re
import sys
import tempfile
import tomllib
import traceback
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, TypeAlias, TypeVar, Union, get_args, get_origin

from shiftsim.errors import ConfigError, DataError, one_of

PACKAGE = Path(__file__).parent
DEFAULT_STORE = "demo"
_KINDS = {float: "a number", int: "an integer", str: "a text", bool: "true or false"}
_T = TypeVar("_T")
# raises an error where a value of the right type is wrong; gets its name, the value, where it is
Check: TypeAlias = Callable[[str, Any, str], None]
_IMPORT = re.compile(
    r"\n *(?:from shiftsim\.([\w.]+) import (?:\(([^)]*)\)|([^\n(]+))|import shiftsim\.([\w.]+))"
)


def store_path(name: str | Path) -> Path:
    """Folder of a store: a path, or a name below `SHIFTSIM_DATA` (`./shiftsim-data`).

    A text with a separator is a path. A store in the current directory may be named without `./`,
    unless the name is taken below.
    """
    name = str(name)
    path = expand(name)
    if "/" in name or name == ".." or len(path.parts) != 1:  # the Path of `./x` would be a name
        return path.absolute() if len(path.parts) == 1 else path
    below = Path(os.environ.get("SHIFTSIM_DATA", "shiftsim-data")) / name
    return path if (path / "store.json").is_file() and not below.exists() else below


def checkpoint_folder() -> Path:
    """Folder where checkpoints are found by name: `SHIFTSIM_CHECKPOINTS`, or below the cache."""
    return expand(os.environ.get("SHIFTSIM_CHECKPOINTS", f"{_home_cache()}/checkpoints"))


def user_cache(part: str) -> Path:
    """Folder of what is kept to save time, below `SHIFTSIM_CACHE` (`~/.cache/shiftsim`).

    `stores` are files copied from stores behind a URL, `kernels` are compiled kernels.
    """
    return expand(os.environ.get("SHIFTSIM_CACHE", _home_cache())) / part


def _home_cache() -> str:
    """Default folder of caches; that of temporary files for a user without a home."""
    if (home := os.path.expanduser("~")) != "~":
        return f"{home}/.cache/shiftsim"
    return f"{tempfile.gettempdir()}/shiftsim-{os.getuid()}"


def expand(name: str) -> Path:
    """A path with the home folder in the place of `~`, where there is one."""
    return Path(os.path.expanduser(name))


def safe_join(folder: Path, name: str) -> Path:
    """The place of something in a folder by its relative path; a DataError if it is outside."""
    place = folder / name
    try:
        if place.resolve().is_relative_to(folder.resolve()):
            return place
    except (OSError, ValueError, RuntimeError):  # a circle of links, a zero byte
        pass
    raise DataError(
        f"{str(folder)!r}: {name!r} is outside of this folder",
        hint="do not trust that folder: a file in it names, or is a link to, something elsewhere",
    )


def temp_path(path: Path) -> Path:
    """Where a file is written before it takes its place; nothing is there, not even a link."""
    partial = path.with_name(f".{path.name}.tmp")
    partial.unlink(missing_ok=True)
    return partial


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A file to be written, which then takes its place: whole or not at all."""
    partial = temp_path(path)
    try:
        yield partial
        partial.replace(path)
    except BaseException:
        with suppress(OSError):  # the error that counts is the first one
            partial.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file in one step, in UTF-8.

    Half a surrogate pair, for which UTF-8 has no bytes, is written as JSON would escape it.
    """
    with atomic_write(path) as partial:
        partial.write_text(text, "utf-8", errors="backslashreplace", newline="")


def read_json_lines(path: Path) -> Iterator[tuple[str, Any]]:
    """Where each line is, in words, and its JSON value; blank lines are left out.

    A line ends at a line feed and nowhere else: JSON may hold the other separators of Unicode. It
    is a DataError if one is not JSON in UTF-8.
    """
    for number, line in enumerate(path.read_bytes().split(b"\n"), 1):
        where = f"{path}: line {number}"
        if line.strip():
            try:
                yield where, json.loads(line.decode())
            except (ValueError, RecursionError) as error:
                what = f"{where}: not JSON: {error}"
                raise DataError(what, hint="repair or remove that line") from error


def lock(path: Path) -> BinaryIO:
    """A file, made if needed, that one process at a time has open here; closing it lets others in.

    Where the system or the file system has no locks, nobody is kept out. It is a BlockingIOError if
    another process has it.
    """
    while True:
        file = path.open("a+b", buffering=0)
        if sys.platform == "win32":
            return file
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise
        except OSError:
            pass  # a file system without locks
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()  # who had it has removed it since it was opened


def read_toml(path: Path) -> dict[str, Any]:
    """The table in a TOML file, or a ConfigError."""
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        what = f"cannot read {str(path)!r}: {error.strerror or error}"
        raise ConfigError(what, hint="check the path") from error
    except (ValueError, RecursionError) as error:  # also a number of thousands of digits
        what = f"{str(path)!r} is not TOML: {error}"
        raise ConfigError(what, hint="repair the line named above") from error


def make_table(cls: type[_T], table: Any, where: str, check: Check = lambda *_: None) -> _T:
    """A dataclass from plain values, such as those of TOML or JSON: its fields are their keys.

    Lists become tuples, and tables dataclasses; one table where a list is wanted is a list of one.
    Types are checked strictly, but that an integer is a number, and a path a text. It is a
    ConfigError if a key is unknown or missing, or a value is of another type.
    """
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where}: {table!r} is not a table")
    known = {item.name: item for item in fields(cls)}  # type: ignore[arg-type]
    for name in table:
        one_of(f"{where}: key", str(name), known)
    for name, item in known.items():
        if name not in table and item.default is MISSING and item.default_factory is MISSING:
            raise ConfigError(f"{where}: {name} is missing")
    values = {n: _value(known[n].type, table[n], n, where, check) for n in known if n in table}
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error.message}", error.hint) from error


def _value(kind: Any, value: Any, name: str, where: str, check: Check) -> Any:
    """A value as the type annotation `kind` has it."""
    if get_origin(kind) in (Union, types.UnionType):
        kind, *others = (choice for choice in get_args(kind) if choice is not types.NoneType)
        if value is None or others:
            return value
    if kind is Any or (is_dataclass(kind) and type(value) is kind):
        return value
    if is_dataclass(kind):
        return make_table(kind, value, f"{where}, {name}", check)  # type: ignore[arg-type]
    origin, kinds, is_table = get_origin(kind), get_args(kind), isinstance(value, Mapping)
    what = f"{where}: {name} is {value!r}; it must be"
    if origin is tuple:
        listed = [value] if is_table or is_dataclass(value) else value
        if not isinstance(listed, (list, tuple)):
            raise ConfigError(f"{what} a list")
        each = [kinds[0]] * len(listed) if kinds[-1] is Ellipsis else kinds
        if len(each) != len(listed):
            raise ConfigError(f"{where}: {name} has {len(listed)} values, not {len(each)}")
        pairs = zip(each, listed, strict=True)
        return tuple(_value(kind, item, name, where, check) for kind, item in pairs)
    if origin is not None:
        if not is_table:
            raise ConfigError(f"{what} a table")
        return {k: _value(kinds[1], item, name, where, check) for k, item in value.items()}
    if kind is str and isinstance(value, os.PathLike):
        value = os.fspath(value)
    wanted = (int, float) if kind is float else kind
    if not isinstance(value, wanted) or (isinstance(value, bool) and kind is not bool):
        raise ConfigError(f"{what} {_KINDS[kind]}")
    if kind is float and isinstance(value, int) and abs(value) > sys.float_info.max:
        raise ConfigError(f"{what} a number that is not so large")
    check(name, value, where)
    return float(value) if kind is float else value


def import_named(module: str) -> ModuleType:
    """A module by its name, or by its file, `folder/name.py`.

    One that the user has named may lie in the current folder, and what it imports, too. Nothing
    else is ever imported from there: a stray file is not code. It is an ImportError if there is
    none, it fails, or it ends the process.
    """
    name, folder = (module, Path.cwd()) if not module.endswith(".py") else _module_of(Path(module))
    if not name.startswith("shiftsim.") and str(folder) not in sys.path:
        finder = UserFolder(str(folder), name.partition(".")[0])
        folders = user_folders()
        libraries = [found for found in sys.meta_path if found not in folders]
        if finder in folders:  # it knows what it has found
            finder = folders.pop(folders.index(finder))
        sys.meta_path[:] = [*libraries, finder, *folders]  # the folder named last comes first
    try:
        found = import_module(name)
    except ImportError:
        raise
    except (Exception, SystemExit) as error:
        where = place_of(error)
        text = f"{type(error).__name__}: {error}{where and f' ({where})'}"
        raise ImportError(text, name=name) from error
    if module.endswith(".py") and not Path(module).samefile(found.__file__ or ""):
        raise ImportError(f"{name!r} is the name of {found.__file__}; rename the file", name=name)
    return found


@dataclass(frozen=True)
class UserFolder:
    """Finds a module that the user names in a folder that is not on the search path.

    What it finds may import its neighbours; libraries, which try many names, may not.
    """

    folder: str  # the folder
    name: str  # the module
    found: set[str] = field(default_factory=set, compare=False)  # what it has found

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """As Python asks a finder, which it does after all others."""
        if path is not None or not (name == self.name or _importer() in self.found):
            return None
        spec = PathFinder.find_spec(name, [self.folder], target)
        if spec is not None:
            self.found.add(name)
        return spec


def _importer() -> str:
    """The top-level name of the module whose import statement is at work."""
    frame = inspect.currentframe()
    while frame is not None:
        name = str(frame.f_globals.get("__name__", ""))
        if name != __name__ and not name.startswith("importlib."):
            return name.partition(".")[0]
        frame = frame.f_back
    return ""


def user_folders() -> list[UserFolder]:
    """Where modules that the user named are found; other processes need them, too."""
    return [finder for finder in sys.meta_path if isinstance(finder, UserFolder)]


def take_search_path(path: list[str], folders: list[UserFolder]) -> None:
    """Find modules where another process finds them."""
    sys.path[:] = path
    sys.meta_path += [folder for folder in folders if folder not in sys.meta_path]


def _module_of(file: Path) -> tuple[str, Path]:
    """The name of the module in a file, and the folder that it is imported from."""
    if not file.is_file():
        raise ImportError(f"there is no file {str(file)!r}")
    folder, name = file.resolve().parent, file.stem
    while (folder / "__init__.py").is_file():
        folder, name = folder.parent, f"{folder.name}.{name}"
    return name, folder


def place_of(error: BaseException) -> str:
    """File and line of users' code that an error comes from; empty where there is none."""
    libraries = (str(PACKAGE), os.path.dirname(os.__file__), "<")
    frames = traceback.extract_tb(error.__traceback__)
    own = [
        f"{frame.filename}:{frame.lineno}"
        for frame in frames
        if not (frame.filename.startswith(libraries) or "site-packages" in frame.filename)
    ]
    return own[-1] if own else ""


def load_attribute(what: str, name: str, hint: str) -> Any:
    """What a user names as `module:attribute`; `what` it is and a hint go into the ConfigError."""
    module, _, attribute = name.rpartition(":")
    try:
        return getattr(import_named(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"{what} {name!r} cannot be imported: {error}", hint) from error


@cache
def read_module(name: str) -> tuple[bytes, list[str]]:
    """The text of a module of ours, and the modules of ours that its import statements name."""
    text = (PACKAGE / name).read_bytes()
    imported = []
    for module, block, line, plain in _IMPORT.findall("\n" + text.decode()):
        place = (module or plain).replace(".", "/")
        for at in (place, *(f"{place}/{word}" for word in re.findall(r"\w+", block + line))):
            imported += [f"{at}.py", f"{at}/__init__.py"]
    return text, [path for path in imported if path in module_names()]


@cache
def module_names() -> frozenset[str]:
    """Paths of all modules of ours, below `PACKAGE`."""
    found = set[str]()
    for folder, _, names in os.walk(PACKAGE, followlinks=True):
        place = os.path.relpath(folder, PACKAGE).replace(os.sep, "/").removeprefix(".")
        found |= {f"{place}/{name}".lstrip("/") for name in names if name.endswith(".py")}
    return frozenset(found)
