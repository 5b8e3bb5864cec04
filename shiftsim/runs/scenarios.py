"""The scenarios of a run: the store they are in, and splits, which are named lists of their tokens.

A run knows its store by hash. A bundled run holds a store of its own with the scenarios it used and
their maps, so that the folder alone is enough to score, view and plot it anywhere.
"""

import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from shiftsim.data.store.reading import ScenarioStore, open_store
from shiftsim.data.store.tables import REVIEW
from shiftsim.errors import ConfigError, DataError, listed, one_of
from shiftsim.files import DEFAULT_STORE, read_toml, safe_join, store_path
from shiftsim.runs.config import RunConfig
from shiftsim.runs.results import Run, read_manifest, write_manifest

if TYPE_CHECKING:
    from shiftsim.runs.edited import EditSet

BUNDLE = "store"  # folder below that of the run
_REMEDY = "`shiftsim bundle RUN` makes the run self-contained"
_DEMO_SPLIT = "demo-mini"  # of the generated store, where no split is named


def open_run_store(run: Run, store: str | None = None) -> ScenarioStore:
    """The store of a run, or its bundle with that store's hash; `store` is where it has moved."""
    found = _recorded(run, store)
    if edits := run.manifest.get("edits"):
        from shiftsim.runs.edited import EditedStore, make_edits

        return EditedStore(found, make_edits(edits, run.path.name), edits.get("made"))
    return found


def _recorded(run: Run, store: str | None) -> ScenarioStore:
    """The recorded scenarios of a run."""
    place = store or run.manifest["store"]
    recorded = wanted = run.manifest["determining"]["store"]
    if store is None and is_bundled(run):
        found, wanted = open_store(run.path / BUNDLE), run.manifest["bundle"].get("hash")
    elif "://" in place:
        if store is None:  # which may be anybody's
            raise DataError(
                f"the store of run {run.path.name!r} is behind the URL {place!r}",
                hint=f"if you trust it: --store {place}; or, where it was made, {_REMEDY}",
            )
        found = open_store(place)
    elif not (path := store_path(place)).exists():
        what = f"the store of run {run.path.name!r} is not at {str(path)!r}"
        raise DataError(what, hint=f"say where it is with --store; or, where it is, {_REMEDY}")
    else:
        found = open_store(path)
    if found.hash != wanted:
        what = f"store {str(found.path)!r} is not the one run {run.path.name!r} was made with"
        raise DataError(what, hint="name the right one with --store, or run again")
    found.hash = recorded
    return found


def is_bundled(run: Run) -> bool:
    """Whether a run holds its scenarios itself."""
    return isinstance(run.manifest.get("bundle"), dict) and (run.path / BUNDLE).is_dir()


def bundle_run(run: Run, store: str | None = None) -> ScenarioStore:
    """Copy the scenarios of a run into its folder, unless they are there; the copy's store."""
    from shiftsim.data.store.writing import StoreWriter, window_row

    target, partial = (safe_join(run.path, name) for name in (BUNDLE, f".{BUNDLE}.tmp"))
    if is_bundled(run):
        return _recorded(run, None)
    found = _recorded(run, store)
    made = run.manifest.get("edits", {}).get("made", {})
    tokens = set(run.tasks["token"].to_pylist())
    wanted = {made[token]["base"] if token in made else token for token in tokens}
    columns = (found.summary()[name].to_pylist() for name in ("token", "recording", "city"))
    used = [row for row in zip(*columns, strict=True) if row[0] in wanted]
    for folder in (partial, target):  # left by a process that was killed
        shutil.rmtree(folder, ignore_errors=True)
    with StoreWriter(partial, found.generator or None) as writer:
        for city in sorted({city for _, _, city in used}):
            writer.add_map(found.map(city))
        for recording in sorted({recording for _, recording, _ in used}):
            rows = [
                window_row(found.window(token), city)
                for token, name, city in used
                if name == recording
            ]
            copied = partial / ".recording"
            shutil.copytree(found.recording_folder(recording), copied)
            writer.take_recording(copied, recording, rows)
    if (found.path / REVIEW).is_file():
        (partial / REVIEW).parent.mkdir()
        shutil.copyfile(found.path / REVIEW, partial / REVIEW)
    partial.rename(target)
    bundle = open_store(target)
    run.manifest["bundle"] = {"hash": bundle.hash}
    write_manifest(run.path, read_manifest(run.path) | {"bundle": run.manifest["bundle"]})
    return bundle


def open_edits(name: str, store: ScenarioStore) -> "EditSet":
    """Edits by a file, or a name in `edits/` of a store, splits resolved; or a ConfigError."""
    from shiftsim.runs.edited import read_edits

    path = Path(store.path)
    edits = read_edits(name, path)
    resolved = (
        replace(edit, split="", tokens=find_split(edit.split, path, store.tokens).tokens)
        if edit.split
        else edit
        for edit in edits.edits
    )
    return replace(edits, edits=tuple(resolved))


