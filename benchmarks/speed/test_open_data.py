"""Conversion of Argoverse 2 scenes: pytest benchmarks/speed/test_open_data.py.

The real sample, many times under other names; it is skipped without the reference folder.
"""

import shutil
from pathlib import Path
from time import perf_counter, process_time

import pytest

from shiftsim.data.readers.av2 import Av2Reader
from shiftsim.data.readers.convert import convert

SAMPLE = Path(__file__).resolve().parents[3] / "shared/reference/open_data/av2"


@pytest.fixture(scope="module")
def count(size) -> int:
    return size(100, 10)


@pytest.fixture(scope="module")
def scenes(count, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not SAMPLE.is_dir():
        pytest.skip("needs the sample of the reference folder beside the repository")
    folder = tmp_path_factory.mktemp("av2")
    (tracks,), (road,) = SAMPLE.glob("*.parquet"), SAMPLE.glob("*.json")
    for number in range(count):
        name = f"{number:08d}-1817-4a98-b02e-db8c9327d151"
        (folder / name).mkdir()
        shutil.copy(tracks, folder / name / f"scenario_{name}.parquet")
        shutil.copy(road, folder / name / f"log_map_archive_{name}.json")
    return folder


def test_scenes_per_second_and_core(scenes, count, tmp_path):
    convert(Av2Reader(SAMPLE), tmp_path / "warm")  # kernels
    began, work = perf_counter(), process_time()
    report = convert(Av2Reader(scenes), tmp_path / "store")
    seconds, work = perf_counter() - began, process_time() - work
    print(f"\n{count} scenes of 58 tracks in {seconds:.1f} s", end="")
    print(f": {count / seconds:.1f} scenes/s, {count / work:.1f} by CPU time", end="")
    assert report.accepted == count
    assert count / work >= 4
