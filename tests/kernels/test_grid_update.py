"""Adam over grids in one pass: against torch.optim.Adam in float64, and its rounding against what a file stores."""

import numpy as np
import pytest
import torch

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.grid_update import BLOCK, STRIP, block_table
from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.models.ntbc import level_views, quantise, quantiser, rounded_grid
from warp_neumat.ops.grid_update import GridAdam

# Levels of less than a register, of less than a strip, and of odd lengths around strips and blocks.
SHAPE = NetworkShape(((1, 1), (3, 5), (13, 11), (64, 33), (97, 65)), 3)
BETAS, EPS, RATE = (0.9, 0.99), 1e-15, 0.01


@pytest.fixture(autouse=True)
def own_worker_count():
    yield
    dispatch.set_worker_count(None)


def sparse(words: int, parts: int, generator, share: float = 0.1) -> torch.Tensor:
    """Parts of a gradient of many magnitudes: whole stretches without any, single words, and all of it in some."""
    size = 10.0 ** (6.0 * torch.rand(words, generator=generator) - 7.0)
    wide = torch.rand(words // 500 + 1, generator=generator).repeat_interleave(500)[:words] < 0.5
    single = torch.rand((parts, words), generator=generator) < share
    return torch.randn((parts, words), generator=generator) * size * wide * single


def values_of(words: int, generator) -> torch.Tensor:
    return 0.1 * torch.randn(words, generator=generator) - 0.02


def bits(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.contiguous().view(torch.int32)


@pytest.mark.parametrize("lazy", [True, False])
@pytest.mark.parametrize("parts", [1, 3])
def test_step_matches_adam(lazy, parts):
    """Where it is lazy, words without gradient are put back to what they were before torch's step."""
    generator = torch.Generator().manual_seed(parts)
    values, gradients = values_of(SHAPE.grid_words, generator), torch.zeros(parts, SHAPE.grid_words)
    adam = GridAdam(values, gradients, offsets=SHAPE.grid_offsets, betas=BETAS, eps=EPS, lazy=lazy)
    twin = values.double().requires_grad_()
    plain = torch.optim.Adam([twin], betas=BETAS, eps=EPS)
    start, moved = twin.detach().clone(), 0
    for number in range(1, 31):
        rate = RATE * (1.0 - number / 40)
        gradients.copy_(sparse(SHAPE.grid_words, parts, generator))
        twin.grad = gradients.double().sum(0)
        for group in plain.param_groups:
            group["lr"] = rate
        state = plain.state[twin]
        old = [t.clone() for t in (twin.detach(), *(state.get(k, 0 * start) for k in ("exp_avg", "exp_avg_sq")))]
        plain.step()
        if lazy:
            still = twin.grad == 0
            moved += int((~still).sum())
            for tensor, before in zip((twin.data, state["exp_avg"], state["exp_avg_sq"]), old, strict=True):
                tensor[still] = before[still]
        adam.step(rate, number)
        assert not gradients.any()
        assert torch.equal(bits(adam.used), bits(values))
    assert not lazy or 0.02 < moved / 30 / SHAPE.grid_words < 0.3
    assert (twin.detach() - start).abs().max() > 2 * RATE
    # Worst seen: values 1.3e-7, moments 3e-7 and 7e-7 relative; values are float32 of up to 0.5, added to 30 times.
    np.testing.assert_allclose(values, twin.detach(), rtol=0, atol=4e-7)
    np.testing.assert_allclose(adam.first, state["exp_avg"], rtol=2e-6, atol=1e-9)
    np.testing.assert_allclose(adam.second, state["exp_avg_sq"], rtol=4e-6, atol=1e-30)


def test_lazy_leaves_words_without_gradient_alone():
    generator = torch.Generator().manual_seed(5)
    runs = {}
    for lazy in (True, False):
        values, gradients = torch.zeros(3 * BLOCK + 5), torch.ones(2, 3 * BLOCK + 5)
        adam = GridAdam(values, gradients, lazy=lazy)
        adam.step(RATE, 1)
        before = [t.clone() for t in (values, adam.first, adam.second)]
        some = torch.randperm(values.numel(), generator=generator)[:20]
        gradients[1, some] = 1.0
        adam.step(RATE, 2)
        same = [a == b for a, b in zip(before, (values, adam.first, adam.second), strict=True)]
        runs[lazy] = [s.sum().item() for s in same]
        assert not torch.stack(same)[:, some].any()
    assert runs == {True: [values.numel() - 20] * 3, False: [0, 0, 0]}


def test_gradients_that_cancel_are_no_gradient():
    values, gradients = torch.ones(100), torch.zeros(2, 100)
    gradients[0, 7], gradients[1, 7] = 0.5, -0.5
    adam = GridAdam(values, gradients)
    adam.step(RATE, 1)
    assert torch.equal(values, torch.ones(100))
    assert not gradients.any()
    assert not adam.second.any()


@pytest.mark.parametrize("number_of_bits", [2, 4, 8])
def test_rounding_is_that_of_the_asset(number_of_bits):
    """Bit for bit, in every step, and after turns without rounding; a step may reach one level, or nothing at all."""
    generator = torch.Generator().manual_seed(number_of_bits)
    values, gradients = values_of(SHAPE.grid_words, generator), torch.zeros(2, SHAPE.grid_words)
    at = SHAPE.grid_offsets
    values[at[1] : at[2]] += 1.0  # a level all above 0
    values[at[2] : at[3]] = 0.0
    adam = GridAdam(values, gradients, offsets=at, bits=number_of_bits)
    expected, seen = torch.empty_like(values), set()
    for number in range(1, 25):
        rounded = number not in (1, 9, 10)
        if number % 5:
            level = number % 3 + 2
            stretch = slice(at[level], at[level + 1] if level < 4 else None)
            gradients[:, stretch] = sparse(gradients[:, stretch].shape[1], 2, generator, 0.02)
        if number % 4 == 0:  # one word of one block widens the range of its level's four, or narrows it
            gradients[0, at[4] + values[at[4] :].argmax()] = -1.0 if number % 8 else 1.0
        adam.step(RATE, number, rounded)
        if not rounded:
            assert torch.equal(bits(adam.used), bits(values))
            continue
        rounded_grid(SHAPE, values, number_of_bits, expected)
        assert torch.equal(bits(adam.used), bits(expected))
        for n, level in enumerate(level_views(SHAPE, values)):
            scale, zero = quantiser(level, number_of_bits)
            assert (adam.scales[n].item(), adam.zeros[n].item()) == (scale, zero)
            codes = quantise(level, scale, zero, number_of_bits).numpy().astype(np.uint8)
            stored = (codes.astype(np.float32) - np.float32(zero)) * np.float32(scale)
            assert torch.equal(bits(level_views(SHAPE, adam.used)[n]), bits(torch.from_numpy(stored)))
        seen.add(tuple(adam.scales.tolist()))
    assert len({scales[4] for scales in seen}) > 4
    assert len({scales[1] for scales in seen}) == 1


def test_ties_are_rounded_to_even():
    values = torch.cat([torch.arange(0, 255.0, 0.5), torch.tensor([255.0])])
    adam = GridAdam(values, torch.zeros(1, values.numel()), bits=8)
    adam.refresh(True)
    assert adam.scales.item() == 1.0
    assert torch.equal(adam.used, values.round())
    assert adam.used[[1, 3]].tolist() == [0.0, 2.0]


def test_half_matches_torch():
    """Packed weights: all magnitudes that float16 holds, ties, and those beyond it."""
    generator = torch.Generator().manual_seed(1)
    words = 20003
    values = torch.randn(words, generator=generator) * 2.0 ** (30.0 * torch.rand(words, generator=generator) - 26.0)
    special = [0.0, -0.0, 65504.0, 65519.9, 65520.0, -1e9, 2.0**-24, 2.0**-25, 3 * 2.0**-25, 6.1e-5, 2.0**-14]
    special += [float("inf"), -float("inf"), 1.0 + 2.0**-11, 1.0 + 3 * 2.0**-11, 1e-30]
    values[: len(special)] = torch.tensor(special)
    gradients = torch.zeros(2, words)
    adam = GridAdam(values, gradients, bits=None, lazy=False)
    adam.refresh(True)
    assert torch.equal(bits(adam.used), bits(values.half().float()))
    gradients.normal_(generator=generator)
    adam.step(RATE, 1, True)
    assert torch.equal(bits(adam.used), bits(values.half().float()))
    adam.step(RATE, 2)
    assert torch.equal(bits(adam.used), bits(values))


def test_workers_do_not_change_the_result():
    found = []
    for workers in (1, 2):
        dispatch.set_worker_count(workers)
        generator = torch.Generator().manual_seed(3)
        words = 70 * BLOCK + 17
        values, gradients = values_of(words, generator), torch.zeros(2, words)
        adam = GridAdam(values, gradients, offsets=(0, 1000, 5 * BLOCK + 1))
        for number in range(1, 5):
            gradients.copy_(sparse(words, 2, generator))
            adam.step(RATE, number, number > 2)
        found.append((values, adam.first, adam.second, adam.used, adam.scales, adam.zeros))
    for one, two in zip(*found, strict=True):
        assert torch.equal(bits(one), bits(two))


def test_a_run_goes_on_from_a_checkpoint():
    """Values and moments, copied into another, are all its state once it is refreshed."""
    generator = torch.Generator().manual_seed(4)
    runs = []
    for _ in range(2):
        values, gradients = values_of(SHAPE.grid_words, generator), torch.zeros(2, SHAPE.grid_words)
        runs.append(GridAdam(values, gradients, offsets=SHAPE.grid_offsets))
    one, two = runs
    drawn = [sparse(SHAPE.grid_words, 2, generator) for _ in range(6)]
    for number, gradient in enumerate(drawn, 1):
        one.gradients.copy_(gradient)
        one.step(RATE, number, True)
        if number == 3:
            for name in ("values", "first", "second"):
                getattr(two, name).copy_(getattr(one, name))
            two.refresh(True)
            assert torch.equal(bits(one.used), bits(two.used))
        if number > 3:
            two.gradients.copy_(gradient)
            two.step(RATE, number, True)
    for name in ("values", "first", "second", "used", "scales", "zeros"):
        assert torch.equal(bits(getattr(one, name)), bits(getattr(two, name))), name


def test_refresh_changes_no_value():
    values, gradients = torch.ones(STRIP + 3), torch.ones(2, STRIP + 3)
    adam = GridAdam(values, gradients, lazy=False)
    adam.refresh()
    assert torch.equal(values, torch.ones(STRIP + 3))
    assert (gradients == 1).all()
    assert not adam.first.any()


def test_blocks_hold_every_word_once():
    offsets = (0, 3, BLOCK + 3, 2 * BLOCK + 4)
    table = block_table(offsets, 5 * BLOCK)
    assert (table[0, 0], table[-1, 1]) == (0, 5 * BLOCK)
    assert (table[1:, 0] == table[:-1, 1]).all()
    assert (np.searchsorted(offsets, table[:, 0], "right") - 1 == table[:, 2]).all()
    assert (np.searchsorted(offsets, table[:, 1] - 1, "right") - 1 == table[:, 2]).all()
    assert (table[:, 1] > table[:, 0]).all()
    assert (table[:, 1] - table[:, 0]).max() == BLOCK


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values": torch.zeros(10, dtype=torch.float64)}, r"values must be contiguous float32 of shape \(words,\)"),
        ({"values": torch.zeros(0)}, "values must have 1 to"),
        ({"gradients": torch.zeros(2, 9)}, r"gradients must be contiguous float32 of shape \(parts, 10\), got"),
        ({"gradients": torch.zeros(0, 10)}, "gradients must have at least 1 part"),
        ({"gradients": torch.zeros(10, 2).T}, "gradients must be contiguous"),
        ({"offsets": (0, 5, 5)}, r"offsets must rise from 0 to below 10, got \(0, 5, 5\)"),
        ({"offsets": (1,)}, "offsets must rise"),
        ({"offsets": ()}, "offsets must rise"),
        ({"offsets": (0, 10)}, "offsets must rise"),
        ({"bits": 17}, "bits must be 1 to 16, or None for float16, got 17"),
        ({"betas": (0.9, 1.0)}, r"betas must be in \[0, 1\)"),
        ({"eps": 0.0}, "eps must be above 0"),
    ],
)
def test_wrong_arguments_are_explained(change, message):
    arguments = {"values": torch.zeros(10), "gradients": torch.zeros(2, 10)} | change
    with pytest.raises(ValueError, match=message):
        GridAdam(arguments.pop("values"), arguments.pop("gradients"), **arguments)


def test_a_wrong_step_number_is_explained():
    adam = GridAdam(torch.zeros(10), torch.zeros(2, 10))
    with pytest.raises(ValueError, match="number must be at least 1, got 0"):
        adam.step(RATE, 0)
