"""Small changes of source code, each of which some test should notice.

A change is made in the syntax tree of one top-level statement. Its name says where and what it is
without line numbers, so that it survives edits elsewhere in the file. Docstrings, messages, type
hints and decorators stay as they are.
"""

import ast
import hashlib
from collections import Counter
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field

COMPARED = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
COMPUTED = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
PAIRS = (("min", "max"), ("any", "all"), ("argmin", "argmax"), ("minimum", "maximum"))
SWAPPED = {a: b for one, two in (*PAIRS, ("cos", "sin")) for a, b in ((one, two), (two, one))}
KEPT = {"annotation", "returns", "decorator_list", "bases", "exc", "cause"}
DROPPED = {
    "abs",
    "reversed",
    "sum",
    "sqrt",
    "wrap_angle",
    "bool",
}  # calls reduced to their argument


@dataclass(frozen=True)
class Mutant:
    """One change of one statement."""

    module: str
    owner: str  # the top-level name that it belongs to
    change: str  # text before -> text after
    original: ast.stmt = field(compare=False, repr=False)  # the top-level statement
    number: int = field(compare=False, repr=False)  # which of its changes

    @property
    def name(self) -> str:
        """What identifies it."""
        return f"{self.module.removeprefix('shiftsim.')} {self.owner}: {self.change}"

    @property
    def version(self) -> str:
        """A digest of the statement as it is without the change."""
        return hashlib.md5(ast.unparse(self.original).encode()).hexdigest()

    @property
    def statement(self) -> ast.stmt:
        """A changed copy of the top-level statement."""
        for number, _ in enumerate(_changes(self.original)):
            if number == self.number:  # the original is changed until the next one is asked for
                copy = deepcopy(self.original)
        return ast.fix_missing_locations(copy)


def mutants_of(module: str, source: str) -> list[Mutant]:
    """All changes of a module, in the order of its text."""
    found, seen = [], Counter[str]()
    for statement in ast.parse(source).body:
        owner = ", ".join(names_of(statement))
        if not owner or owner == "__all__":
            continue
        for number, (before, after) in enumerate(_changes(statement)):
            change = f"`{before}` -> `{after}`"
            seen[owner, change] += 1
            if seen[owner, change] > 1:
                change += f" ({seen[owner, change]})"
            found.append(Mutant(module, owner, change, statement, number))
    return found


