import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shiftsim.errors import ConfigError
from shiftsim.sim import noise
from shiftsim.sim.noise import NOISE_NAMES, NoiseModel, parse_noise, sample_noise


def bias(accel, steering, num_steps, dt):
    """An own model: a constant on the acceleration, white noise on the steering rate."""
    return np.stack([np.full(num_steps, 0.1), steering.standard_normal(num_steps)], axis=1)


def scalar(accel, steering, num_steps, dt):
    return np.zeros(num_steps)


STORED = NoiseModel("awgn", 0.25, 0.05)
# must never change: stored runs would no longer be repeatable
PINNED = np.array([0.10568902229711481, 0.3192655696816172, 0.0558923064012774])


def sampled(name: str, seed: int = 0, token: str = "a1", num_steps: int = 150) -> np.ndarray:
    return sample_noise(parse_noise(name), seed=seed, token=token, num_steps=num_steps)


@pytest.mark.parametrize("name", NOISE_NAMES)
def test_every_name_is_parsed_and_kept(name):
    assert parse_noise(name).name == name
    assert sampled(name).shape == (150, 2)


@pytest.mark.parametrize("kind", ["awgn", "ou"])
@pytest.mark.parametrize(
    ("level", "accel", "rate"), [("low", 0.5, 0.1), ("mid", 1.0, 0.2), ("high", 1.5, 0.3)]
)
def test_levels_have_the_benchmarks_sigmas(kind, level, accel, rate):
    model = parse_noise(f"{kind}-{level}")

    assert (model.kind, model.sigma_accel, model.sigma_rate, model.theta) == (
        kind,
        accel,
        rate,
        2.0,
    )


def test_an_unknown_name_is_answered_with_the_nearest_and_the_list():
    with pytest.raises(ConfigError, match="'uo-high' unknown") as raised:
        parse_noise("uo-high")

    assert "did you mean 'ou-high'" in raised.value.hint
    assert "awgn-low" in raised.value.hint


def test_the_same_key_gives_the_same_noise_and_any_other_key_another():
    first = sampled("awgn-mid")

    np.testing.assert_array_equal(sampled("awgn-mid"), first)
    for other in (sampled("awgn-mid", seed=1), sampled("awgn-mid", token="a2")):
        assert not np.isclose(other, first).any()


def test_a_longer_rollout_begins_with_the_noise_of_a_shorter_one():
    np.testing.assert_array_equal(
        sampled("ou-low", num_steps=20), sampled("ou-low", num_steps=150)[:20]
    )


def test_the_stream_is_pinned():
    drawn = noise.keyed_generator(0, "a1", "noise-accel").standard_normal(3)

    np.testing.assert_array_equal(drawn, PINNED)


def test_channels_are_independent():
    drawn = sampled("awgn-high", num_steps=20_000)

    assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.03


@pytest.mark.parametrize("kind", ["none", "awgn", "ou"])
def test_sigma_zero_is_exactly_plus_zero(kind):
    drawn = sample_noise(NoiseModel(kind), seed=3, token="a", num_steps=50)

    np.testing.assert_array_equal(drawn, 0.0)
    assert not np.signbit(drawn).any()


def test_both_kinds_have_the_deviations_of_theory():
    white, coloured = (sampled(n, num_steps=200_000).std(axis=0) for n in ("awgn-mid", "ou-mid"))

    np.testing.assert_allclose(white, [1.0, 0.2], rtol=0.02)
    np.testing.assert_allclose(coloured, np.sqrt(1.0 / 3.6) * np.array([1.0, 0.2]), rtol=0.02)


@given(st.integers(0, 2**32 - 1))
def test_the_process_is_updated_before_it_is_applied(seed):
    eps = np.random.default_rng(seed).standard_normal((3, 2))
    scale = np.array([1.5, 0.3]) * np.sqrt(0.1)

    drawn = noise.noise_from_normals(parse_noise("ou-high"), eps)

    second = 0.8 * scale * eps[0] + scale * eps[1]
    np.testing.assert_array_equal(drawn[0], scale * eps[0])
    np.testing.assert_allclose(drawn[1], second, rtol=0.0, atol=1e-12)


def test_an_own_function_is_a_model_and_travels_between_processes():
    model = parse_noise(f"{__name__}:bias") if __name__ != "__main__" else None

    again = pickle.loads(pickle.dumps(NoiseModel("custom", function=bias)))

    assert model is not None
    for own in (model, again):
        drawn = sample_noise(own, seed=0, token="a1", num_steps=5)
        np.testing.assert_array_equal(drawn[:, 0], 0.1)
    assert model.name == f"{__name__}:bias"


