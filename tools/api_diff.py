"""Changes of the public API since a git revision that may break callers.

`python tools/api_diff.py REVISION` prints them; exit code 1 where there are any and changes/
is as it was.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import griffe
from build_site import ROOT, copy_modules


def load(tree: Path, folder: Path) -> griffe.Object:
    """The package of a source tree, read from a copy in `folder`."""
    copy_modules(folder / "shiftsim", tree)
    found = griffe.load("shiftsim", search_paths=[folder], try_relative_path=False)
    assert isinstance(found, griffe.Object)
    return found


def public_names(package: griffe.Object) -> set[str]:
    """Where the public names of the package are defined."""
    return {package[str(name)].canonical_path for name in package.exports or ()}


def changes(old: griffe.Object, new: griffe.Object) -> Iterator[str]:
    """A line per change of a public name, or of a member of one."""
    public = public_names(old) | public_names(new)
    for name in sorted({str(name) for name in old.exports} - {str(name) for name in new.exports}):
        yield f"shiftsim.{name}: is gone"
    for change in griffe.find_breaking_changes(old, new):
        path = change.obj.canonical_path
        if any(path == name or path.startswith(f"{name}.") for name in public):
            yield change.explain(griffe.ExplanationStyle.ONE_LINE)


def main(revision: str) -> int:
    """Compare the working tree with a revision."""
    git = ["git", "-C", str(ROOT)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tree = folder / "tree"
        tree.mkdir()
        archive = subprocess.run([*git, "archive", revision], capture_output=True, check=True)
        subprocess.run(["tar", "-x", "-C", str(tree)], input=archive.stdout, check=True)
        found = list(changes(load(tree, folder / "old"), load(ROOT, folder / "new")))
    print("\n".join(found) or "no public signature has changed")
    told = subprocess.run([*git, "diff", "--quiet", revision, "--", "changes"], check=False)
    if found and not told.returncode:
        print("error: name these changes in changes/")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