class Selection(NamedTuple):
    """The scenarios of a run, whatever its shard."""

    split: str  # name of the split
    present: list[str]  # tokens that the store holds
    missing: list[str]  # tokens that it does not hold
    size: int  # scenarios of the whole split, where the run is limited to the first ones
    left_out: list[str]  # what the store holds and the run leaves out, and why, in words
    fingerprint: dict[str, Any]  # what identifies them
    edits: "EditSet | None" = None  # what makes them of recorded ones
    edited: Mapping[str, Any] = {}  # which are made of which, for the manifest

    @property
    def tokens(self) -> tuple[str, ...]:
        """All tokens."""
        return (*self.present, *self.missing)


def select_scenarios(
    config: RunConfig, store: ScenarioStore, given: "EditSet | None" = None
) -> Selection:
    """The scenarios of a run; edits that are `given` take the place of those in the settings."""
    edits = given or (open_edits(config.edits, store) if config.edits else None)
    whole, fingerprint = len(store.tokens), {"store": store.hash}
    default = "" if config.split or config.all_scenarios else default_split(store, edits)
    split, filter_hash = open_split(store, config.split or default, whole=config.all_scenarios)
    name, tokens, held, edited = split.name, split.tokens, set(store.tokens), dict[str, Any]()
    left_out = []
    if default:
        count = f"{whole - len(tokens)} of {whole} scenarios, not in split {default}"
        left_out += [f"{count} (--split {store.path.name} takes all)"]
    elif split.name == store.path.name and len(tokens) < whole:
        dropped = whole - len(tokens)
        left_out += [f"{dropped} of {whole} scenarios, dropped by filter or review (--all)"]
    if filter_hash:
        fingerprint["filter"] = filter_hash
    if edits is not None:
        edits.require_traffic(config.traffic)
        edited = edits.describe(store, tokens)
        if lost := edits.named(store).keys() - edited:
            of = f"{len(lost)} of {len(edited) + len(lost)} edited scenarios"
            left_out += [f"{of}, not made of split {name}: {listed(sorted(lost))}"]
        name, tokens, held = f"{name}+{edits.name}", tuple(edited), set(edited)
        fingerprint["edits"] = edits.digest
    size, tokens = len(tokens), tokens[: config.limit or None]
    missing = sorted(set(tokens) - held)
    if not config.allow_partial:
        require_scenarios(split.name, tokens, config.store, held)
    if len(missing) == len(tokens):
        what = f"split {split.name!r}: store {config.store!r} holds none of its scenarios"
        raise DataError(what, hint="name the store that was converted for this split")
    fingerprint["tokens"] = token_hash(tokens)
    if store.is_reviewed and store.reviews.hash:
        fingerprint["review"] = store.reviews.hash
    present = [token for token in tokens if token in held]
    return Selection(name, present, missing, size, left_out, fingerprint, edits, edited)


def default_split(store: ScenarioStore, edits: "EditSet | None" = None) -> str:
    """The split where none is named: of the demo that of every page; empty for the whole store."""
    path = Path(store.path) / "splits" / f"{_DEMO_SPLIT}.toml"
    if store.generator.get("name") != DEFAULT_STORE or not path.is_file():
        return ""
    fits = edits is None or set(edits.named(store).values()) <= set(read_split(path).tokens)
    return _DEMO_SPLIT if fits else ""


def open_split(store: ScenarioStore, name: str, *, whole: bool = False) -> "tuple[Split, str]":
    """The split of a name, or all that filter and review accept; the filter's hash if it chose."""
    from shiftsim.runs.filter import read_filter_results

    usable, digest = tuple(store.tokens), ""
    if name in ("", store.path.name) and not whole:
        if (results := read_filter_results(store.path, store.hash)) is not None:
            digest, accepted = results.hash, set(results.accepted)
            if not accepted:
                raise DataError(
                    f"store {store.path.name!r}: the filter dropped all {len(usable)} scenarios",
                    hint="`shiftsim filter` says why; --all to use them nevertheless",
                )
            usable = tuple(token for token in usable if token in accepted)
        if store.is_reviewed:
            usable = store.reviews.usable(tuple(store.tokens), usable)
    return find_split(name, Path(store.path), usable), digest


def usable_tokens(
    store: ScenarioStore, split: str = "", *, all_scenarios: bool = False
) -> tuple[str, ...]:
    """The scenarios of a split, all of which the store must hold, or all that may be used."""
    found, _ = open_split(store, split, whole=all_scenarios)
    require_scenarios(found.name, found.tokens, store.path.name, store.tokens)
    return found.tokens