def test_an_own_model_may_be_stored_parameters():
    assert parse_noise(f"{__name__}:STORED") is STORED
    assert STORED.name == "awgn(0.25,0.05)"


@pytest.mark.parametrize("name", ["no_such_module:f", f"{__name__}:absent", f"{__name__}:PINNED"])
def test_an_own_model_that_cannot_be_used_is_refused(name):
    with pytest.raises(ConfigError, match="noise '"):
        parse_noise(name)


def test_an_own_model_of_the_wrong_shape_is_refused():
    with pytest.raises(ConfigError, match=r"returned shape \(4,\)"):
        sample_noise(NoiseModel("custom", function=scalar), seed=0, token="a", num_steps=4)


@pytest.mark.parametrize(
    "arguments",
    [
        {"kind": "pink"},
        {"kind": "awgn", "sigma_accel": -1.0},
        {"kind": "ou", "theta": float("nan")},
        {"kind": "custom"},
    ],
)
def test_impossible_parameters_are_refused(arguments):
    with pytest.raises(ConfigError):
        NoiseModel(**arguments)


def stationary(name: str, *, tokens: int = 400, num_steps: int = 250) -> np.ndarray:
    """(scenarios, steps, 2) noise after 50 steps, when the start at 0 is forgotten."""
    drawn = [sampled(name, token=f"scenario-{i}", num_steps=num_steps + 50) for i in range(tokens)]
    return np.stack(drawn)[:, 50:]


@pytest.mark.parametrize("level", ["low", "mid", "high"])
def test_white_noise_has_normal_moments_and_no_memory(level):
    drawn = stationary(f"awgn-{level}") / np.array(noise.SIGMA_BY_LEVEL[level])

    # 200 000 values: standard errors are 0.0022 of the mean, 0.0055 and 0.011 of the moments
    flat = drawn.reshape(-1)
    assert abs(flat.mean()) < 0.01
    assert abs(flat.var() - 1.0) < 0.015
    assert abs((flat**3).mean()) < 0.03
    assert abs((flat**4).mean() - 3.0) < 0.08
    for lag in (1, 2, 10):
        assert abs(np.mean(drawn[:, lag:] * drawn[:, :-lag])) < 0.012


@pytest.mark.parametrize("level", ["low", "mid", "high"])
def test_correlated_noise_has_the_variance_and_the_memory_of_theory(level):
    drawn = stationary(f"ou-{level}") / np.array(noise.SIGMA_BY_LEVEL[level])

    variance = drawn.var()
    assert variance == pytest.approx(1.0 / 3.6, rel=0.03)
    for lag in (1, 2, 5, 10):
        correlation = np.mean(drawn[:, lag:] * drawn[:, :-lag]) / variance
        assert correlation == pytest.approx(0.8**lag, abs=0.02), lag
    assert abs(drawn.mean()) < 0.02
    assert (drawn**4).mean() / variance**2 == pytest.approx(3.0, abs=0.2)


def test_correlated_noise_starts_at_zero_and_grows_to_its_variance():
    drawn = np.stack([sampled("ou-high", token=f"s{i}", num_steps=30)[:, 0] for i in range(4000)])

    # variance after k updates of x <- 0.8 x + sqrt(0.1) sigma eps
    theory = 1.5**2 * 0.1 * (1.0 - 0.64 ** np.arange(1, 31)) / 0.36
    np.testing.assert_allclose(drawn.var(axis=0), theory, rtol=0.12)


@pytest.mark.parametrize("name", ["awgn-mid", "ou-mid"])
def test_scenarios_seeds_and_channels_are_independent(name):
    keys = [(seed, f"token-{i}") for seed in range(3) for i in range(20)]
    drawn = [sampled(name, seed=seed, token=token, num_steps=4000) for seed, token in keys]
    correlations = np.corrcoef(np.concatenate([values.T for values in drawn]))

    # 120 streams; the memory of ou makes 4000 steps worth about 900 independent ones
    worst = np.abs(correlations - np.eye(len(correlations))).max()
    assert worst < (0.09 if name.startswith("awgn") else 0.19)
    # no pair is related at a shift either, as two parts of one stream would be
    first, second = drawn[0][:, 0], drawn[1][:, 0]
    for shift in (1, 150, 1000):
        assert abs(np.corrcoef(first[shift:], second[:-shift])[0, 1]) < 0.15


def test_neighbouring_seeds_and_similar_tokens_share_no_numbers():
    streams = [
        noise.keyed_generator(seed, token, channel).integers(0, 2**63, 200)
        for seed in (0, 1, 2)
        for token in ("a", "a1", "1a", "b")
        for channel in noise.CHANNELS
    ]
    everything = np.concatenate(streams)
    assert len(np.unique(everything)) == len(everything)
