"""`python -m shiftsim` is the command `shiftsim`."""

import os
import sys

if not sys.flags.safe_path and sys.path[0] in ("", os.getcwd()):
    del sys.path[0]  # the current folder: what lies in it is not code

from shiftsim.cli import main

if __name__ == "__main__":
    main()
