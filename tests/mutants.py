"""Whether the tests notice small changes of metrics, simulation, PDM, IDM and data readers.

    python tests/mutants.py --count 400 --seed 1 --workers 2

A process runs the tests once, so that everything is imported and compiled, and forks for every
mutant. The child changes the loaded modules in place: the changed statement is executed again, and
kernels that depend on it run as plain Python, so nothing is compiled. Then it runs the tests of the
module until one fails. A mutant that no test notices has survived; `mutants_equal.md` lists those
that cannot be noticed.
"""

import argparse
import ast
import contextlib
import json
import os
import resource
import signal
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import Phase, settings
from mutated import GROUPS, LEFT_OUT, ROOT, TESTS, modules, shared_sample, tests_of
from mutations import Mutant, names_of

CPU_SECONDS = 60  # of a child; one that takes longer hangs
DESCRIPTORS = (property, cached_property, staticmethod, classmethod)
PLAIN = (bool, int, float, str, tuple, dict)
MEMORY = 8 << 30  # bytes that a child may have mapped

Name = tuple[str, str]  # a module and a top-level name of it


class Definitions:
    """Which top-level name of the loaded modules is made of which others."""

    def __init__(self) -> None:
        self.statements: dict[Name, ast.stmt] = {}
        self.later: dict[Name, list[ast.stmt]] = defaultdict(list)  # what changes a value again
        self.origins: dict[Name, Name] = {}  # of imported names
        self.users: dict[Name, list[Name]] = defaultdict(list)
        for module, tree in _loaded():
            own = {name for statement in tree.body for name in names_of(statement)}
            imported = dict(_imports(tree))
            for name, origin in imported.items():
                self.origins[module, name] = origin
                self.users[origin].append((module, name))
            for statement in tree.body:
                used = {n.id for n in ast.walk(statement) if isinstance(n, ast.Name)}
                if isinstance(statement, ast.AugAssign) and isinstance(statement.target, ast.Name):
                    self.later[module, statement.target.id].append(statement)
                for name in names_of(statement):
                    is_value = isinstance(statement, ast.Assign | ast.AnnAssign)
                    if is_value and (module, name) in self.statements:
                        self.later[module, name].append(statement)
                    else:
                        self.statements[module, name] = statement
                    self.users[module, ""].append((module, name))  # of the module as a whole
                    for other in used & (own | imported.keys()):
                        self.users[module, other].append((module, name))
        for module, name in list(self.statements):
            self.users[module, name].append((module, ""))

    def after(self, start: Iterable[Name]) -> list[Name]:
        """All that is made of the given names, each after what it is made of."""
        order: list[Name] = []
        seen = set[Name]()

        def visit(name: Name) -> None:
            seen.add(name)
            for user in self.users.get(name, ()):
                if user not in seen and user != (name[0], ""):
                    visit(user)
            order.append(name)

        for name in start:
            visit(name)
        return order[::-1]


def _loaded() -> Iterator[tuple[str, ast.Module]]:
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file and Path(file).resolve().is_relative_to(ROOT) and ".venv" not in file:
            if name not in ("mutants", "mutated", "mutations", "__main__", "__mp_main__"):
                yield name, ast.parse(Path(file).read_text())


def _imports(tree: ast.Module) -> Iterator[tuple[str, Name]]:
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module in sys.modules:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                origin = (inner, "") if inner in sys.modules else (node.module, alias.name)
                yield alias.asname or alias.name, origin


def _execute(module: ModuleType, statement: ast.stmt) -> None:
    """Execute a definition again in its module; a kernel becomes a plain function."""
    if isinstance(statement, ast.FunctionDef):
        kept = [d for d in statement.decorator_list if "kernel" not in ast.unparse(d)]
        if len(kept) < len(statement.decorator_list):
            statement.decorator_list = kept
    tree = ast.fix_missing_locations(ast.Module([statement], []))
    exec(compile(tree, str(module.__file__), "exec"), vars(module))
    if isinstance(statement, ast.FunctionDef):
        function = vars(module)[statement.name]
        function.py_func = function


