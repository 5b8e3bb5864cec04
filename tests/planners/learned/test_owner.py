"""What is asked of the process that has the networks, and how it is sent."""

import pickle
import sys
import time
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client
from threading import Barrier, Thread

import pytest

from shiftsim.errors import ConfigError, PlannerError
from shiftsim.planners.learned import owner
from shiftsim.planners.learned.owner import (
    InferenceClient,
    InferenceServer,
    new_address,
)

pytestmark = pytest.mark.skipif(
    sys.platform not in ("linux", "win32"), reason="devices of torch's CUDA are there only"
)


class Doubling:
    """Doubles numbers, and refuses some."""

    def infer(self, features):
        if "ours" in features:
            raise ConfigError("cannot", hint="do not")
        return [2 * number for number in features]


class Slowly:
    """Notes whether two passes were ever computed at once."""

    inside, together = 0, False

    def infer(self, features):
        self.inside += 1
        time.sleep(0.01)
        self.together = self.together or self.inside > 1
        self.inside -= 1
        return features


@pytest.fixture(scope="module")
def asking():
    address = new_address()
    slowly = Slowly()
    held = InferenceServer({"doubling": Doubling, "slowly": lambda: slowly}, address)
    return (
        lambda name, key=address.key: InferenceClient(address._replace(key=key), name),
        held,
        slowly,
    )


def test_errors_are_those_of_the_network(asking):
    ask = asking[0]("doubling")
    assert ask([1, 2]) == [2, 4]
    with pytest.raises(ConfigError) as refused:
        ask(["ours"])
    assert refused.value.hint == "do not"
    assert "in infer" in refused.value.__notes__[0]
    with pytest.raises(PlannerError, match=r"^TypeError: unsupported operand"):
        ask([None])
    assert ask([3]) == [6]


def test_one_pass_at_a_time_is_computed(asking):
    make, _, slowly = asking
    line, answers = Barrier(4), []

    def worker(number):
        ask = make("slowly")
        line.wait()
        answers.extend((number, ask([number])) for _ in range(5))

    threads = [Thread(target=worker, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [(number, [number]) for number in range(4) for _ in range(5)]
    assert not slowly.together


def test_who_has_not_the_key_is_not_let_in(asking):
    make = asking[0]
    with pytest.raises(AuthenticationError):
        Client(make("doubling").address.place, authkey=b"guessed")
    with Client(make("doubling").address.place):  # and says nothing
        assert make("doubling")([1]) == [2]
    assert make("doubling")([1]) == [2]


def test_what_travels_has_no_connection_and_makes_its_own(asking):
    ask = asking[0]("doubling")
    ask([1])
    sent = pickle.loads(pickle.dumps(ask))
    assert sent._connection is None
    assert sent([1]) == [2]


def test_without_an_owner_it_waits_once_and_says_so(monkeypatch):
    monkeypatch.setattr(owner, "PATIENCE", 0.3)
    ask = InferenceClient(new_address(), "plantf")
    took = []
    for _ in range(2):
        began = time.monotonic()
        with pytest.raises(PlannerError, match="planner 'plantf': the process that holds its net"):
            ask([1])
        took.append(time.monotonic() - began)
    assert took[0] >= 0.3
    assert took[1] < 0.2
