"""How kernels are compiled: what Python calls becomes machine code, what kernels call a part of it.

numba compiles every function that a kernel calls as if Python called it too: unpacking of Python
objects, optimised code and machine code of its own, and then all of it again within the kernel. Of
a hundred kernels in a run Python calls twenty. The others are parts here: typed and lowered once,
optimised where they end up. That, less search for garbage and no passes for what kernels never hold
(closures, literals, generators) leave six tenths of the time. The numbers stay the same.
"""

import gc
from functools import cached_property
from typing import Any

from numba.core import event, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.core.typing.templates import make_concrete_template

from shiftsim.arrays.kept import Kept

# The entry point for C, which nobody calls, would take a tenth of the time to compile.
_OPTIONS: dict[str, Any] = {
    **{"nopython": True, "boundscheck": None},
    **{"error_model": "numpy", "no_cfunc_wrapper": True},
}
# passes of numba for what no kernel holds, or, joined arithmetic on whole arrays, none where time
# matters: each looks at the whole function, most of them at every variable of every statement
_UNUSED = {
    *("with_lifting", "inline_closure_likes", "make_function_op_code_to_jit_function"),
    *("inline_inlinables", "rewrite_dynamic_raises", "rewrite_semantic_constants"),
    *("find_literally", "literal_unroll", "literal_propagation", "dead_branch_prune"),
    *("nopython_supported_feature_validation", "annotate_types", "dump_parfor_diagnostics"),
    "nopython_rewrites",
}


def compiled(function: Any, *, counts_references: bool, **options: Any) -> Any:
    """A function that is compiled when it is first called, for each combination of types."""
    return _Kernel(function, _OPTIONS | {"_nrt": counts_references} | options)


class _Kernel(CPUDispatcher):
    """A compiled function; `overloads` are those that Python calls."""

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        super().__init__(function, {}, options, _Short)
        self._parts: dict[Any, Any] = {}  # by types of arguments
        self._cache = Kept(function)

    @cached_property
    def _make(self) -> Any:
        """What compiles parts; most kernels of a process are kept, or never called."""
        compiler: Any = type(vars(self)["_compiler"])
        return compiler(self.py_func, self.targetdescr, self.targetoptions, {}, _ShortPart)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """For a kernel that calls this one: what it may be called with, the part being there."""
        pysig, args = self._make.fold_argument_types(args, kws)
        # a number that is written where it is called is of the same type as all others
        args = tuple(types.unliteral(arg) for arg in args)  # type: ignore[no-untyped-call]
        if args not in self._parts:
            self._parts[args] = self._part(args)
        signatures = [part.signature for part in self._parts.values()]
        name = self.py_func.__name__
        template = make_concrete_template(name, key=name, signatures=signatures)  # type: ignore[no-untyped-call]
        return template, pysig, args, {}

    def get_overload(self, sig: Any) -> Any:
        """What stands for the part that a kernel calls."""
        return self._parts[normalize_signature(sig)[0]].entry_point  # type: ignore[no-untyped-call]

    def _part(self, args: Any) -> Any:
        with global_compiler_lock, self._compiling_counter:
            part = self._cache.load_part(args, self.targetctx)
            if part is None:
                details = {"dispatcher": self, "args": args, "return_type": None}
                with event.trigger_event("numba:compile", data=details):
                    part = self._make.compile(args, None)
                assert not part.environment.consts, f"{self.py_func} needs objects of Python"
                self._cache.save_part(args, part)
            part = part._replace(entry_point=object())  # a name for it
            context: Any = self.targetctx
            context.insert_user_function(part.entry_point, part.fndesc, [part.library])
            return part


class _Short(Compiler):
    """numba's compiler without the passes that find nothing in kernels."""

    def define_pipelines(self) -> Any:
        """Passes, in order."""
        managers = super().define_pipelines()  # type: ignore[no-untyped-call]
        for manager in managers:
            manager.passes = [item for item in manager.passes if item[0].name() not in _UNUSED]
            manager.finalize()
        return managers


class _ShortPart(_Short):
    """Compiles what kernels call, up to code that can be linked."""

    def define_pipelines(self) -> Any:
        """Passes, in order."""
        state = self.state
        # not options: what numba's own functions are compiled for would be another set of options
        state.flags.no_compile = state.flags.no_cpython_wrapper = True
        library: Any = _Part
        state.library = library(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()


class _Part(JITCodeLibrary):
    """Code of a kernel for kernels that call it: not run by itself, optimised within them."""

    _finalized: bool

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._verify_declare_only_symbols()  # type: ignore[no-untyped-call]
        self._finalized = True


class _NoCollection(event.Listener):
    """Compiling makes millions of objects: looking for garbage in them takes a sixth of it.

    So that is done once in several kernels; a kernel more leaves about 6 MB.
    """

    def __init__(self) -> None:
        self._depth, self._was_on, self._unseen = 0, False, 0

    def on_start(self, event: Any) -> None:
        """A kernel begins to be compiled, maybe within another one."""
        if self._depth == 0:
            self._was_on = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """It is done."""
        self._depth -= 1
        if self._depth == 0 and self._was_on:
            self._unseen += gc.get_count()[0]  # objects made, less those that are gone
            if self._unseen > _LOOKED_AT:
                gc.unfreeze()
                gc.collect()
                self._unseen = 0
            gc.freeze()  # what there is will not be looked at
            gc.enable()


_LOOKED_AT = 1_000_000  # new objects, about 150 MB
event.register("numba:compile", _NoCollection())  # type: ignore[no-untyped-call]