def _change_class(module: ModuleType, statement: ast.ClassDef) -> None:
    """Give an existing class, of which instances exist, the functions and defaults of the new."""
    old = vars(module)[statement.name]
    _execute(module, statement)
    new = vars(module)[statement.name]
    setattr(module, statement.name, old)
    for name, value in vars(new).items():
        is_code = callable(value) or isinstance(value, DESCRIPTORS)
        is_value = isinstance(value, PLAIN) and name[:2] != "__" and name[-1] != "_"
        if (is_code or is_value) and name not in ("__setattr__", "__delattr__"):
            with contextlib.suppress(TypeError, AttributeError):
                setattr(old, name, value)


def apply(mutant: Mutant | None, definitions: Definitions, start: list[Name]) -> None:
    """Change the loaded modules: the mutant, and all that is made of it."""
    for name in definitions.after(start):
        module, local = sys.modules[name[0]], name[1]
        statement = definitions.statements.get(name)
        if name in definitions.origins:
            origin, inner = definitions.origins[name]
            value = vars(sys.modules[origin])[inner] if inner else sys.modules[origin]
            setattr(module, local, value)
            continue
        changed = mutant is not None and name in start
        if mutant is not None and changed:
            statement = mutant.statement
        old = vars(module).get(local)
        if isinstance(statement, ast.ClassDef):
            if changed or _has_defaults(statement):
                _change_class(module, statement)
        elif isinstance(statement, ast.FunctionDef):
            if changed:
                _execute(module, statement)
            elif hasattr(old, "py_func"):
                old.py_func.py_func = old.py_func
                setattr(module, local, old.py_func)
            elif hasattr(old, "cache_clear"):
                old.cache_clear()
        elif statement is not None and (changed or module.__name__.startswith("shiftsim")):
            _execute(module, statement)
            for later in definitions.later[name]:
                if mutant is None or ast.dump(later) != ast.dump(mutant.original):
                    _execute(module, later)


def _has_defaults(statement: ast.ClassDef) -> bool:
    return any(isinstance(node, ast.AnnAssign) and node.value for node in statement.body)