def require_scenarios(split: str, tokens: Sequence[str], store: str, held: Iterable[str]) -> None:
    """Refuse a split of which a store does not hold everything, with a DataError."""
    if missing := sorted(set(tokens).difference(held)):
        raise DataError(
            f"split {split!r} needs {len(tokens)} scenarios, store {store!r} "
            f"lacks {len(missing)} of them, such as {missing[0]!r}",
            hint="convert the missing scenarios, or name the store that was converted for this "
            "split; `run` and `bench` also take --allow-partial",
        )


@dataclass(frozen=True, slots=True)
class Split:
    """A named list of scenario tokens."""

    name: str  # as in tables and folder names
    tokens: tuple[str, ...]  # the tokens, each once, in the order listed

    @property
    def hash(self) -> str:
        """Digest of the set of tokens; their order does not matter."""
        return token_hash(self.tokens)


def token_hash(tokens: Iterable[str]) -> str:
    """Digest of a set of tokens."""
    return hashlib.blake2b("\n".join(sorted(tokens)).encode(), digest_size=16).hexdigest()


def find_split(name: str, store: Path, tokens: tuple[str, ...]) -> Split:
    """The split in a file, below `splits/` of the store, or of its own name: all its `tokens`."""
    if name in ("", store.name):
        return Split(store.name, tokens)
    path = Path(name)
    if path.suffix not in (".toml", ".txt"):
        folder = store / "splits"
        known = [str(file.relative_to(folder))[:-5] for file in folder.rglob("*.toml")]
        one_of("split", name, [store.name, *known], ", or a .toml or .txt file")
        path = folder / f"{name}.toml"
    return read_split(path)


def read_split(path: Path) -> Split:
    """A split from TOML with `tokens`, or text with one token per line; or a ConfigError."""
    table: dict[str, object] = {}
    if path.suffix == ".toml":
        table = read_toml(path)
        listed = table.get("tokens")
    else:
        try:
            listed = path.read_text("utf-8").split()
        except (OSError, UnicodeDecodeError) as error:
            what = f"cannot read split {str(path)!r}: {error}"
            raise ConfigError(what, hint="check the path") from error
    if not isinstance(listed, list) or not listed or not all(isinstance(t, str) for t in listed):
        raise ConfigError(f"split {str(path)!r} lists no tokens", hint='write tokens = ["…", "…"]')
    split = Split(str(table.get("name", path.stem)), tuple(listed))
    if len(set(listed)) < len(listed):
        twice = next(token for token in listed if listed.count(token) > 1)
        raise ConfigError(f"split {str(path)!r} lists {twice!r} twice", hint="remove one of them")
    actual = {"count": len(listed), "hash": split.hash}
    for name, value in actual.items():
        if table.get(name, value) != value:
            what = f"split {str(path)!r} says {name} = {table[name]!r}, but it is {value!r}"
            raise ConfigError(what, hint="the file was edited or cut off; fetch or write it again")
    return split


def split_name(store: ScenarioStore, tokens: Sequence[str], default: str) -> str:
    """The split of a store that has these scenarios, sorted; a default where none has."""
    if list(store.tokens) == list(tokens):
        return store.path.name
    files = sorted((Path(store.path) / "splits").glob("*.toml"))
    named = (path.stem for path in files if sorted(read_split(path).tokens) == list(tokens))
    return next(named, default)


def choose_scenarios(
    rows: Iterable[Mapping[str, str]],
    usable: Collection[str],
    *,
    wanted: Mapping[str, Collection[str]],
    per_type: int | None = None,
    limit: int | None = None,
) -> tuple[str, ...]:
    """Tokens of usable scenarios with the `wanted` values by column, sorted, up to the limits."""
    table = sorted(rows, key=itemgetter("token"))
    for column, values in wanted.items():
        known = sorted({row[column] for row in table})
        for value in values:
            one_of(column, value, known)
    counts: Counter[str] = Counter()
    chosen = []
    for row in table:
        fits = all(not values or row[column] in values for column, values in wanted.items())
        if not fits or row["token"] not in usable:
            continue
        counts[row["type"]] += 1
        if per_type is None or counts[row["type"]] <= per_type:
            chosen.append(row["token"])
    return tuple(chosen[:limit])


def write_split(path: Path, tokens: tuple[str, ...]) -> Split:
    """Write a split that `read_split` reads: TOML with count and hash, or text for `.txt`."""
    split = Split(path.stem, tokens)
    if not tokens:
        raise ConfigError(f"split {split.name!r} would be empty", hint="ask for less")
    if path.suffix == ".txt":
        lines = list(tokens)
    elif path.suffix == ".toml":
        head = f'name = {json.dumps(split.name)}\ncount = {len(tokens)}\nhash = "{split.hash}"'
        lines = [head, "tokens = [", *(f'    "{token}",' for token in tokens), "]"]
    else:
        raise ConfigError(f"split {str(path)!r} is no .toml or .txt file", hint="name it so")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write {str(path)!r}: {error}", hint="choose another") from error
    return split
