"""The command `shiftsim`, also as `python -m shiftsim`.

It hears an interrupt before anything heavy is imported, so that one which comes early ends in one
line as well.
"""

import atexit
import gc
import os
import sys

if not sys.flags.safe_path and sys.path[0] in ("", os.getcwd()):
    del sys.path[0]  # the current folder: what lies in it is not code


def _leave(*signal: object) -> None:
    over = "\r" if os.isatty(2) else ""  # the ^C of the terminal
    os.write(2, f"{over}error: interrupted\n".encode())
    os._exit(130)


def main() -> None:
    """Run the command line."""
    # one thread per process, here as in workers: NumPy and SciPy would each start one for every
    # core when they are imported, a tenth of a short command
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # the end frees all memory; looking for garbage in it first is a quarter of a short command
    atexit.register(gc.freeze)
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
