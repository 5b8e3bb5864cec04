"""Pages: template, style, script and data in one HTML text; the replay is one of them."""

import html
import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from shiftsim.files import write_text
from shiftsim.sim.log import SimulationLog
from shiftsim.view.scene import (
    Replay,
    ShownRollout,
    describe_scene,
    pack,
    rollout_fields,
    scene_fields,
)
from shiftsim.world.scenario import Scenario, require_scenario

MAX_ROLLOUTS = 6  # of a replay
_HERE = Path(__file__).parent
_THEME, _SCENE = "../report/theme.css", ("marks.js", "world.js", "player.js")
_FILES = {  # style and script of each page; its body is the file of its name
    "list": ([_THEME, "list.css"], ["marks.js", "list.js"]),
    "live": ([_THEME, "list.css", "live.css"], ["marks.js", "live.js"]),
    "replay": (["replay.css"], ["codec.js", *_SCENE, "strips.js", "waterfall.js", "replay.js"]),
    "review": (["replay.css", "review.css"], ["codec.js", *_SCENE, "review.js"]),
}
# of pages that are files; those of a server come with a header
_POLICY = (
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
        source, style = html.escape(self, quote=True), "width:100%;height:640px;border:0"
        return f'<iframe sandbox="allow-scripts" style="{style}" srcdoc="{source}"></iframe>'


def show(scenario: Scenario, **logs: SimulationLog) -> Page:
    """A replay of rollouts of one scenario, as `shiftsim.show(scenario, mine=log)`.

    Args:
        scenario: The scenario that was driven.
        logs: Rollouts by name, of which the first six are drawn; underscores stand for hyphens.

    Raises:
        ConfigError: There is no scenario.
        ValueError: There are no rollouts.

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
    seeds: Sequence[ShownRollout] = (),
    back: str = "",
    more: Mapping[str, Any] | None = None,
) -> Page:
    """A self-contained page of six rollouts; `back` is the list, `more` and `part` the others."""
    if not shown:
        raise ValueError("a replay shows at least one rollout")
    drawn = shown[:MAX_ROLLOUTS]
    words = f"{len(drawn)} of {len(shown)} rollouts shown" if len(drawn) < len(shown) else ""
    replay = Replay(scenario, drawn, seeds)
    first, *others = (rollout_fields(replay, index) for index in range(len(drawn)))
    data = {
        "meta": describe_scene(replay) | {"back": back, "shown": words} | dict(more or {}),
        "scene": pack(scene_fields(replay)),
        "rollout0": pack(first),
        **{f"rollout{n}": pack(fields, first) for n, fields in enumerate(others, 1)},
    }
    return framed("replay", title=f"{scenario.token} · shiftsim", images="data:", data=data)


def framed(
    name: str, *, title: str, images: str = "", data: Mapping[str, Any] | None = None, **parts: str
) -> Page:
    """A page of `_FILES` with the head of all pages: its script reads `data`, `parts` are HTML."""
    styles, scripts = _FILES[name]
    elements = []
    for key, value in (data or {}).items():
        kind = "text/plain" if isinstance(value, str) else "application/json"
        packed = value if isinstance(value, str) else json_text(value)
        elements.append(f'<script type="{kind}" id="data-{key}">{packed}</script>')
    title = html.escape(title)
    text = fill(
        _asset("frame.html"),
        title=title,
        meta=_POLICY.format(images=images) if images else "",
        style="".join(map(_asset, styles)),
        body=fill(_asset(f"{name}.html"), title=title, data="\n".join(elements), **parts),
        script="\n".join(map(_asset, scripts)),
    )
    return Page(text)


@cache
def _asset(name: str) -> str:
    """A file by its place from this folder."""
    return (_HERE / name).read_text(encoding="utf-8")


def fill(template: str, **parts: str) -> str:
    """The template with every `{{name}}` replaced, in one pass: parts are never scanned again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], template)


def json_text(value: Any) -> str:
    """JSON that can stand inside a script element whatever its strings hold."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
