"""The files of a store behind a URL: copied when they are first needed, checked, and kept.

Any file system that pyarrow knows will do (`s3://`, `gs://`, `hdfs://`, `file://`, …). The copies
lie in a folder named by the URL and the manifest, so that they are never those of another store.
What lies beside the scenarios is mirrored: what the source no longer has is removed here, too.
"""

import hashlib
import logging
import shutil
import tempfile
from pathlib import Path

import pyarrow as pa
from pyarrow import fs

from shiftsim.data.store.tables import MANIFEST, REVIEW, SCENARIOS, digest, read_manifest
from shiftsim.errors import DataError
from shiftsim.files import safe_join, user_cache

_LOG = logging.getLogger(__name__)
_PATIENCE = 3  # s
_OVERLAYS = ("filter", Path(REVIEW).parent.name, "splits")  # may change, and are fetched each time


class RemoteFiles:
    """Local copies, below `path`, of the files of a store behind a URL.

    The list of scenarios and what lies beside it are always there.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        try:
            # Google's client would go on trying for a quarter of an hour
            given = self.url
            if given.startswith(("gs:", "gcs:")) and "retry_limit" not in given:
                given += f"{'&' if '?' in given else '?'}retry_limit_seconds={_PATIENCE}"
            self._remote, self._root = fs.FileSystem.from_uri(given)
        except (pa.ArrowException, OSError, ValueError) as error:
            hint = "give a URL such as s3://bucket/folder"
            raise DataError(f"store {url!r}: {error}", hint) from error
        self._files: dict[str, str] = {}
        self._checked = set[str]()  # files whose copy is what it should be
        try:
            self.path = self._identify(user_cache("stores"))
        except OSError as error:
            _LOG.warning("copies of %s are not kept: %s", self.url, error)
            self._temporary = tempfile.TemporaryDirectory()  # goes away with this object
            self.path = self._identify(Path(self._temporary.name))
        self.need(SCENARIOS)
        self._mirror_overlays()

    def need(self, name: str) -> None:
        """Copy a file, or all of a folder, unless it is here and whole; or a DataError."""
        for file in self._files:
            if (file == name or file.startswith(f"{name}/")) and file not in self._checked:
                place = safe_join(self.path, file)
                is_here = place.exists()
                if not is_here or digest(place) != self._files[file]:
                    if is_here:
                        _LOG.warning("%s is damaged and copied again", place)
                    self._fetch(file, place)
                self._checked.add(file)

    def _identify(self, cache: Path) -> Path:
        """Folder of the copies of this content."""
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            found = Path(folder) / MANIFEST
            self._fetch(MANIFEST, found)
            manifest = read_manifest(Path(folder))
            self._files = manifest["files"]
            key = hashlib.sha256(self.url.encode() + b"\0" + found.read_bytes()).hexdigest()
            path = cache / key[:16] / self._root.rstrip("/").rpartition("/")[2]
            path.mkdir(parents=True, exist_ok=True)
            found.replace(path / MANIFEST)
        return path

    def _mirror_overlays(self) -> None:
        """Files beside the scenarios that are not part of the hash: here what is there now."""
        start = len(self._root.rstrip("/")) + 1
        for folder in _OVERLAYS:
            selector = fs.FileSelector(f"{self._root}/{folder}", allow_not_found=True)
            found = self._remote.get_file_info(selector)
            names = {info.path[start:] for info in found if info.type == fs.FileType.File}
            for copy in (self.path / folder).glob("*"):
                # a folder is a file that another process is fetching
                if f"{folder}/{copy.name}" not in names and not copy.is_dir():
                    copy.unlink(missing_ok=True)
            for name in names:
                self._fetch(name, safe_join(self.path, name))

    def _fetch(self, name: str, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            # workers may fetch one file at the same time: each into a folder of its own
            with tempfile.TemporaryDirectory(dir=target.parent, prefix=".") as folder:
                partial = Path(folder) / target.name
                with (
                    self._remote.open_input_stream(f"{self._root}/{name}") as source,
                    partial.open("wb") as copy,
                ):
                    shutil.copyfileobj(source, copy, 1 << 20)
                if name in self._files and digest(partial) != self._files[name]:
                    what = f"{self.url}/{name}: damaged, or changed since the store was written"
                    raise DataError(what, "upload the store again")
                partial.replace(target)
        except (OSError, pa.ArrowException) as error:
            text = " ".join(str(error).split())
            text = text if len(text) < 400 else f"{text[:200]} … {text[-150:]}"
            what = f"{self.url}/{name} cannot be read: {text}"
            raise DataError(what, "check the URL, the network and the access") from error