class FirstFailure:
    """A pytest plugin that keeps the name of the test that fails."""

    name = ""

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Called by pytest."""
        if report.failed and not self.name:
            self.name = report.nodeid


def run_tests(tests: list[str], quiet: bool = True) -> str:
    """The first test that fails, or nothing."""
    failure = FirstFailure()
    options = [
        "-x",
        "-q",
        "--tb=no",
        "--disable-warnings",
        "-W",
        "ignore::pytest.PytestAssertRewriteWarning",  # of a process that has run tests before
        "-p",
        "no:cacheprovider",
        "-m",
        "not slow and not thorough and not long",
        *(f"--deselect=tests/{name}" for name in LEFT_OUT),
    ]
    code = pytest.main([*options, *tests], plugins=[failure])
    if code not in (0, 1):
        return f"pytest ended with {int(code)}"
    return failure.name


def _child(mutant: Mutant | None, start: list[Name], definitions: Definitions, pipe: int) -> None:
    """Change, test, and write which test failed; never returns."""
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    failed = ""
    try:
        apply(mutant, definitions, start)
        failed = run_tests(tests_of(start[0][0]))
    except BaseException as error:
        failed = f"when it is made: {type(error).__name__}: {error}"
    os.write(pipe, failed.encode()[:2000])
    os._exit(0)


class Runner:
    """Runs mutants in forked processes, a few at a time."""

    def __init__(self, workers: int, modules: list[str]) -> None:
        self.workers, self.modules = workers, modules
        self.running: dict[int, tuple[str, int]] = {}
        # looking for the smallest example that fails would take minutes without compiled kernels
        phases = (Phase.explicit, Phase.generate)
        settings.register_profile(
            "mutants", max_examples=25, deadline=None, derandomize=True, phases=phases
        )
        os.environ["HYPOTHESIS_PROFILE"] = "mutants"
        files = [test for module in modules for test in tests_of(module)]
        if files and (failed := run_tests(list(dict.fromkeys(files)))):
            raise SystemExit(f"fails without any change: {failed}")
        self.definitions = Definitions()

    def run(self, mutants: Iterable[Mutant]) -> Iterator[dict[str, Any]]:
        """How each of them ended, in the order in which they end."""
        for mutant in mutants:
            start = [(mutant.module, name) for name in mutant.owner.split(", ")]
            self._start(mutant.name, mutant, start)
            while len(self.running) >= self.workers:
                yield self._next()
        while self.running:
            yield self._next()

    def check(self) -> None:
        """All kernels as plain Python, and nothing else, fail no test and leave time to spare."""
        for module in self.modules:
            names = [name for name in self.definitions.statements if name[0] == module]
            if names and tests_of(module):
                self._start(module, None, names)
                row = self._next()
                print(f"{row['seconds']:6.1f} s {module}", flush=True)
                if row["result"] != "survived" or row["seconds"] > CPU_SECONDS / 2:
                    raise SystemExit(f"{module} fails as plain Python: {row['by'] or 'too slow'}")

    def _start(self, name: str, mutant: Mutant | None, start: list[Name]) -> None:
        reading, writing = os.pipe()
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            os.close(reading)
            _child(mutant, start, self.definitions, writing)
        os.close(writing)
        self.running[child] = (name, reading)

    def _next(self) -> dict[str, Any]:
        child, status, used = os.wait4(-1, 0)
        name, reading = self.running.pop(child)
        with os.fdopen(reading, "rb") as pipe:
            by = pipe.read().decode(errors="replace")
        if status != 0:
            by = f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"exit {status}"
        seconds = round(used.ru_utime + used.ru_stime, 2)
        result = "killed" if by else "survived"
        return {"mutant": name, "result": result, "by": by, "seconds": seconds}


def equal_mutants() -> set[str]:
    """Names of the mutants that `mutants_equal.md` lists."""
    lines = (TESTS / "mutants_equal.md").read_text().splitlines()
    return {line[2:] for line in lines if line.startswith("- ")}


def main() -> None:
    """Run a sample and print what survived; what was killed is not run again, survivors are."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--count", type=int, default=400, help="number of mutants, of all groups")
    parser.add_argument("--seed", type=int, default=1, help="which of them")
    parser.add_argument("--workers", type=int, default=2, help="processes at a time")
    parser.add_argument("--only", default="", help="a group, or part of the names")
    parser.add_argument("--kept", type=Path, help="JSON lines of results, read and added to")
    parser.add_argument("--seconds", type=float, default=1e9, help="start none after that time")
    parser.add_argument("--check", action="store_true", help="try the tests as plain Python first")
    options = parser.parse_args()
    began = time.monotonic()
    group_of, chosen = modules(), shared_sample(options.count, options.seed)
    if only := options.only:
        is_group = only in GROUPS
        chosen = [m for m in chosen if only in (group_of[m.module] if is_group else m.name)]
    rows: dict[str, dict[str, Any]] = {}
    if options.kept and options.kept.is_file():
        for line in options.kept.read_text().splitlines():
            row = json.loads(line)
            rows[row["mutant"]] = row

    def is_done(mutant: Mutant) -> bool:
        row = rows.get(mutant.name, {})
        return row.get("result") == "killed" and row.get("version") == mutant.version

    # what was never run comes before what survived
    waiting = sorted((m for m in chosen if not is_done(m)), key=lambda m: m.name in rows)
    runner = Runner(options.workers, sorted({mutant.module for mutant in waiting}))
    if options.check:
        runner.check()
    in_time = takewhile(lambda _: time.monotonic() - began < options.seconds, waiting)
    versions = {mutant.name: mutant.version for mutant in chosen}
    for row in runner.run(in_time):
        row["version"] = versions[row["mutant"]]
        rows[row["mutant"]] = row
        if options.kept:
            with options.kept.open("a") as file:
                file.write(json.dumps(row) + "\n")
    raise SystemExit(report(rows, chosen))


def report(rows: dict[str, dict[str, Any]], chosen: list[Mutant]) -> int:
    """Print the rate and the survivors; 1 if one of them is not listed as equal."""
    group_of, known = modules(), equal_mutants()
    ended: dict[str, Counter[str]] = {group: Counter() for group in ["all", *GROUPS]}
    unknown = 0
    for mutant in sorted(chosen, key=lambda m: m.name):
        if row := rows.get(mutant.name):
            result = row["result"]
            if result == "survived":
                result = "equal" if mutant.name in known else "SURVIVED"
                unknown += result == "SURVIVED"
                print(f"{result:8} {mutant.name}")
            for group in ("all", group_of[mutant.module]):
                ended[group][result] += 1
    for group, counts in reversed(ended.items()):
        killed, total = counts["killed"], max(counts.total(), 1)
        print(
            f"{group}: {killed} of {counts.total()} killed ({killed / total:.1%}), "
            f"{counts['equal']} survivors equal, {counts['SURVIVED']} not"
        )
    return int(unknown > 0)


if __name__ == "__main__":
    main()
