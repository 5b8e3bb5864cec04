"""A store behind a URL: files are copied when they are first needed, checked, and kept.

Any file system that pyarrow knows will do (`s3://`, `gs://`, `hdfs://`, `file://`, …). The copies
lie in a folder named by the content hash of the store, so that they are never those of another one.
"""

import os
import shutil
import tempfile
from pathlib import Path

import pyarrow as pa
from pyarrow import fs

from shiftsim.data.store.files import digest
from shiftsim.data.store.reading import (
    MANIFEST,
    SCENARIOS,
    ScenarioStore,
    map_file,
    read_manifest,
    recording_folder,
)
from shiftsim.data.store.review import REVIEW
from shiftsim.errors import DataError
from shiftsim.files import remote_store_folder

_OVERLAYS = ("filter", Path(REVIEW).parent.name, "splits")  # may change, and are fetched each time


class RemoteStore(ScenarioStore):
    """A store behind a URL, open for reading. Made by `open_store`."""

    def __init__(self, url: str) -> None:
        self._url = url.rstrip("/")
        try:
            self._remote, self._root = fs.FileSystem.from_uri(self._url)
        except (pa.ArrowException, OSError, ValueError) as error:
            raise DataError(
                f"store {url!r}: {error}", hint="give a URL such as s3://bucket/folder"
            ) from error
        self._files: dict[str, str] = {}
        path = self._identify(remote_store_folder())
        self._need(path, SCENARIOS)
        for name in self._overlays():
            self._fetch(name, path / name)
        super().__init__(path)
        self.source = self._url

    def _identify(self, cache: Path) -> Path:
        """Folder of the copies of this content."""
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            found = Path(folder) / MANIFEST
            self._fetch(MANIFEST, found)
            manifest = read_manifest(Path(folder))
            self._files = manifest["files"]
            path = cache / manifest["hash"][:16] / self._root.rstrip("/").rpartition("/")[2]
            path.mkdir(parents=True, exist_ok=True)
            os.replace(found, path / MANIFEST)
        return path

    def map_file(self, city: str) -> Path:
        """File of a map."""
        path = map_file(self.path, city)
        self._need(self.path, path.relative_to(self.path).as_posix())
        return path

    def recording_folder(self, name: str) -> Path:
        """Folder of a recording."""
        folder = recording_folder(self.path, name)
        below = folder.relative_to(self.path).as_posix()
        for file in self._files:
            if file.startswith(f"{below}/"):
                self._need(self.path, file)
        return folder

    def _overlays(self) -> list[str]:
        """Files beside the scenarios that are not part of the hash."""
        selectors = [
            fs.FileSelector(f"{self._root}/{name}", allow_not_found=True) for name in _OVERLAYS
        ]
        found = [info for selector in selectors for info in self._remote.get_file_info(selector)]
        start = len(self._root.rstrip("/")) + 1
        return [info.path[start:] for info in found if info.type == fs.FileType.File]

    def _need(self, folder: Path, name: str) -> None:
        """Copy a file of the store, unless it is here already."""
        if (folder / name).exists():
            return
        self._fetch(name, folder / name)

    def _fetch(self, name: str, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            with (
                self._remote.open_input_stream(f"{self._root}/{name}") as source,
                partial.open("wb") as copy,
            ):
                shutil.copyfileobj(source, copy, 1 << 20)
            if name in self._files and digest(partial) != self._files[name]:
                raise DataError(
                    f"{self._url}/{name}: damaged, or changed since the store was written",
                    hint="upload the store again",
                )
            partial.replace(target)
        except (OSError, pa.ArrowException) as error:
            raise DataError(
                f"{self._url}/{name} cannot be read: {error}", hint="check the URL and the access"
            ) from error
        finally:
            partial.unlink(missing_ok=True)
