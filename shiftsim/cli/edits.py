"""`shiftsim edits`: look at edits of scenarios before they are run, and import interPlan's."""

from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from shiftsim import cli
from shiftsim.cli import Json, echo, new_app, print_result
from shiftsim.errors import ConfigError, ShiftsimError, beginning, one_of, plural
from shiftsim.files import write_text

app = new_app(
    "Edits of recorded scenarios: check them, look at them, import interPlan's.",
    no_args_is_help=True,
)

File = Annotated[str, Argument(metavar="FILE", help="A .toml file of edits.")]
Store = Annotated[str, Option("--store", "-s", help="Name or folder. [demo]")]


@app.command()
def check(
    file: File,
    store: Store = "demo",
    traffic: str = Option("", help="Also whether this traffic can drive it: nr or r."),
    avoidable: bool = Option(
        False, "--avoidable", help="Also whether braking or PDM-Closed avoids it."
    ),
    as_json: Json = False,
) -> None:
    """Apply every edit to its scenarios, and say which cannot be applied and why."""
    from shiftsim.runs.avoidable import is_avoidable
    from shiftsim.runs.edited import EditedStore
    from shiftsim.runs.scenarios import open_edits
    from shiftsim.sim.traffic import traffic_name

    opened = cli.open_store(store)
    edits = open_edits(file, opened)
    if traffic:
        edits.require_traffic(traffic_name(traffic))
    edited, refused = EditedStore(opened, edits), list[dict[str, str]]()
    for token in edited.tokens:
        try:
            scenario = edited.read(token)
            if avoidable and not is_avoidable(scenario):
                what = f"{token!r}: neither braking at 4 m/s^2 nor PDM-Closed avoids a collision"
                raise ConfigError(what)
        except ShiftsimError as error:
            refused.append({"token": token, "error": error.message, "hint": error.hint})
    count = len(edited.tokens)
    made = count - len(refused)
    lines = [
        *(f"refused: {row['error']}" + (row["hint"] and f" ({row['hint']})") for row in refused),
        f"{plural(made, 'edited scenario')}, {len(refused)} refused",
    ]
    print_result({"edited": made, "refused": refused}, lines, as_json=as_json)
    if refused:
        what = f"{len(refused)} of {plural(count, 'edited scenario')} cannot be made"
        raise ConfigError(what, hint="repair or remove the edits named above")


@app.command()
def show(
    file: File,
    token: str = Argument(metavar="TOKEN", help="An edited scenario, or its beginning."),
    store: Store = "demo",
    out: Path = Option(
        Path("edit.png"), "--out", "-o", help="A .pdf, .png or .svg: before and after."
    ),
) -> None:
    """What an edit makes of a scenario: words, and a picture of before and after."""
    from shiftsim.report.palette import save_picture
    from shiftsim.runs.edited import EditedStore
    from shiftsim.runs.scenarios import open_edits
    from shiftsim.view.still import before_and_after

    opened = cli.open_store(store)
    edited = EditedStore(opened, open_edits(file, opened))
    found = beginning(f"edits {file!r}", "edited scenario", token, edited.tokens)
    scenario = edited.read(found)
    words = scenario.script.words if scenario.script else ()
    echo("\n  ".join([f"{found}  {scenario.scenario_type}", *words]))
    out.parent.mkdir(parents=True, exist_ok=True)
    save_picture(before_and_after(opened.read(edited.base(found)), scenario), out)
    echo(f"written: {out}")


@app.command("import")
def import_edits(
    names: Path = Argument(metavar="NAMES", help="interPlan's filter: scenario_tokens in YAML."),
    modifications: Path = Argument(
        metavar="MODIFICATIONS", help="Its interPlan_modifications.yaml."
    ),
    out: Path = Option(Path("interplan.toml"), "--out", "-o", help="The .toml file to write."),
    window: float = Option(30.0, help="Duration of the scenarios [s]; 0 keeps the recorded one."),
) -> None:
    """Edits that make interPlan's scenarios, from interPlan's own two files."""
    from shiftsim.data.nuplan.filter import read_yaml
    from shiftsim.edits.interplan.codes import import_names
    from shiftsim.runs.edited import edits_text, make_edits

    table = import_names(read_yaml(names), read_yaml(modifications), window)
    edits = make_edits(table, out.stem).edits
    write_text(out, edits_text(table))
    tokens = {token for edit in edits for token in edit.tokens}
    echo(f"{plural(len(edits), 'edit')} of {plural(len(tokens), 'scenario')}")
    echo(f"written: {out}")


@app.command()
def sample(
    kind: str = Option(help="jaywalker, parked or works."),
    count: int = Option(100, min=1, help="How many edits."),
    seed: int = Option(0, min=0, help="Of all draws."),
    store: Store = "demo",
    split: str = Option("", help="Only scenarios of a split. [that of run]"),
    even: bool = Option(False, "--even", help="As many easy, medium and hard ones."),
    out: Path = Option(Path(), "--out", "-o", help="The .toml file. [KIND.toml]"),
) -> None:
    """Draw edits over a store: in the way, and avoided by braking at 4 m/s^2 or by PDM-Closed."""
    from shiftsim.edits.sampling import KINDS, sample_edits
    from shiftsim.runs.avoidable import grade
    from shiftsim.runs.edited import edits_text
    from shiftsim.runs.scenarios import default_split, usable_tokens

    one_of("kind", kind, KINDS)
    opened = cli.open_store(store)
    tokens = usable_tokens(opened, split or default_split(opened))
    read = lru_cache(maxsize=256)(opened.read)
    edits = list(sample_edits(kind, count, seed, tokens, read, grade, even=even))
    path = out if out.suffix else Path(f"{kind}.toml")
    write_text(path, edits_text({"format": 1, "edit": edits}))
    for name, number in sorted(Counter(edit["type"] for edit in edits).items()):
        echo(f"{name:20} {number}")
    echo(f"written: {path}")


def mine(
    run: Path = Argument(metavar="RUN", help="A run folder."),
    kind: str = Option("collision", help="collision, off-road, wrong-way, ttc or speeding."),
    before: str = Option("3s", help="How long before it the scenarios begin."),
    window: float | None = Option(None, help="Duration of the scenarios [s]. [5 s more]"),
    planner: str = Option("", "--planner", "-p", help="Only rollouts of this one."),
    out: Path = Option(Path("mined.toml"), "--out", "-o", help="The .toml file of edits."),
) -> None:
    """Make scenarios of what went wrong in a run, for `run --edits` and `bench edits --edits`."""
    from shiftsim.runs.edited import read_edits
    from shiftsim.runs.results import open_run
    from shiftsim.runs.rollouts import mining

    try:
        seconds = float(before.removesuffix("s"))
    except ValueError:
        raise ConfigError(f"--before {before!r} is no duration", "for example 3s") from None
    given = {} if window is None else {"window": window}
    path = mining.mine(open_run(run), kind, before=seconds, planner=planner, out=out, **given)
    edits = read_edits(str(path)).edits
    tokens = {token for edit in edits for token in edit.tokens}
    echo(
        f"{plural(len(edits), 'scenario')} of {len(tokens)} recorded, {edits[0].window_s:g} s each"
    )
    echo(f"written: {path}")
