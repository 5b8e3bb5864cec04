"""How kernels become machine code: as little as possible, and kept on disk.

numba makes of every kernel a library that Python can call, also where only other kernels call it,
and optimises it there, and again in each of those. Here a kernel that another one calls is a part
of it: neither optimised nor made machine code of its own.

Compiled kernels are kept: in a checkout in `CACHE`, for an installed package where numba would keep
them, and in `NUMBA_CACHE_DIR` where that is set. What is kept counts only as long as the file of
the kernel and all that it imports are the same. Trouble with it costs time, nothing else.
"""

import gc
import hashlib
import logging
import os
import pickle
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numba
from llvmlite.binding import parse_bitcode
from numba.core import event, registry, sigutils
from numba.core.caching import FunctionCache, NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CR_FIELDS, Compiler, CompileResult, Flags, compile_extra
from numba.core.dispatcher import _FunctionCompiler  # type: ignore[attr-defined]
from numba.core.serialize import dumps
from numba.core.typing.templates import make_concrete_template

from shiftsim.files import PACKAGE, sources

CACHE = PACKAGE.parent / ".numba-cache"  # in a checkout
_USES_CACHE = "NUMBA_CACHE_DIR" not in os.environ and (CACHE.parent / "pyproject.toml").is_file()
_COMPILED = re.compile(rb"kernel|^[A-Z][A-Z0-9_, ]* = ", re.MULTILINE)  # constants are, too


_LOG = logging.getLogger(__name__)


class _Part(JITCodeLibrary):
    """Code that only the code of other kernels calls, with all that it calls."""

    def finalize(self) -> None:
        """Take in what it calls; whoever calls it optimises all of it."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True

    def serialize_using_object_code(self) -> Any:
        """What is kept of it: there is no object code."""
        self._ensure_finalized()
        return self.name, "part", self._get_module_for_linking().as_bitcode()

    @classmethod
    def rebuilt(cls, codegen: Any, state: Any) -> "_Part":
        """From what was kept."""
        name, _, bitcode = state
        part = cls(codegen, name)
        part._final_module = part._shared_module = parse_bitcode(bitcode)
        part._finalized = True
        return part


class _Compiler(_FunctionCompiler):
    """Compiles a kernel for Python, or as a part of other kernels."""

    is_part = False

    def _compile_core(self, args: Any, return_type: Any) -> Any:
        target = self.targetdescr.target_context
        flags: Any = Flags()
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        library = None
        if self.is_part:
            flags.no_compile = flags.no_cpython_wrapper = True
            library = _Part(target.codegen(), self.py_func.__qualname__)
        return compile_extra(
            self.targetdescr.typing_context,
            target,
            self.py_func,
            args=args,
            return_type=return_type,
            flags=flags,
            locals=self.locals,
            library=library,
            pipeline_class=self.pipeline_class,
        )


class Kernel(registry.CPUDispatcher):
    """A compiled function, which Python or other kernels call."""

    def __init__(self, py_func: Any, locals: Any = None, targetoptions: Any = None) -> None:
        super().__init__(py_func, locals, targetoptions)
        options = (py_func, self.targetdescr, self.targetoptions, self.locals, Compiler)
        self._compiler = _Compiler(*options)
        self._part_compiler = _Compiler(*options)
        self._part_compiler.is_part = True
        self._part_cache: Any = NullCache()
        self._parts: dict[Any, Any] = {}

    def keep(self) -> None:
        """Keep on disk what is compiled, and take what was kept.

        Raises:
            OSError, RuntimeError: There is no folder that can be written to.
        """
        self._cache, self._part_cache = _Kept(self.py_func), _KeptPart(self.py_func)

    @property
    def signatures(self) -> list[Any]:
        """The types of arguments that it has been compiled for."""
        return list(dict.fromkeys([*self.overloads, *self._parts]))

    def compile(self, sig: Any) -> Any:
        """Compile for Python."""
        with _without_collection():
            entry = super().compile(sig)
        made: Any = self.overloads[tuple(sigutils.normalize_signature(sig)[0])]
        if made.metadata is not None:  # not from disk
            for environment in made._find_referenced_environments():  # those of its parts, too
                made.library.codegen.set_env(environment.env_name, environment)
        return entry

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What another kernel that is being compiled calls; it is compiled for that."""
        pysig, args = self._compiler.fold_argument_types(args, kws)
        self._add_part(tuple(args))
        name = self.py_func.__name__
        signatures = [part.signature for part in self._parts.values()]
        template = make_concrete_template(f"CallTemplate({name})", key=name, signatures=signatures)
        return template, pysig, args, {}

    def get_overload(self, sig: Any) -> Any:
        """What stands for the code of a part."""
        args, _ = sigutils.normalize_signature(sig)
        return self._parts[tuple(args)].entry_point

    def _add_part(self, args: tuple[Any, ...]) -> None:
        if args in self._parts:
            return
        part = self._part_cache.load_overload(args, self.targetctx)
        if part is None:
            told = {"dispatcher": self, "args": args, "return_type": None}
            with self._compiling_counter, event.trigger_event("numba:compile", data=told):
                part = self._part_compiler.compile(args, None)
            part = part._replace(entry_point=object())
            self._part_cache.save_overload(args, part)
        self.targetctx.insert_user_function(part.entry_point, part.fndesc, [part.library])
        self._parts[args] = part


