"""BTF models: what may be configured, the paper's sizes, and files that hold what was trained."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.kernels.test_btf import directions  # noqa: E402
from warp_neumat.materials.btf import BTF as Material  # noqa: E402
from warp_neumat.models import btf, find  # noqa: E402
from warp_neumat.models.btf_config import VARIANTS, configure, from_header  # noqa: E402
from warp_neumat.training.btf import quad_places  # noqa: E402


class Size:
    """What a config asks of a source."""

    width, height = 13, 10


def made(scale=0.04, **options):
    """Return a model with random weights, and features large enough to matter."""
    model = btf.build(configure(Size, options), 3, scale)
    with torch.no_grad():
        model.texels.mul_(5.0)
    return model


def samples(model, rng, quads=257):
    place = rng.random((quads, 4)).astype(np.float32)
    place[:, 3] = rng.integers(0, model.config.mips, quads)
    return directions(rng, quads), directions(rng, quads), place


def predicted(model, wi, wo, place):
    """Return value × cos θ_i [1/sr] as the run time gives it, (n, 4, 3)."""
    seen = model.angles(torch.from_numpy(wi), torch.from_numpy(wo))
    y = model.predict(seen, torch.from_numpy(place)) * model.scale
    return y.clamp_min(0.0).numpy().reshape(-1, 4, 3)


# --- sizes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("variant", "weights", "stored"),
    [("coarse-to-fine", 779, 667), ("single-level", 779, 603), ("neumip", 3278, 3278)],
)
def test_weights_are_those_of_the_paper(variant, weights, stored):
    """In training; what is stored has no more features than its first layers have units."""
    model = made(variant=variant)
    assert model.weights == weights
    tensors, header = model.to_asset()
    assert header["config"]["fine"]["channels"] == (14 if variant == "neumip" else 8)
    assert stored == sum(t.size for name, t in tensors.items() if ".weight" in name or ".bias" in name)
    if variant == "neumip":
        assert 2 * weights == 6556  # the paper's 6.6 KB
        assert weights / made().weights == pytest.approx(4.2, abs=0.01)


def test_layers_are_those_of_the_paper():
    shapes = [tuple(weight.shape) for weight, _ in made().layers()]
    assert shapes == [(8, 23), (8, 8), (8, 8), (8, 8), (8, 24), (8, 8), (8, 8), (3, 8)]
    shapes = [tuple(weight.shape) for weight, _ in made(variant="teacher").layers()]
    assert shapes == [(128, 25), *[(128, 128)] * 3, (3, 128)]


def test_mips_halve_and_the_coarse_texture_is_half_of_the_fine_one():
    model = made()
    assert [m.shape for m in model.mips()] == [
        (10, 13, 16), (5, 6, 16), (2, 3, 16), (5, 6, 14), (2, 3, 14), (1, 1, 14),
    ]  # fmt: skip
    assert [m.shape for m in made(mips=1, variant="neumip").mips()] == [(10, 13, 14)]


# --- files ------------------------------------------------------------------------------------------------------------

SHAPES = [
    {},
    {"activation": "relu", "half_vector": False},
    {"variant": "single-level"},
    {"variant": "neumip", "mips": 1},
]


@pytest.mark.parametrize("options", SHAPES)
def test_a_file_is_what_was_trained(rng, options):
    model = made(**options)
    wi, wo, place = samples(model, rng)
    tensors, header = model.to_asset()
    material = Material(tensors, {**header, "source": {}})
    uv, level = quad_places(Size, place)
    stored = material.eval_quads(uv, wi, wo, level)
    assert stored.std() > 1e-4
    trained = predicted(model, wi, wo, place)
    assert 0 < np.abs(stored - trained).max() < 2e-3 * trained.max()  # float16
    again = btf.from_asset(tensors, header["config"])
    rounded = predicted(again, wi, wo, place)
    assert np.abs(stored - rounded).max() < 1e-5 * stored.max()
    assert material.weights == again.weights <= model.weights
    twice, second = again.to_asset()
    assert second["config"] == header["config"]
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(twice[name], tensor, err_msg=name)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_config_of_a_file_says_all_that_a_model_is(variant):
    config = configure(Size, {"variant": variant})
    again = from_header(config.asset())
    assert again.asset() == config.asset()
    model, found = btf.build(config, 0), btf.build(again, 0)
    assert found.shape == model.shape
    assert found.levels == model.levels


def test_the_same_seed_gives_the_same_model():
    assert torch.equal(made().net, made().net)
    assert not torch.equal(made().net, btf.build(configure(Size, {}), 4).net)


# --- inputs -----------------------------------------------------------------------------------------------------------


def test_the_half_vector_of_opposite_directions_is_up():
    wi = torch.tensor([[0.6, 0.0, 0.8], [1.0, 0.0, 0.0]])
    wo = torch.tensor([[-0.6, 0.0, 0.8], [-1.0, 0.0, 0.0]])
    angles = made().angles(wi, wo)
    assert torch.equal(angles[:, :6], torch.cat([wi, wo], 1))
    torch.testing.assert_close(angles[:, 6:], torch.tensor([[0.0, 0.0, 1.0]] * 2))
    assert made(half_vector=False).angles(wi, wo).shape == (2, 6)


def test_a_teacher_adds_what_it_knows(rng):
    teacher = made(variant="teacher", hidden=(32, 32), scale=0.08)
    model = btf.build(configure(Size, {}), 0, 0.04, teacher)
    wi, wo, place = samples(model, rng, 64)
    value = rng.random((64, 12)).astype(np.float32)
    batch = model.prepare(
        {k: torch.from_numpy(v) for k, v in (("wi", wi), ("wo", wo), ("place", place), ("value", value))}
    )
    torch.testing.assert_close(batch["target"], torch.from_numpy(value / 0.04))
    known = teacher.predict(teacher.angles(torch.from_numpy(wi), torch.from_numpy(wo)), torch.from_numpy(place))
    torch.testing.assert_close(batch["teacher"], 2.0 * known)  # in the student's unit
    assert {name for name, _ in model.named_parameters()} == {"texels", "net", "map1", "map2"}
    assert not any(name.startswith("_teacher") for name in model.state_dict())


# --- mistakes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chanels": 8}, "btf has no option 'chanels'; nearest: channels"),
        ({"variant": "neumipp"}, "variant must be one of coarse-to-fine, .*got 'neumipp'"),
        ({"hidden": (8, 0)}, "hidden must be 1 to 8 widths from 1 to 256"),
        ({"hidden": ()}, "hidden must be 1 to 8 widths"),
        ({"hidden": (8.0,)}, "hidden must be 1 to 8 widths"),
        ({"coarse": ()}, "coarse widths and coarse_channels go together"),
        ({"coarse_channels": 0}, "coarse widths and coarse_channels go together.*variant=single-level has neither"),
        ({"mips": 9}, r"mips must be a whole number in \[0, 4\], got 9"),
        ({"mips": True}, "mips must be a whole number"),
        ({"channels": 65}, r"channels must be a whole number in \[1, 64\]"),
        ({"epochs": 0}, r"epochs must be a whole number in \[1, 1000\]"),
        ({"teacher_steps": -1}, "teacher_steps must be a whole number"),
        ({"sigma": -0.1}, "sigma must be a number of at least 0"),
        ({"lambda1": float("nan")}, "lambda1 must be a number of at least 0"),
        ({"lambda2": True}, "lambda2 must be a number"),
        ({"lr": (1e-4, 1e-3)}, "lr must be the first and the last rate"),
        ({"lr": 0.0}, "lr must be the first and the last rate"),
        ({"schedule": "linear"}, "schedule must be one of cosine, plateau"),
        ({"features": "bc7"}, "features must be one of half, bc6h"),
        ({"half_vector": 1}, "half_vector must be true or false"),
        ({"teacher_hidden": (300,)}, "teacher_hidden must be 1 to 8 widths"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        configure(Size, options)


def test_who_is_taught_by_default():
    assert configure(Size, {}).distilled
    assert configure(Size, {"variant": "single-level"}).distilled
    assert not configure(Size, {"teacher": "none"}).distilled
    assert not configure(Size, {"sigma": 0, "lambda1": 0, "lambda2": 0}).distilled
    assert not configure(Size, {"variant": "neumip"}).distilled
    assert configure(Size, {"variant": "neumip", "teacher": "auto"}).distilled
    assert find("btf") is btf
