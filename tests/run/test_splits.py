"""Splits name scenarios."""

import pytest

from shiftsim.errors import ConfigError
from shiftsim.splits import find_split, read_split, token_hash

TOKENS = ("a1", "b2", "c3")


def test_the_store_itself_is_a_split(tmp_path):
    store = tmp_path / "mini"
    assert find_split("", store, TOKENS).tokens == TOKENS
    assert find_split("mini", store, TOKENS).name == "mini"


def test_a_split_of_the_store_is_found_by_name(tmp_path):
    (tmp_path / "splits").mkdir()
    (tmp_path / "splits" / "small.toml").write_text('tokens = ["a1"]')
    assert find_split("small", tmp_path, TOKENS).tokens == ("a1",)
    with pytest.raises(ConfigError, match="split 'smal' unknown") as caught:
        find_split("smal", tmp_path, TOKENS)
    assert "did you mean 'small'" in caught.value.hint


def test_a_list_of_tokens_is_a_split(tmp_path):
    path = tmp_path / "list.txt"
    path.write_text("a1\nb2\n")
    assert read_split(path).tokens == ("a1", "b2")
    assert read_split(path).name == "list"


def test_the_hash_does_not_depend_on_the_order():
    assert token_hash(["a", "b"]) == token_hash(["b", "a"]) != token_hash(["a", "c"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lists no tokens"),
        ("tokens = []", "lists no tokens"),
        ("tokens = [1]", "lists no tokens"),
        ('tokens = ["a", "b", "a"]', "lists 'a' twice"),
        ('tokens = ["a"]\ncount = 2', "says count = 2, but it is 1"),
        ('tokens = ["a"]\nhash = "00"', "says hash"),
    ],
)
def test_a_split_that_contradicts_itself_is_refused(tmp_path, text, message):
    path = tmp_path / "split.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_split(path)
