import http.client
import json

import pytest
from review_servers import reviewing
from stores import write_toy_store

from shiftsim.data.store.reading import open_store
from shiftsim.data.store.tables import REVIEW
from shiftsim.view.review import ReviewService
from shiftsim.view.serving import HOST, MAX_BODY, TOKEN_HEADER

FIRST = "0000cafe"


@pytest.fixture
def store(tmp_path):
    return write_toy_store(tmp_path / "toy", count=2)


@pytest.fixture
def server(store):
    with reviewing(store) as running:
        yield running


def ask(server, method, path, body=None, **headers):
    """Status and text of an answer; headers of None are left out."""
    port = server.server_address[1]
    given = {TOKEN_HEADER: server.token, "Host": f"{HOST}:{port}"} | headers
    connection = http.client.HTTPConnection(HOST, port, timeout=20)
    connection.putrequest(method, path, skip_host=True)
    content = (
        b"" if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
    )
    for name, value in given.items():
        if value is not None:
            connection.putheader(name, value)
    if body is not None:
        connection.putheader("Content-Length", str(len(content)))
    connection.endheaders(content)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def review(**values):
    return {"token": FIRST, "values": values}


def test_only_the_loopback_interface_is_served(server):
    assert server.server_address[0] == "127.0.0.1"


def test_the_page_comes_with_its_token_and_allows_nothing_from_elsewhere(server):
    status, text = ask(server, "GET", f"/?token={server.token}", **{TOKEN_HEADER: None})

    assert status == 200
    assert "<canvas" in text
    assert "http://" not in text
    assert "https://" not in text


@pytest.mark.parametrize("path", ["/", "/?token=wrong", "/?token=", "/api/scenarios"])
def test_without_the_token_nothing_is_shown(server, path):
    status, text = ask(server, "GET", path, **{TOKEN_HEADER: None})

    assert status == 403
    assert "cafe" not in text


def test_the_token_in_an_address_opens_the_page_only(server):
    status, _ = ask(server, "GET", f"/api/scenarios?token={server.token}", **{TOKEN_HEADER: None})

    assert status == 403


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Host": "evil.example"},
        {"Host": None},
        {TOKEN_HEADER: "wrong"},
        {TOKEN_HEADER: None},
    ],
)
@pytest.mark.parametrize("method", ["GET", "POST"])
@pytest.mark.thorough
def test_foreign_origins_hosts_and_tokens_are_refused_and_change_nothing(
    server, store, method, headers
):
    path = "/api/scenarios" if method == "GET" else "/api/review"
    body = None if method == "GET" else review(decision="reject")

    status, text = ask(server, method, path, body, **headers)

    assert status == 403
    assert "cafe" not in text
    assert not (store / REVIEW).exists()


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd",
        "/store.json",
        "/%2e%2e/store.json",
        "/api/../store.json",
        "//etc/passwd",
        "/review/review.jsonl",
        "/api/scenario/../../store.json",
    ],
)
@pytest.mark.thorough
def test_no_file_is_served_by_its_path(server, path):
    status, text = ask(server, "GET", path)

    assert status == 404
    assert "no such page" in text


@pytest.mark.parametrize("token", ["..", "../../x", "nope", ""])
def test_scenarios_are_found_by_token_and_never_by_path(server, store, token):
    before = sorted(store.rglob("*"))

    status, text = ask(server, "GET", f"/api/scenario?id={token}")
    kept, _ = ask(server, "POST", "/api/review", {"token": token, "values": {"decision": "reject"}})

    assert (status, kept) == (400, 400)
    assert "has no scenario" in text
    assert sorted(store.rglob("*")) == before


def test_a_decision_is_on_disk_before_its_answer(server, store):
    status, text = ask(server, "POST", "/api/review", review(decision="reject", comment="odd"))

    kept = json.loads((store / REVIEW).read_text())
    assert status == 200
    assert json.loads(text)["decision"] == "reject"
    assert (kept["token"], kept["decision"], kept["comment"]) == (FIRST, "reject", "odd")
    assert kept["reviewer"] == "me"
    assert kept["version"]


def test_nothing_but_the_review_is_written(server, store):
    before = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}

    ask(server, "GET", f"/api/scenario?id={FIRST}")
    ask(server, "POST", "/api/review", review(decision="accept", route=["1", "2"]))

    after = {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}
    assert set(after) - set(before) == {store / REVIEW}
    assert all(after[path] == content for path, content in before.items())


