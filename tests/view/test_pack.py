import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pages import unpack

from shiftsim.view.scene import Quantised, pack


@given(
    hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=1, max_dims=3, max_side=6),
        elements=st.one_of(st.floats(-1e6, 1e6), st.just(np.nan)),
    ),
    st.sampled_from([0.001, 0.01, 1.0]),
)
def test_a_quantised_field_comes_back_within_half_a_step(values, step):
    found = unpack(pack({"field": Quantised(values, step)}))["field"]

    np.testing.assert_array_equal(np.isnan(found), np.isnan(values))
    np.testing.assert_allclose(found, values, rtol=1e-9, atol=0.51 * step)


@given(
    hnp.arrays(np.float64, (2, 5, 3), elements=st.one_of(st.floats(-1e6, 1e6), st.just(np.nan))),
    st.floats(-0.04, 0.04),
)
def test_what_is_stored_from_another_section_comes_back_as_exactly(both, much):
    first, other = both[0], np.where(np.arange(5)[:, None] < 3, both[0], both[1] + much)
    base, alone = {"field": Quantised(first, 0.01)}, {"field": Quantised(other, 0.01)}

    found = unpack(pack(alone, base), pack(base))["field"]

    np.testing.assert_array_equal(found, unpack(pack(alone))["field"])


def test_what_another_section_holds_takes_no_room(rng):
    field = {"field": Quantised(rng.uniform(-80, 80, (150, 60)), 0.01)}

    assert len(pack(field, field)) < 0.02 * len(pack(field))


def test_bytes_come_back_as_they_are_between_quantised_fields():
    flags = np.array([[True, False], [False, True], [True, True]])

    found = unpack(
        pack({"a": Quantised(np.arange(3.0), 1.0), "b": flags, "c": Quantised(np.ones(2), 0.5)})
    )

    assert found["b"].tolist() == flags.astype(int).tolist()
    assert found["a"].tolist() == [0, 1, 2]
    assert found["c"].tolist() == [1, 1]


def test_empty_fields_are_possible():
    found = unpack(
        pack({"none": Quantised(np.zeros((0, 2)), 0.1), "flags": np.zeros((3, 0), bool)})
    )

    assert found["none"].shape == (0, 2)
    assert found["flags"].shape == (3, 0)


def test_smooth_motion_takes_little_room():
    time = np.arange(150) * 0.1
    xy = np.stack([8.0 * time, 3.0 * np.sin(time)], axis=1)
    many = np.repeat(xy[:, None], 60, axis=1) + np.random.default_rng(1).uniform(-80, 80, (60, 2))

    assert len(pack({"xy": Quantised(many, 0.01)})) < 40_000


@pytest.mark.parametrize("value", [3e9, -3e9])
def test_values_out_of_range_are_clipped_and_never_taken_for_missing(value):
    found = unpack(pack({"field": Quantised(np.array([value]), 1.0)}))["field"]

    assert np.sign(found[0]) == np.sign(value)
    assert abs(found[0]) > 2e9