def sample(mutants: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """`count` of them by a hash of seed and name: an edit elsewhere hardly changes the choice."""
    return sorted(mutants, key=lambda m: hashlib.md5(f"{seed} {m.name}".encode()).digest())[:count]


def names_of(statement: ast.stmt) -> list[str]:
    """The names that a top-level statement defines."""
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return [statement.name]
    if isinstance(statement, ast.Assign | ast.AnnAssign):
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        nodes = [node for target in targets for node in ast.walk(target)]
        return [node.id for node in nodes if isinstance(node, ast.Name)]
    return []


def _changes(statement: ast.stmt) -> Iterator[tuple[str, str]]:
    """Text before and after every change; the statement is changed until the next is asked for."""
    for path in list(_places(statement, ())):
        parent, name, index = path[-1]
        node = _get(*path[-1])
        around, before = _context(path)
        for new in _replacements(node, parent, name):
            _put(parent, name, index, ast.copy_location(new, node))
            if before != (after := _text(_get(*around))):
                yield before, after
            _put(parent, name, index, node)


Place = tuple[ast.AST, str, int | None]  # a node, one of its fields, and the place in a list


def _context(path: tuple[Place, ...]) -> tuple[Place, str]:
    """The largest piece of text around the end of a path that still fits a line."""
    for place in path:
        node = _get(*place)
        is_long = hasattr(node, "body") and not isinstance(node, ast.IfExp)
        if isinstance(node, ast.expr | ast.stmt) and not is_long and len(_text(node)) <= 80:
            return place, _text(node)
    return path[-1], _text(_get(*path[-1]))


def _text(node: ast.AST) -> str:
    return " ".join(ast.unparse(node).split())


def _get(parent: ast.AST, name: str, index: int | None) -> ast.AST:
    value = getattr(parent, name)
    return value if index is None else value[index]


def _put(parent: ast.AST, name: str, index: int | None, node: ast.AST) -> None:
    if index is None:
        setattr(parent, name, node)
    else:
        getattr(parent, name)[index] = node


def _places(node: ast.AST, path: tuple[Place, ...]) -> Iterator[tuple[Place, ...]]:
    """The path to every node below this one that may be changed."""
    for name, value in ast.iter_fields(node):
        if name in KEPT or (name == "keywords" and not isinstance(node, ast.Call)):
            continue
        for index, child in enumerate(value) if isinstance(value, list) else ((None, value),):
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            below = (*path, (node, name, index))
            if isinstance(child, ast.expr | ast.stmt):
                yield below
            yield from _places(child, below)


def _replacements(node: ast.AST, parent: ast.AST, place: str) -> Iterator[ast.AST]:
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        for op in COMPARED[type(node.ops[0])]:
            yield ast.Compare(node.left, [op()], node.comparators)
    elif isinstance(node, ast.Compare):
        for index, op in enumerate(node.ops):
            ops = [*node.ops[:index], COMPARED[type(op)][0](), *node.ops[index + 1 :]]
            yield ast.Compare(node.left, ops, node.comparators)
    elif isinstance(node, ast.BinOp) and type(node.op) in COMPUTED:
        yield ast.BinOp(node.left, COMPUTED[type(node.op)](), node.right)
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    elif isinstance(node, ast.UnaryOp) and not isinstance(node.op, ast.UAdd):
        yield node.operand
    elif isinstance(node, ast.Constant):
        yield from (ast.Constant(value) for value in _numbers(node.value))
    elif isinstance(node, ast.Call):
        yield from _calls(node)
    elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Name):
        yield ast.Subscript(node.value, ast.BinOp(node.slice, ast.Sub(), ast.Constant(1)), node.ctx)
    elif isinstance(node, ast.stmt) and place in ("body", "orelse"):
        yield from _statements(node, parent)
    if isinstance(parent, ast.If | ast.While | ast.IfExp) and place == "test":
        if not isinstance(node, ast.Compare | ast.UnaryOp):
            yield ast.UnaryOp(ast.Not(), node)


def _numbers(value: object) -> Iterator[object]:
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield from (value + 1, value - 1)
    elif isinstance(value, float):
        yield from (1.0,) if value == 0.0 else (1.5 * value, 0.0)


def _calls(node: ast.Call) -> Iterator[ast.AST]:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    if name in SWAPPED:
        func = deepcopy(node.func)
        setattr(func, "attr" if isinstance(func, ast.Attribute) else "id", SWAPPED[name])
        yield ast.Call(func, node.args, node.keywords)
    if name in DROPPED and node.args:
        yield node.args[0]
    if name == "range":
        last = min(len(node.args) - 1, 1)
        for op in (ast.Add, ast.Sub):
            args = list(node.args)
            args[last] = ast.BinOp(args[last], op(), ast.Constant(1))
            yield ast.Call(node.func, args, [])


def _statements(node: ast.stmt, parent: ast.AST) -> Iterator[ast.AST]:
    """Removals that leave no undefined name, and returned values in another order."""
    is_call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    if isinstance(node, ast.Continue | ast.Break | ast.AugAssign) or is_call:
        yield ast.Pass()
    elif isinstance(node, ast.Assign):
        if all(isinstance(target, ast.Subscript | ast.Attribute) for target in node.targets):
            yield ast.Pass()
        elif isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple):
            yield ast.Assign(node.targets, ast.Tuple(node.value.elts[::-1], ast.Load()))
    elif isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple):
        yield ast.Return(ast.Tuple(node.value.elts[::-1], ast.Load()))
    elif isinstance(node, ast.Return | ast.Raise) and isinstance(parent, ast.If):
        yield ast.Pass()
