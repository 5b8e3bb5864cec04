"""The replay page: template, script and packed data in one HTML text."""

import html
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from shiftsim.files import write_text
from shiftsim.sim.log import SimulationLog
from shiftsim.view.pack import pack
from shiftsim.view.scene import Replay, ShownRollout, describe_scene, rollout_fields, scene_fields
from shiftsim.world.scenario import Scenario, require_scenario

_HERE = Path(__file__).parent
MAX_ROLLOUTS = 6
POLICY = (
    '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; script-src '
    "'unsafe-inline'; style-src 'unsafe-inline'; img-src {images}\">"
)


class Page(str):
    """The text of a page; notebooks show it as a frame."""

    __slots__ = ()

    def __repr__(self) -> str:
        return f"<Page: {len(self) / 1000:.0f} kB of HTML; .save(path) writes it>"

    def save(self, path: str | Path) -> Path:
        """Write the page to a file."""
        file = Path(path)
        write_text(file, self)
        return file

    def _repr_html_(self) -> str:
        return embedded(self)


def show(scenario: Scenario, **logs: SimulationLog) -> Page:
    """A replay of rollouts of one scenario, as `shiftsim.show(scenario, mine=log)`.

    Args:
        scenario: The scenario that was driven.
        logs: One to six rollouts by name; underscores stand for hyphens.

    Raises:
        ConfigError: There is no scenario.
        ValueError: There are no rollouts, or more than six.

    Example:
        ```python
        scenario = shiftsim.open_store("demo")["01f13e"]
        logs = {name: shiftsim.simulate(scenario, name) for name in ("idm", "log-future")}
        shiftsim.show(scenario, **logs).save("replay.html")
        ```
    """
    require_scenario("show", scenario)
    shown = [
        ShownRollout(name.replace("_", "-"), "some" if log.noise.any() else "none", 0, log)
        for name, log in logs.items()
    ]
    return replay_page(scenario, shown)


def replay_page(
    scenario: Scenario,
    shown: Sequence[ShownRollout],
    *,
    back: str = "",
    more: Mapping[str, Any] | None = None,
) -> Page:
    """One self-contained HTML page of one to six rollouts; `back` is the address of the list.

    `more` are `shown`, what is shown of how much, and `parts`, words and names of all pages of the
    scenario, of which `part` is this one.

    Raises:
        ValueError: There are no rollouts, or more than six.
    """
    if not 1 <= len(shown) <= MAX_ROLLOUTS:
        raise ValueError(f"a replay shows 1 to {MAX_ROLLOUTS} rollouts, not {len(shown)}")
    replay = Replay(scenario, shown)
    data = [
        data_element("meta", describe_scene(replay) | {"back": back, **(more or {})}),
        _data("scene", "text/plain", pack(scene_fields(replay))),
    ]
    for index in range(len(shown)):
        data.append(_data(f"rollout{index}", "text/plain", pack(rollout_fields(replay, index))))
    text = framed(
        "replay.html",
        title=f"{scenario.token} · shiftsim",
        meta=POLICY.format(images="data:"),
        styles=["replay.css"],
        scripts=["codec.js", "world.js", "strips.js", "replay.js"],
        data="\n".join(data),
    )
    return Page(text)


def framed(
    body: str, *, title: str, meta: str, styles: Sequence[str], scripts: Sequence[str], **parts: str
) -> str:
    """A whole page from files of this folder, with one head for all pages.

    `body` is the file with what stands between head and scripts; `title` and `parts` are filled in.
    """
    return fill(
        asset("frame.html"),
        title=html.escape(title),
        meta=meta,
        style="".join(map(asset, styles)),
        body=fill(asset(body), title=html.escape(title), **parts),
        script="\n".join(map(asset, scripts)),
    )


@cache
def asset(name: str) -> str:
    """A file of this folder."""
    return (_HERE / name).read_text(encoding="utf-8")


def fill(template: str, **parts: str) -> str:
    """The template with every `{{name}}` replaced, in one pass: parts are never scanned again."""
    pieces = template.split("{{")
    out = [pieces[0]]
    for piece in pieces[1:]:
        name, _, rest = piece.partition("}}")
        out += [parts[name], rest]
    return "".join(out)


def json_text(value: Any) -> str:
    """JSON that can stand inside a script element whatever its strings hold."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def data_element(name: str, value: Any) -> str:
    """A value as JSON in an element `data-name`, which a page's script reads."""
    return _data(name, "application/json", json_text(value))


def _data(name: str, kind: str, text: str) -> str:
    return f'<script type="{kind}" id="data-{name}">{text}</script>'


def embedded(page: str, height: int = 640) -> str:
    """A page as a frame inside a notebook."""
    source = html.escape(page, quote=True)
    style = f"width:100%;height:{height}px;border:0"
    return f'<iframe sandbox="allow-scripts" style="{style}" srcdoc="{source}"></iframe>'
