"""`shiftsim edits`: look at edits of scenarios before they are run, and import interPlan's."""

from pathlib import Path
from typing import Annotated

import typer

from shiftsim.cli import Json, new_app, plural, say, say_json

app = new_app("Edits of recorded scenarios: check them, look at them, import interPlan's.")

File = Annotated[str, typer.Argument(metavar="FILE", help="A .toml file of edits.")]
Store = Annotated[str, typer.Option("--store", "-s", help="Name or folder. [demo]")]


@app.command()
def check(
    file: File,
    store: Store = "demo",
    traffic: Annotated[
        str, typer.Option(help="Also whether this traffic can drive it: nr or r.")
    ] = "",
    avoidable: Annotated[
        bool,
        typer.Option("--avoidable", help="Also whether braking or PDM-Closed avoids it."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Apply every edit to its scenarios, and say which cannot be applied and why."""
    from shiftsim.errors import ConfigError, ShiftsimError
    from shiftsim.runs.avoidable import is_avoidable
    from shiftsim.runs.edited import EditedStore
    from shiftsim.runs.scenarios import open_edits, open_named_store
    from shiftsim.sim.traffic import traffic_name

    opened = open_named_store(store)
    edits = open_edits(file, opened)
    if traffic:
        edits.require_traffic(traffic_name(traffic))
    edited, refused = EditedStore(opened, edits), list[dict[str, str]]()
    for token in edited.tokens:
        try:
            scenario = edited.read(token)
            if avoidable and not is_avoidable(scenario):
                raise ConfigError(
                    f"{token!r}: neither braking at 4 m/s^2 nor PDM-Closed avoids a collision"
                )
        except ShiftsimError as error:
            refused.append({"token": token, "error": error.message, "hint": error.hint})
    count = len(edited.tokens)
    if as_json:
        say_json({"edited": count, "refused": refused})
    else:
        for row in refused:
            say(f"refused: {row['error']}" + (f" ({row['hint']})" if row["hint"] else ""))
        say(f"{plural(count, 'edited scenario')}, {len(refused)} refused")
    if refused:
        raise ConfigError(
            f"{len(refused)} of {plural(count, 'edited scenario')} cannot be made",
            hint="repair or remove the edits named above",
        )


@app.command()
def show(
    file: File,
    token: Annotated[
        str, typer.Argument(metavar="TOKEN", help="An edited scenario, or its beginning.")
    ],
    store: Store = "demo",
    out: Annotated[
        Path, typer.Option("--out", "-o", help="A .pdf, .png or .svg: before and after.")
    ] = Path("edit.png"),
) -> None:
    """What an edit makes of a scenario: words, and a picture of before and after."""
    from shiftsim.errors import beginning
    from shiftsim.report.palette import save_picture
    from shiftsim.runs.edited import EditedStore
    from shiftsim.runs.scenarios import open_edits, open_named_store
    from shiftsim.view.still import before_and_after

    opened = open_named_store(store)
    edited = EditedStore(opened, open_edits(file, opened))
    found = beginning(f"edits {file!r}", "edited scenario", token, edited.tokens)
    scenario = edited.read(found)
    script = scenario.script
    say(f"{found}  {scenario.scenario_type}")
    for line in script.words if script else ():
        say(f"  {line}")
    out.parent.mkdir(parents=True, exist_ok=True)
    save_picture(before_and_after(opened.read(edited.base(found)), scenario), out)
    say(f"written: {out}")


@app.command("import")
def import_edits(
    names: Annotated[
        Path, typer.Argument(metavar="NAMES", help="interPlan's filter: scenario_tokens in YAML.")
    ],
    modifications: Annotated[
        Path, typer.Argument(metavar="MODIFICATIONS", help="Its interPlan_modifications.yaml.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The .toml file to write.")] = Path(
        "interplan.toml"
    ),
    window: Annotated[
        float, typer.Option(help="Duration of the scenarios [s]; 0 keeps the recorded one.")
    ] = 30.0,
) -> None:
    """Edits that make interPlan's scenarios, from interPlan's own two files."""
    from shiftsim.data.nuplan.filter import read_yaml
    from shiftsim.edits.interplan.codes import import_names
    from shiftsim.files import write_text
    from shiftsim.runs.edited import edits_text, make_edits

    table = import_names(read_yaml(names), read_yaml(modifications), window)
    made = make_edits(table, out.stem)
    write_text(out, edits_text(table))
    tokens = {token for edit in made.edits for token in edit.tokens}
    say(f"{plural(len(made.edits), 'edit')} of {plural(len(tokens), 'scenario')}")
    say(f"written: {out}")


@app.command()
def sample(
    kind: Annotated[str, typer.Option(help="jaywalker, parked or works.")],
    count: Annotated[int, typer.Option(min=1, help="How many edits.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of all draws.")] = 0,
    store: Store = "demo",
    split: Annotated[str, typer.Option(help="Only scenarios of a split. [whole store]")] = "",
    even: Annotated[
        bool, typer.Option("--even", help="As many easy, medium and hard ones.")
    ] = False,
    out: Annotated[Path, typer.Option("--out", "-o", help="The .toml file. [KIND.toml]")] = Path(),
) -> None:
    """Draw edits over a store: in the way, and avoided by braking at 4 m/s^2 or by PDM-Closed."""
    from collections import Counter
    from functools import lru_cache

    from shiftsim.edits.sampling import KINDS, sample_edits
    from shiftsim.errors import one_of
    from shiftsim.files import write_text
    from shiftsim.runs.avoidable import grade
    from shiftsim.runs.edited import edits_text
    from shiftsim.runs.scenarios import find_split, open_named_store

    one_of("kind", kind, KINDS)
    opened = open_named_store(store)
    tokens = find_split(split, Path(opened.path), opened.tokens).tokens
    read = lru_cache(maxsize=256)(opened.read)
    edits = list(sample_edits(kind, count, seed, tokens, read, grade, even=even))
    path = out if out.suffix else Path(f"{kind}.toml")
    write_text(path, edits_text({"format": 1, "edit": edits}))
    for name, number in sorted(Counter(edit["type"] for edit in edits).items()):
        say(f"{name:20} {number}")
    say(f"written: {path}")
