"""A review page that answers in this process."""

from contextlib import contextmanager
from threading import Thread

from shiftsim.view.review import ReviewService, review_server


@contextmanager
def reviewing(store):
    """The server of the page of a store, while it answers."""
    with review_server(ReviewService(store, "me")) as running:
        thread = Thread(target=running.serve_forever, daemon=True)
        thread.start()
        yield running
        running.shutdown()
        thread.join()
