"""Compiled kernels on disk, and where.

They are kept in `NUMBA_CACHE_DIR` where that is set, else in the checkout or beside the installed
package; where that cannot be written, in the folder of the user. All of them are read: what was
compiled when an image was built serves everybody. What is kept counts only as long as the file of
the kernel and all that it imports are the same. Trouble with it costs time, nothing else.
"""

import hashlib
import logging
import os
import pickle
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import compile_result
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from shiftsim.files import PACKAGE, kernel_folders, sources

_COMPILED = re.compile(rb"kernel|^[A-Z][A-Z0-9_, ]* = ", re.MULTILINE)  # constants are, too
# What is kept calls numba's run time, which is there at once, and only for hashes of texts a module
# that comes with all that numba can compile: a sixth of the time of a warm command.
_NEEDS_ALL = b"_numba_hashsecret"
_DIGEST = hashlib.sha256().digest_size
_UNKEPT = "compiled kernels cannot be kept and are compiled anew by every process"
_LOG = logging.getLogger(__name__)
_SAID = set[str]()
used = dict[Path, bool]()  # files that this process has read (False) or written (True)


class Kept:
    """What is kept of one kernel: a file for each signature, whole and with its hash, or ignored.

    numba's own files have no hash. They have an index, which a kill or a second process can make
    point to the code of another signature. They count as long as the time of the source file is the
    same, which no image keeps; and numba looks only at the file of the outermost kernel, while a
    kernel or constant of another file may have changed.
    """

    def __init__(self, function: Any) -> None:
        code = function.__code__
        source = Path(code.co_filename)
        self._folder = fingerprint(source)
        name = re.sub(r"\W", "_", function.__qualname__)
        self._name = f"{source.stem}.{name}-{code.co_firstlineno}.{sys.implementation.cache_tag}"
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        body = code.co_code + dumps(cells)  # type: ignore[no-untyped-call]
        if source.is_file() and not source.is_relative_to(PACKAGE):
            body += source.read_bytes()
        self._made_of = (numba.__version__, self._folder, hashlib.sha256(body).hexdigest())

    cache_path = property(lambda self: str(kernel_folders()[0] / self._folder))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel, None where it is to be compiled."""
        return self._load(sig, target_context, "nbc", _entry)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel, if possible."""
        data.library._ensure_finalized()
        self._save(sig, data, "nbc", data.library._get_compiled_object)

    def load_part(self, sig: Any, target_context: Any) -> Any:
        """The code for kernels that call this one, None where it is to be compiled."""
        return self._load(sig, target_context, "part", _part)

    def save_part(self, sig: Any, data: Any) -> None:
        """Keep code for kernels that call this one, if possible."""
        data.library._ensure_finalized()
        self._save(sig, data, "part", data.library._final_module.as_bitcode)

    def flush(self) -> None:
        """Nothing: files of kernels that are compiled anew are replaced."""

    def _load(self, sig: Any, target_context: Any, kind: str, rebuild: Any) -> Any:
        name, key = self._file(sig, target_context.codegen(), kind)
        for folder in kernel_folders():
            path = folder / name
            try:
                content = path.read_bytes()
                digest, content = content[:_DIGEST], content[_DIGEST:]
                if hashlib.sha256(content).digest() != digest:
                    raise ValueError(f"{path} is damaged")
                if _NEEDS_ALL in content:
                    target_context.refresh()
                else:
                    rtsys.initialize(target_context)
                found, *kept = pickle.loads(content)
                if found == key:
                    used.setdefault(path, False)
                    return rebuild(target_context, *kept)
            except (FileNotFoundError, NotADirectoryError):
                continue
            except Exception as error:  # unpickling may run into anything
                _say_once("kernels that were kept cannot be used and are compiled again", error)
        return None

    def _save(self, sig: Any, data: Any, kind: str, code: Any) -> None:
        if data.library.has_dynamic_globals:
            return
        name, key = self._file(sig, data.codegen, kind)
        described = data.fndesc
        described.typemap = described.calltypes = None  # needed no longer, and large
        content = dumps((key, described, data.environment, data.signature, code()))  # type: ignore[no-untyped-call]
        errors = []
        for folder in kernel_folders():
            try:
                _write(folder / name, hashlib.sha256(content).digest() + content)
            except OSError as error:
                errors.append(error)
            else:
                return
        _say_once(_UNKEPT, errors[0])

    def _file(self, sig: Any, codegen: Any, kind: str) -> tuple[Path, Any]:
        """Where the code for a signature and processor is, and what it must be made of."""
        key = (sig, codegen.magic_tuple())
        digest = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return Path(self._folder, f"{self._name}.{digest}.{kind}"), (self._made_of, kind, key)


def _write(path: Path, content: bytes) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}")  # others may write the same file
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    used[path] = True


def _entry(context: Any, described: Any, environment: Any, signature: Any, code: bytes) -> Any:
    """Machine code that Python calls."""
    library: Any = JITCodeLibrary(context.codegen(), described.qualname)  # type: ignore[no-untyped-call]
    library.enable_object_caching()
    library._set_compiled_object(code)
    library._finalize_final_module()
    library.codegen._engine._defined_symbols.add(described.llvm_cpython_wrapper_name)
    function = context.get_executable(library, described, environment)
    return _result(context, library, described, environment, signature, function)


def _part(context: Any, described: Any, environment: Any, signature: Any, code: bytes) -> Any:
    """Code that is linked into kernels."""
    library: Any = JITCodeLibrary(context.codegen(), described.qualname)  # type: ignore[no-untyped-call]
    library._final_module = llvm.parse_bitcode(code)
    library._finalized = True
    return _result(context, library, described, environment, signature, None)


def _result(
    context: Any, library: Any, described: Any, environment: Any, signature: Any, function: Any
) -> Any:
    return compile_result(  # type: ignore[no-untyped-call]
        typing_context=context.typing_context,
        target_context=context,
        entry_point=function,
        typing_error=None,
        library=library,
        signature=signature,
        objectmode=False,
        lifted=(),
        fndesc=described,
        environment=environment,
        reload_init=(),
    )


@cache
def fingerprint(path: Path) -> str:
    """Hash of all sources of ours that the kernels of a source file are made of."""
    digest = hashlib.sha256()
    is_ours = path.is_relative_to(PACKAGE)
    for name, source in sorted(sources([path] if is_ours else PACKAGE.rglob("*.py")).items()):
        if _COMPILED.search(source):
            digest.update(name.encode() + b"\n" + source)
    return digest.hexdigest()[:16]


def _say_once(what: str, error: Exception) -> None:
    if what not in _SAID:
        _SAID.add(what)
        _LOG.warning("%s: %s", what, error)