@contextmanager
def _without_collection() -> Iterator[None]:
    """Compiling makes millions of objects that stay: looking for garbage takes a sixth of it."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def cache_folder(file: str = "") -> str:
    """Where the compiled kernels of a source file are; without one, where all of them are."""
    if not _USES_CACHE:
        return str(vars(numba.config)["CACHE_DIR"])
    return str(CACHE / _fingerprint(Path(file))) if file else str(CACHE)


@cache
def _fingerprint(path: Path) -> str:
    """Hash of all that the kernels of a source file are made of."""
    digest = hashlib.sha256()
    is_ours = path.is_relative_to(PACKAGE)
    for name, source in sorted(sources([path] if is_ours else PACKAGE.rglob("*.py")).items()):
        if _COMPILED.search(source):
            digest.update(name.encode() + b"\n" + source)
    return digest.hexdigest()[:16]


class _Kept(FunctionCache):
    """What is kept of one kernel: a file for each signature, whole and with its hash, or ignored.

    numba's own files have no hash. They have an index, which a kill or a second process can make
    point to the code of another signature; and numba looks only at the file of the outermost
    kernel, while a kernel or constant of another file may have changed.
    """

    _ending = "nbc"

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        source = Path(function.__code__.co_filename)
        stamp = self._impl.locator.get_source_stamp()
        self._made_of = (numba.__version__, stamp, _fingerprint(source))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel, None where it is to be compiled."""
        target_context.refresh()
        path, key = self._file(sig, target_context.codegen())
        try:
            content = path.read_bytes()
            digest, content = content[:_DIGEST], content[_DIGEST:]
            if hashlib.sha256(content).digest() != digest:
                raise ValueError(f"{path} is damaged")
            found, compiled = pickle.loads(content)
            return self._rebuilt(target_context, compiled) if found == key else None
        except FileNotFoundError:
            pass
        except Exception as error:  # unpickling may run into anything
            _say_once("kernels that were kept cannot be used and are compiled again", error)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel, if possible."""
        if not self._impl.check_cachable(data):
            return
        path, key = self._file(sig, data.codegen)
        partial = path.with_name(f".{path.name}.{os.getpid()}")  # others may write the same file
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                content = dumps((key, self._impl.reduce(data)))
                partial.write_bytes(hashlib.sha256(content).digest() + content)
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        except OSError as error:
            _say_once(_UNKEPT, error)

    def _rebuilt(self, target_context: Any, compiled: Any) -> Any:
        return self._impl.rebuild(target_context, compiled)

    def _file(self, sig: Any, codegen: Any) -> tuple[Path, Any]:
        """Where the code for a signature and processor is, and what it must be made of."""
        key = self._index_key(sig, codegen)
        name = hashlib.sha256(repr(key[:2]).encode()).hexdigest()[:16]
        path = Path(self.cache_path) / f"{self._impl.filename_base}.{name}.{self._ending}"
        return path, (self._made_of, key)


class _KeptPart(_Kept):
    """What is kept of one kernel as a part of others."""

    _ending = "part"

    def _rebuilt(self, target_context: Any, compiled: Any) -> Any:
        library, descriptor, environment, signature, *_, reload_init, environments = compiled
        for function in reload_init:
            function()
        part = _Part.rebuilt(target_context.codegen(), library)
        values = dict.fromkeys(CR_FIELDS) | {
            "typing_context": target_context.typing_context,
            "target_context": target_context,
            "entry_point": object(),
            "signature": signature,
            "objectmode": False,
            "fndesc": descriptor,
            "library": part,
            "environment": environment,
            "reload_init": reload_init,
            "referenced_envs": environments,
        }
        return CompileResult(**values)


_DIGEST = hashlib.sha256().digest_size
_UNKEPT = "compiled kernels cannot be kept and are compiled anew by every process"
_SAID = set[str]()


def _say_once(what: str, error: Exception) -> None:
    if what not in _SAID:
        _SAID.add(what)
        _LOG.warning("%s: %s", what, error)


def compiled(function: Any, options: dict[str, Any]) -> Any:
    """A kernel with options of numba."""
    if vars(numba.config)["DISABLE_JIT"]:
        return function
    made = Kernel(function, targetoptions={"nopython": True, "boundscheck": None, **options})
    # a setting that numba makes at run time, and reads when it looks for a folder
    vars(numba.config)["CACHE_DIR"] = cache_folder(function.__code__.co_filename)
    try:
        made.keep()
    except (OSError, RuntimeError) as error:  # no folder can be written to
        _say_once(_UNKEPT, error)
    return made
