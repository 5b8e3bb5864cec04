"""When a GPU may replay what it has recorded; here a recording is a function of copies."""

import pytest

torch = pytest.importorskip("torch")

from shiftsim.planners.learned.network.graphs import MOST, Replayed  # noqa: E402

pytestmark = pytest.mark.learned


class Case:
    """Counts plain calls, recordings and replays."""

    def __init__(self, *, stale=False, fails=False):
        self.plain = self.recorded = self.replayed = 0
        self.stale, self.fails = stale, fails
        self.function = Replayed(self.double, record=self.record, device="cpu")

    def double(self, x):
        self.plain += 1
        return 2 * x

    def record(self, function, inputs):
        self.recorded += 1
        if self.fails:
            raise RuntimeError("operation not permitted when stream is capturing")
        kept = inputs[0].clone()

        def replay(fresh):
            self.replayed += 1
            if not self.stale:  # else it is one that reads what it was recorded with
                kept.copy_(fresh)
            return 2 * kept

        return replay

    def drive(self, count, size=3):
        with torch.inference_mode():
            for number in range(count):
                x = torch.full((size,), float(number))
                assert torch.equal(self.function(x), 2 * x)
        return self.plain, self.recorded, self.replayed


def test_a_shape_is_recorded_then_compared_then_replayed():
    assert [Case().drive(count) for count in range(1, 5)] == [
        (1, 0, 0),
        (2, 1, 0),
        (3, 1, 1),
        (3, 1, 2),
    ]


def test_a_recording_that_gives_something_else_is_never_used():
    assert Case(stale=True).drive(6) == (6, 1, 1)


def test_what_cannot_be_recorded_stays_plain():
    assert Case(fails=True).drive(6) == (6, 1, 0)


def test_only_some_shapes_are_kept():
    case = Case()
    for size in range(1, MOST + 3):
        case.drive(2, size)
    assert case.recorded == MOST


def test_training_and_other_devices_are_plain():
    case = Case()
    for _ in range(5):
        case.function(torch.ones(2))
    other = Replayed(case.double, record=case.record)
    with torch.inference_mode():
        for _ in range(5):
            other(torch.ones(2))
    assert (case.plain, case.recorded) == (10, 0)
