import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from stores import write_toy_store
from worlds import straight_road

from shiftsim.data.store.reading import open_store
from shiftsim.data.store.review import (
    Review,
    Reviews,
    read_reviews,
    route_problems,
    write_reviews,
)
from shiftsim.data.store.tables import REVIEW
from shiftsim.errors import DataError


@pytest.fixture
def store(tmp_path):
    return write_toy_store(tmp_path / "toy", count=2)


def test_a_store_that_nobody_reviewed_has_no_reviews(store):
    assert len(read_reviews(store)) == 0
    assert open_store(store).reviews.hash == ""


def test_reviews_come_back_one_line_per_scenario(store):
    reviews = Reviews(
        [
            Review("0001cafe", "reject", 'a "strange" one\nindeed', reviewer="me", version="1"),
            Review("0000cafe", route=("1", "2")),
        ]
    )

    path = write_reviews(store, reviews)

    assert dict(read_reviews(store)) == dict(reviews)
    assert [json.loads(line)["token"] for line in path.read_text().splitlines()] == [
        "0000cafe",
        "0001cafe",
    ]


def test_a_corrected_route_replaces_the_recorded_one_and_the_files_keep_their_bytes(store):
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    hash_before = open_store(store).hash

    write_reviews(store, Reviews([Review("0000cafe", route=("1", "2"))]))

    opened = open_store(store)
    assert opened.read("0000cafe").route == ("1", "2")
    assert opened.read_recorded("0000cafe").route == ("1", "2", "3")
    assert opened.read("0001cafe").route == ("1", "2", "3")
    assert opened.hash == hash_before
    assert all(path.read_bytes() == content for path, content in before.items())


def test_a_route_over_unknown_roadblocks_is_an_error_that_names_them(store):
    write_reviews(store, Reviews([Review("0000cafe", route=("1", "77"))]))

    with pytest.raises(DataError, match="'77'"):
        open_store(store).read("0000cafe")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "line 1: not JSON"),
        ("[]", r"line 1: \[\] is not a table"),
        ('{"decision": "accept"}', "line 1: token is missing"),
        ('{"token": "a", "colour": "red"}', "line 1: key 'colour' unknown"),
        ('{"token": "a", "decision": "perhaps"}', "line 1: decision 'perhaps'"),
        ('{"token": "a", "route": "1"}', "line 1: route is '1'; it must be a list"),
        ('{"token": "a", "route": []}', "line 1: the route is empty"),
        ('{"token": "a", "comment": 3}', "line 1: comment is 3; it must be a text"),
        (
            '{"token": "a", "decision": "accept"}\n{"token": "a", "decision": "reject"}',
            "line 2: scenario 'a' is reviewed twice",
        ),
    ],
)
def test_a_damaged_review_names_the_line(store, line, message):
    (store / REVIEW).parent.mkdir()
    (store / REVIEW).write_text(line)

    with pytest.raises(DataError, match=message):
        open_store(store)


def test_a_decision_goes_before_the_filter():
    reviews = Reviews([Review("a", "accept"), Review("b", "reject"), Review("d", comment="hm")])

    assert reviews.usable("abcd", accepted="bcd") == ("a", "c", "d")
    assert Reviews().usable("abcd", accepted="bd") == ("b", "d")


@given(st.sampled_from(["accept", "reject"]), st.text(max_size=5))
def test_the_hash_follows_decisions_and_routes_but_not_words(decision, words):
    bare = Reviews([Review("a", decision)])

    assert Reviews([Review("a", decision, words, reviewer=words)]).hash == bare.hash
    assert Reviews([Review("a", decision, route=("1",))]).hash != bare.hash
    assert Reviews([Review("b", decision)]).hash != bare.hash
    assert Reviews([Review("a", comment=words)]).hash == ""


def test_taking_everything_back_leaves_no_review():
    reviews = Reviews([Review("a", "accept")]).with_review(Review("a", reviewer="me"))

    assert len(reviews) == 0


@pytest.mark.parametrize(
    ("route", "start", "problem"),
    [
        (["1", "2", "3"], "1", None),
        (["1", "3"], "1", "1 does not lead to 3"),
        (["1", "2", "1"], "1", "roadblock 1 is there twice"),
        (["1", "9"], "1", "roadblock 9 is not on the map"),
        (["2", "3"], "1", "the ego starts on 1"),
        (["1"], "1", "at least two roadblocks"),
        (["1", "2"], None, None),
    ],
)
def test_problems_of_a_route_are_named(route, start, problem):
    road = straight_road()

    found = route_problems(road, route, None if start is None else road.blocks.index[start])

    assert bool(found) == (problem is not None)
    assert problem is None or any(problem in text for text in found)
