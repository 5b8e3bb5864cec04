"""Array types, read-only arrays, and the decorator that compiles kernels: numba as it is shipped.

numba's disk cache looks only at the file of the outermost kernel. The cache folder is therefore
named by a hash of all kernel sources and of the versions of numba and NumPy: an edit of any of them
starts a fresh cache. Machine code is a program: what another user may have written is not read.
"""

import hashlib
import logging
import os
import shutil
import stat
import sys
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

from shiftsim.files import PACKAGE, module_names, read_module, user_cache

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]

_CACHES_KEPT = 3  # versions of the kernels whose machine code stays on disk
KEEPS_READ_ONLY = np.lib.NumpyVersion(np.__version__) >= "2.1.0"  # what NumPy's DLPack can pass on


def kernel_hash() -> str:
    """Hash of the modules with kernels, of those they import constants from, and of versions."""
    modules = {name: read_module(name) for name in module_names()}
    kernels = {name for name, (text, _) in modules.items() if b"\n@kernel\n" in text}
    compiled = kernels.union(*(modules[name][1] for name in kernels))
    digest = hashlib.sha256(f"{numba.__version__} {np.__version__}".encode())
    for name in sorted(compiled):
        digest.update(name.encode() + modules[name][0])
    return digest.hexdigest()[:16]


def _is_usable(folder: Path, mode: int = 0o700) -> bool:
    """Whether machine code can be kept in a folder, which is made if needed."""
    try:
        folder.mkdir(mode, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return _is_trusted(folder)


@cache
def _is_trusted(folder: Path) -> bool:
    """Whether nobody but this user and root can have written what is in a folder; else said."""
    if sys.platform == "win32":
        return True
    # who may write in a folder above can exchange this one, unless that is sticky, as /tmp is
    anybody = stat.S_IWOTH
    modes = {parent: parent.stat().st_mode for parent in folder.resolve().parents}
    unsafe = [path for path in modes if modes[path] & (anybody | stat.S_ISVTX) == anybody]
    # others do not reach what is in a private folder: there the group is what a umask left
    forbidden = 0o022 if folder.stat().st_mode & 0o077 else 0o002
    for path in (folder, *folder.rglob("*")):
        with suppress(OSError):  # another process may be writing it
            info = path.stat()
            if info.st_uid not in (0, os.getuid()) or info.st_mode & forbidden:
                unsafe.append(path)
    if unsafe:
        text = "%s may be written by other users: compiled kernels in %s are not read; %s"
        remedy = "remove that folder, or give NUMBA_CACHE_DIR one of your own"
        logging.getLogger(__name__).warning(text, unsafe[0], folder, remedy)
    return not unsafe


def _cache_folder() -> str:
    """Folder of the machine code; empty where none can be written.

    It is in the checkout or beside the installed package, else in the cache folder of the user,
    who is given a copy of what was compiled when an image was built.
    """
    is_checkout = (PACKAGE.parent / "pyproject.toml").is_file()
    base = PACKAGE.parent / ".numba-cache" if is_checkout else PACKAGE / "__pycache__" / "kernels"
    shipped, own = (folder / kernel_hash() for folder in (base, user_cache("kernels")))
    mode = 0o700 if sys.platform == "win32" or os.getuid() else 0o755  # root's is that of an image
    folder = shipped if _is_usable(shipped, mode) else own
    if not _is_usable(folder):
        logging.getLogger(__name__).warning(
            "%s cannot be used: kernels are compiled anew by every process", folder
        )
        return ""
    if folder is own and shipped.is_dir() and _is_trusted(shipped):
        for path in shipped.rglob("*.nb?"):  # without its permissions
            copy = own / path.relative_to(shipped)
            copy.parent.mkdir(exist_ok=True)
            if not copy.exists():
                partial = copy.with_name(f".{copy.name}.{os.getpid()}")  # others may copy it, too
                shutil.copyfile(path, partial)
                partial.replace(copy)
    with suppress(OSError):  # another process may remove them at the same time
        caches = sorted(folder.parent.iterdir(), key=lambda cache: cache.stat().st_mtime)
        for old in caches[:-_CACHES_KEPT]:
            if old != folder:
                shutil.rmtree(old, ignore_errors=True)
    return str(folder)


config: Any = numba.config
if not config.CACHE_DIR:  # NUMBA_CACHE_DIR
    config.CACHE_DIR = _cache_folder()
elif not _is_usable(Path(config.CACHE_DIR)):
    # processes that this one starts take the same one, and need not say it again
    os.environ["NUMBA_CACHE_DIR"] = config.CACHE_DIR = _cache_folder()

CACHE_FOLDER: str = config.CACHE_DIR
# no fastmath, no parallel loops: results must not depend on the processor or the number of threads;
# division by zero gives inf or NaN, as in NumPy
kernel: Any = numba.njit(cache=bool(CACHE_FOLDER), error_model="numpy")


def machine_code() -> list[Path]:
    """Files of the kernels that are compiled, one for each combination of types."""
    return [*Path(CACHE_FOLDER).rglob("*.nbc")] if CACHE_FOLDER else []


def readonly(array: Any) -> Any:
    """The same memory, never writeable again; its `base` is no array.

    NumPy before 2.1 is given a copy of what could be written.
    """
    if array.flags.writeable:
        array = array.view() if KEEPS_READ_ONLY else array.copy()
        array.flags.writeable = False
    elif array.base is not None and not isinstance(array.base, np.ndarray):
        return array  # it is one
    return np.from_dlpack(array) if KEEPS_READ_ONLY else np.asarray(memoryview(array))
