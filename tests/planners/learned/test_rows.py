"""Products and attention do not depend on how many rows or scenes there are."""

import pytest

torch = pytest.importorskip("torch")

from shiftsim.planners.learned import network  # noqa: E402
from shiftsim.planners.learned.network import Attention, Linear, Scenes, linear  # noqa: E402

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


def scenes_of(counts, keep):
    """How rows with `keep` lie that are scenes of `counts`, filled up in a batch."""
    valid = torch.zeros(len(counts), max(counts), dtype=torch.bool)
    for row, part in zip(valid, keep.split(counts), strict=True):
        row[: len(part)] = part
    return Scenes([valid], [counts])


def test_rows_that_fill_up_are_left_out_and_come_back():
    scenes = scenes_of([4, 2, 1], torch.ones(7, dtype=torch.bool))
    x = torch.randn(3, 4, 5)
    rows = scenes.pack(x)
    assert torch.equal(rows, torch.cat([x[0], x[1, :2], x[2, :1]]))
    assert torch.equal(scenes.firsts(rows), x[:, 0])
    assert torch.equal(scenes.unpack(rows, 7.0)[1, 2:], torch.full((2, 5), 7.0))


@pytest.mark.parametrize("padded", [False, True])
def test_attention_stays_within_its_scene(monkeypatch, padded):
    monkeypatch.setattr(network, "pads", lambda x: padded)
    layer = Attention(8, 2)
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter)
    asking, counts = [2, 0, 1, 3], [4, 2, 1, 5]
    query, context = torch.randn(sum(asking), 8), torch.randn(sum(counts), 8)
    keep = torch.tensor([1, 0, 1, 1, 1, 0, 1, 0, 1, 1, 0, 1], dtype=torch.bool)
    queries = scenes_of(asking, torch.ones(sum(asking), dtype=torch.bool))
    out = layer.segment_attention(query, context, queries, scenes_of(counts, keep))
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
