"""`python -m shiftsim` is the command `shiftsim`."""

from shiftsim.cli import main

if __name__ == "__main__":
    main()