def test_a_corrected_route_is_what_the_store_then_gives(server, store):
    _, text = ask(server, "POST", "/api/review", review(route=["1", "2"]))

    assert json.loads(text)["problems"] == []
    assert open_store(store).read(FIRST).route == ("1", "2")


def test_the_recorded_route_needs_no_line(server, store):
    ask(server, "POST", "/api/review", review(route=["1", "2"]))
    ask(server, "POST", "/api/review", review(route=["1", "2", "3"]))

    assert (store / REVIEW).read_text() == ""


def test_the_validity_of_a_route_is_told_without_keeping_it(server, store):
    status, text = ask(server, "POST", "/api/route", {"token": FIRST, "values": ["1", "3"]})

    assert status == 200
    assert json.loads(text)["problems"] == ["1 does not lead to 3"]
    assert not (store / REVIEW).exists()


@pytest.mark.parametrize(
    "values",
    [
        {"decision": "perhaps"},
        {"decision": 1},
        {"comment": 3},
        {"comment": "x" * 5000},
        {"route": "1"},
        {"route": []},
        {"route": ["1", "77"]},
        {"route": [1, 2]},
        {"token": "0001cafe"},
        {"reviewer": "someone else"},
    ],
)
@pytest.mark.thorough
def test_a_wrong_value_is_refused_and_not_kept(server, store, values):
    status, text = ask(server, "POST", "/api/review", review(**values))

    assert status == 400
    assert json.loads(text)["error"]
    assert not (store / REVIEW).exists()


@pytest.mark.parametrize("body", [b"{", b"[]", b"3", b"\xff\xfe", b""])
def test_a_body_that_is_no_object_is_refused(server, body):
    status, _ = ask(server, "POST", "/api/review", body)

    assert status == 400


def test_a_body_that_is_too_long_is_not_read(server):
    status, _ = ask(server, "POST", "/api/review", None, **{"Content-Length": str(MAX_BODY + 1)})

    assert status == 413


def test_reviews_survive_the_server(server, store):
    ask(server, "POST", "/api/review", review(decision="accept", comment="fine"))

    again = ReviewService(store, "me").listing()["scenarios"]

    assert [(row["decision"], row["comment"]) for row in again] == [("accept", "fine"), ("", "")]


def test_a_full_disk_is_reported_and_what_was_kept_stays(server, store, monkeypatch):
    ask(server, "POST", "/api/review", review(decision="accept"))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shiftsim.view.review.write_reviews", full)
    status, text = ask(server, "POST", "/api/review", review(decision="reject"))
    listing = json.loads(ask(server, "GET", "/api/scenarios")[1])

    assert status == 500
    assert "No space left" in text
    assert listing["scenarios"][0]["decision"] == "accept"
    assert json.loads((store / REVIEW).read_text())["decision"] == "accept"


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/api/review", b"[" * 100_000),
        ("/api/review", b"9" * 5000),
        ("/api/review", b"\xff"),
        ("/api/review", {"token": FIRST, "values": {"route": [["1"]]}}),
        ("/api/review", {"token": FIRST, "values": {"route": [{}]}}),
        ("/api/review", {"token": FIRST, "values": {"decision": []}}),
        ("/api/review", {"token": [FIRST], "values": {}}),
        ("/api/route", {"token": {}, "values": ["1"]}),
    ],
)
@pytest.mark.thorough
def test_a_malformed_request_is_answered(server, path, body):
    status, text = ask(server, "POST", path, body)
    assert status == 400
    assert json.loads(text)["error"]


@pytest.mark.parametrize("path", ["http://[/", "http://[::1"])
def test_a_malformed_address_is_answered(server, path):
    assert ask(server, "GET", path)[0] == 400


def test_a_request_without_a_length_is_answered(server):
    assert ask(server, "POST", "/api/review")[0] == 400
    assert ask(server, "POST", "/api/review", **{"Content-Length": "9" * 5000})[0] == 413


def test_a_thumbnail_is_small_and_of_a_known_scenario(server):
    status, text = ask(server, "GET", f"/api/thumbnail?id={FIRST}")
    (road, expert), view = (json.loads(text)[name] for name in ("scene", "view"))

    assert status == 200
    assert len(text) < 500
    assert road.endswith("z")
    assert expert.startswith("M0 0l")  # from where the ego starts
    assert view[2] > view[3] > 0
    assert ask(server, "GET", "/api/thumbnail?id=unknown")[0] == 400
