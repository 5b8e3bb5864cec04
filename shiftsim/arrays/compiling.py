"""How kernels are compiled: each is a part, which becomes machine code behind what Python calls.

numba compiles every function that a kernel calls as if Python called it too: unpacking of Python
objects, optimised code and machine code of its own, and then all of it again within the kernel. Of
a hundred kernels in a run Python calls twenty. Here each is typed and lowered once, as a part, and
optimised where it ends up: behind a function that unpacks objects, with all the parts it calls.
That, less search for garbage and no passes for what kernels never hold (closures, literals,
generators) leave little more than half of the time. The numbers stay the same.
"""

import gc
from functools import cached_property
from typing import Any

from llvmlite.binding import create_new_function_pass_manager
from numba.core import event, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.runtime.nrt import rtsys
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

    overloads: Any
    _cache_hits: Any
    _cache_misses: Any

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        super().__init__(function, {}, options)
        self._parts: dict[Any, Any] = {}  # by types of arguments
        self._cache = Kept(function)

    @cached_property
    def _make(self) -> Any:
        """What compiles parts; most kernels of a process are kept, or never called."""
        compiler: Any = type(vars(self)["_compiler"])
        return compiler(self.py_func, self.targetdescr, self.targetoptions, {}, _Pipeline)

    def compile(self, sig: Any) -> Any:
        """For Python: machine code of the part, behind a function that unpacks objects."""
        args = normalize_signature(sig)[0]  # type: ignore[no-untyped-call]
        with global_compiler_lock, self._compiling_counter:
            if args in self.overloads:
                return self.overloads[args].entry_point
            found = self._cache.load_overload(sig, self.targetctx)
            (self._cache_misses if found is None else self._cache_hits)[sig] += 1
            if found is None:
                with _compile_event(self, args):
                    found = self._unpacking(args)
                self._cache.save_overload(sig, found)
            self.add_overload(found)
            return found.entry_point

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """For a kernel that calls this one: what it may be called with, the part being there."""
        pysig, args = self._make.fold_argument_types(args, kws)
        # a number that is written where it is called is of the same type as all others
        self._part(tuple(types.unliteral(arg) for arg in args))  # type: ignore[no-untyped-call]
        signatures = [part.signature for part in self._parts.values()]
        name = self.py_func.__name__
        template = make_concrete_template(name, key=name, signatures=signatures)  # type: ignore[no-untyped-call]
        return template, pysig, args, {}

    def get_overload(self, sig: Any) -> Any:
        """What stands for the part that a kernel calls."""
        return self._parts[normalize_signature(sig)[0]].entry_point  # type: ignore[no-untyped-call]

    def _part(self, args: Any) -> Any:
        if args in self._parts:
            return self._parts[args]
        with global_compiler_lock, self._compiling_counter:
            part = self._cache.load_part(args, self.targetctx)
            if part is None:
                with _compile_event(self, args):
                    part = self._make.compile(args, None)
                assert not part.environment.consts, f"{self.py_func} needs objects of Python"
                self._cache.save_part(args, part)
            part = part._replace(entry_point=object())  # a name for it
            context: Any = self.targetctx
            context.insert_user_function(part.entry_point, part.fndesc, [part.library])
            self._parts[args] = part
            return part

    def _unpacking(self, args: Any) -> Any:
        """The part behind a function that unpacks objects, as machine code."""
        part = self._part(args)
        target: Any = self.targetctx
        target.refresh()  # how objects are unpacked is not known yet where the part was kept
        context = target.subtarget(enable_nrt=self.targetoptions["_nrt"])
        library: Any = _Whole(context.codegen(), part.fndesc.qualname)  # type: ignore[no-untyped-call]
        library.enable_object_caching()
        for needed in (part.library, rtsys.library):
            library.add_linking_library(needed)
        context.create_cpython_wrapper(library, part.fndesc, part.environment, None)
        library.finalize()
        function = context.get_executable(library, part.fndesc, part.environment)
        return part._replace(library=library, entry_point=function, target_context=context)


def _compile_event(kernel: _Kernel, args: Any) -> Any:
    """Around compiling: what listeners of numba's events hear, `_NoCollection` among them."""
    details = {"dispatcher": kernel, "args": args, "return_type": None}
    return event.trigger_event("numba:compile", data=details)


class _Pipeline(Compiler):
    """numba's compiler up to code that can be linked, less what finds nothing in kernels."""

    def define_pipelines(self) -> Any:
        """Passes, in order."""
        state = self.state
        # not options: what numba's own functions are compiled for would be another set of options
        state.flags.no_compile = state.flags.no_cpython_wrapper = True
        library: Any = _Part
        state.library = library(state.targetctx.codegen(), state.func_id.func_qualname)
        managers = super().define_pipelines()  # type: ignore[no-untyped-call]
        for manager in managers:
            manager.passes = [item for item in manager.passes if item[0].name() not in _UNUSED]
            manager.finalize()
        return managers


class _Whole(JITCodeLibrary):
    """Code that is run, optimised once, with all that it calls."""

    codegen: Any
    _final_module: Any

    def _optimize_functions(self, ll_module: Any) -> None:
        """Variables into registers, which leaves a third of the code to be linked."""
        ll_module.data_layout = self.codegen._data_layout
        passes = create_new_function_pass_manager()
        passes.add_sroa_pass()
        passes.add_instruction_combine_pass()
        passes.add_simplify_cfg_pass()
        builder = self.codegen._pass_builder()
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def _optimize_final_module(self) -> None:
        passes, builder = self.codegen._module_pass_manager()
        passes.run(self._final_module, builder)


class _Part(_Whole):
    """Code of a kernel for what calls it: not run by itself, optimised where it ends up."""

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
