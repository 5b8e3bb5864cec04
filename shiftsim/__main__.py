"""The command `shiftsim`, also as `python -m shiftsim`.

It listens to an interrupt before anything heavy is imported, so that an early one ends in one line
as well.
"""

import atexit
import gc
import os
import sys

if not sys.flags.safe_path and sys.path[0] in ("", os.getcwd()):
    del sys.path[0]  # the current folder: what lies in it is not code


def _leave(*signal: object) -> None:
    before = "\r" if os.isatty(2) else ""  # over the ^C of the terminal
    os.write(2, f"{before}error: interrupted\n".encode())
    os._exit(130)


def main() -> None:
    """Run the command line."""
    # one thread per process, here as in workers; NumPy and SciPy would each start one per core
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    atexit.register(gc.freeze)  # the end frees all memory: no need to look for garbage in it
    try:
        import signal

        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _leave)
        from shiftsim.cli import main as run

        run()
    except KeyboardInterrupt:  # before the command line has begun, or after it has ended
        _leave()


if __name__ == "__main__":
    main()
