"""Pickles of others are read without running anything, whatever they ask for."""

import pytest

from shiftsim.verify.nuplan.plain_pickle import PlainReader


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"\x80\x05\x96" + (1 << 40).to_bytes(8, "little") + b"x.", "1099511627776 bytes"),
        (b"\x80\x02Nr" + (1 << 31).to_bytes(4, "little") + b".", "object number 2147483648"),
        (b"Np987654321\n.", "object number 987654321"),
        (b"\x80\x02N", "exhausted"),
    ],
)
def test_a_pickle_that_asks_for_absurd_memory_is_refused_before_it_is_read(content, why):
    with pytest.raises(ValueError, match=why):
        PlainReader(content, lambda module, name: None)


def test_a_pickle_that_numbers_its_objects_is_read():
    assert PlainReader(b"\x80\x02(NNr\x05\x00\x00\x00l.", lambda *_: None).load() == [None, None]
