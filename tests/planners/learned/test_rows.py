"""Products and attention do not depend on how many rows or scenes there are."""

import pytest

torch = pytest.importorskip("torch")

from shiftsim.planners.learned.network.rows import (  # noqa: E402  # needs torch
    Attention,
    Linear,
    linear,
    make_scenes,
)

pytestmark = pytest.mark.learned
ROUNDING = 1e-5


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)
    with torch.inference_mode():
        yield


@pytest.mark.parametrize("outputs", [1, 2, 7])
@pytest.mark.parametrize("bias", [True, False])
def test_few_rows_and_columns_are_those_of_a_large_product(outputs, bias):
    layer = Linear(12, outputs, bias=bias)
    x = torch.randn(40, 12)
    whole = torch.nn.functional.linear(x, layer.weight, layer.bias)
    for count in (0, 1, 2, 3, 4, 40):
        part = layer(x[:count])
        assert part.shape == (count, outputs)
        torch.testing.assert_close(part, whole[:count], rtol=0.0, atol=ROUNDING)


def test_leading_dimensions_are_kept():
    x, weight = torch.randn(2, 3, 5).transpose(0, 1), torch.randn(4, 5)
    torch.testing.assert_close(linear(x, weight), x @ weight.T)


def official(layer, query, context, keep):
    """Torch's own module with the same weights, for one scene."""
    other = torch.nn.MultiheadAttention(8, layer.num_heads, batch_first=True)
    other.load_state_dict(layer.state_dict())
    return other(query[None], context[None], context[None], key_padding_mask=~keep[None])[0][0]


def test_attention_stays_within_its_scene():
    layer = Attention(8, 2)
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter)
    asking, counts = [2, 0, 1, 3], [4, 2, 1, 5]
    query, context = torch.randn(sum(asking), 8), torch.randn(sum(counts), 8)
    keep = torch.tensor([1, 0, 1, 1, 1, 0, 1, 0, 1, 1, 0, 1], dtype=torch.bool)
    out = layer.among(query, context, asking, make_scenes(counts, keep))
    parts = zip(query.split(asking), context.split(counts), keep.split(counts), strict=True)
    expected = torch.cat([official(layer, *part) for part in parts])
    torch.testing.assert_close(out, expected, rtol=0.0, atol=ROUNDING)


def test_attention_of_scenes_of_one_size_is_that_of_torch():
    layer = Attention(8, 2)
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter)
    query, context = torch.randn(3, 2, 8), torch.randn(3, 4, 8)
    out = layer(query, context, context.clone())
    same = layer(query, context, context)
    for row in range(3):
        expected = official(layer, query[row], context[row], torch.ones(4, dtype=torch.bool))
        torch.testing.assert_close(out[row], expected, rtol=0.0, atol=ROUNDING)
        torch.testing.assert_close(same[row], expected, rtol=0.0, atol=ROUNDING)
