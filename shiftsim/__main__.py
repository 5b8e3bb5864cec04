"""The command `shiftsim`, also as `python -m shiftsim`."""

import os
import sys

if not sys.flags.safe_path and sys.path[0] in ("", os.getcwd()):
    del sys.path[0]  # the current folder: what lies in it is not code


def main() -> None:
    """Run the command line."""
    # one thread per process, here as in workers; NumPy and SciPy would each start one per core
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from shiftsim.cli import main as run

    run()


if __name__ == "__main__":
    main()
