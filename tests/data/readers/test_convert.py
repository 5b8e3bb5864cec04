"""What becomes of the recordings of a source, a broken one included."""

import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
from recordings import driving
from worlds import straight_road

from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.readers.convert import _key, convert
from shiftsim.data.readers.reader import Reader, SourceRecording
from shiftsim.data.readers.windows import ConversionConfig
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConversionError

CONFIG = ConversionConfig(window_s=3.0, overlap_s=1.0, history_s=1.0, ego_categories=("vehicle",))


class Source(Reader):
    """Recordings by name: how many cars each has, 0 for a broken one."""

    name, settings, site = "toys", {"speed": 5}, BuiltMap(straight_road(), {"repaired": 2}, {}, {})

    def __init__(self, source, **counts):
        self.source, self.counts, self.read_ones = source, counts, []
        for name in counts:
            (source / name).write_text(name)

    def recordings(self):
        return list(self.counts)

    def files(self, recording):
        return [self.source / recording]

    def read(self, recording):
        self.read_ones.append(recording)
        count = self.counts[recording]
        if not count:
            raise ConversionError(f"{recording} is broken", "mend it")
        samples = driving(*((0.0, 6.0, 10.0 + 60.0 * n, 0.0, 5.0) for n in range(count)))
        site = self.site or BuiltMap(straight_road(), {"repaired": 2}, {}, {})
        return SourceRecording(replace(samples, name=recording), site, CONFIG)

    def summarise(self, entries):
        return {"cars": sum(entry["summary"]["tracks"] for entry in entries)}


@pytest.mark.parametrize("has_site", [True, False])
def test_broken_recordings_are_skipped_and_others_are_kept(has_site, tmp_path):
    store, shown = tmp_path / "store", []
    source = Source(tmp_path, a=2, b=0, c=1)
    source.site = source.site if has_site else None
    report = convert(source, store, progress=lambda *args: shown.append(args))
    assert shown == [(0, 3, ""), (1, 3, "a"), (2, 3, "b"), (3, 3, "c")]
    assert (report.accepted, report.converted, report.kept) == (6, 2, 0)
    assert report.skipped == {"b": "b is broken (mend it)"}
    assert [summary.name for summary in report.recordings] == ["a", "c"]
    assert report.count("rejected") == {}
    assert report.details == {"cars": 3}
    assert report.map_warnings == {"repaired": 2 if has_site else 4}
    assert report.lanes == (6 if has_site else 0)
    assert repr(report) == "<ConversionReport toys: 6 scenarios of 2 recordings, 1 skipped>"
    assert len(ScenarioStore(store)) == 6
    assert not [path for path in store.rglob("*") if ".partial" in path.parts]

    source.counts["b"], before = 1, ScenarioStore(store).hash
    again, source.read_ones = Source(tmp_path, a=2, b=0, c=1), []
    again.site = source.site
    with pytest.raises(ConversionError, match="b is broken") as error:
        convert(Source(tmp_path, b=0), tmp_path / "other")
    assert error.value.hint == "mend it"
    kept = convert(again, store)
    assert (again.read_ones, kept.converted, kept.kept) == (["b"], 0, 2)
    assert ScenarioStore(store).hash == before
    mended = convert(source, store)
    assert (source.read_ones, mended.converted, mended.kept) == (["b"], 1, 2)
    assert len(ScenarioStore(store)) == 8
    (tmp_path / "c").write_text("changed")
    source.read_ones = []
    assert convert(source, store).converted == 1
    assert source.read_ones == ["c"]


def test_another_map_is_taken_only_where_nothing_else_is_on_the_one_of_before(tmp_path):
    source, other = Source(tmp_path, a=1), Source(tmp_path, b=1)
    road = source.site.road
    source.name = other.name = road.name
    wider = replace(road, epsg=25832)
    convert(source, tmp_path / "s")
    other.site = replace(source.site, road=wider)
    with pytest.raises(ConversionError, match=f"store .* has another map named {road.name!r}") as e:
        convert(other, tmp_path / "s")
    assert "--site" in e.value.hint
    source.site = other.site
    assert convert(source, tmp_path / "s").accepted == 2
    assert convert(other, tmp_path / "s").accepted == 2


def test_where_all_are_broken_the_first_is_told(tmp_path):
    source = Source(tmp_path, a=0, b=0)
    with pytest.raises(ConversionError, match=r"none of the 2 recordings .* the first is a: a is"):
        convert(source, tmp_path / "store")
    source = Source(tmp_path, a=0)
    with pytest.raises(ConversionError, match=r"^a is broken"):
        convert(source, tmp_path / "store")


def test_a_key_tells_files_and_settings_but_not_where_they_are(tmp_path):
    def key(name="a", settings=5, text="x", folder="one"):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "file").write_text(text)
        reader = SimpleNamespace(
            settings={"speed": settings}, files=lambda _: [tmp_path / folder / "file"]
        )
        return _key(reader, name)

    assert re.fullmatch("[0-9a-f]{16}", key())
    assert key() == key(folder="two") == key(name="z/a")
    assert len({key(), key(name="b"), key(settings=6), key(text="y")}) == 4
