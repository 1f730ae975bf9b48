"""The fitting side of NeuBRDF: evaluation against float64, gradients, quantisation, storage."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat import models  # noqa: E402
from warp_neumat.io.brdf import open_brdf  # noqa: E402
from warp_neumat.models import codebook as vq  # noqa: E402
from warp_neumat.models import neubrdf  # noqa: E402
from warp_neumat.reference import healpix  # noqa: E402
from warp_neumat.reference.neubrdf import reference_eval  # noqa: E402
from warp_neumat.training.losses import LogCosine  # noqa: E402
from warp_neumat.training.samplers import BRDFSampler  # noqa: E402


def directions(rng, count):
    d = rng.normal(size=(count, 3))
    d[:, 2] = np.abs(d[:, 2])
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def random_model(frame, rng, **options):
    model = neubrdf.build(neubrdf.NeuBRDFConfig(frame=frame, **options), seed=3)
    with torch.no_grad():
        model.codebook.copy_(torch.randn(model.codebook.shape, generator=torch.Generator().manual_seed(1)))
        model.indices.copy_(torch.from_numpy(rng.integers(0, len(model.codebook), len(model.indices))))
        model.quantised.fill_(True)
        model.layers[-1].weight.mul_(10)
    return model


@pytest.mark.parametrize("frame", ["absolute", "isotropic"])
@pytest.mark.parametrize(
    "shape", [{"nside": 4, "bits": 5}, {"nside": 32}, {"nside": 6, "features": 8, "hidden": (32, 16)}]
)
def test_forward_matches_float64(rng, frame, shape):
    model = random_model(frame, rng, **shape)
    tensors, header = model.to_asset()
    stored = neubrdf.from_asset(tensors, header["config"])
    wi, wo = directions(rng, 3000), directions(rng, 3000)
    wo[:5] = [0, 0, 1]
    wi[5:9, 2] *= -1
    wo[9:12, 2] *= -1
    expected = reference_eval(tensors, header["config"], wi, wo)
    got = stored.evaluate(wi, wo)
    assert (got[5:12] == 0).all()
    assert expected.max() > 1
    # Worst of 10⁵ pairs 3.2e-5 at nside 32, a random table being rough: weights are exact to about 3e-7 nside. x 3.
    assert (np.abs(got - expected) / (1 + expected)).max() < 1e-4


def test_isotropic_frame_ignores_rotation_and_mirroring(rng):
    model = random_model("isotropic", rng, nside=8)
    wi, wo = directions(rng, 500), directions(rng, 500)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
    value = model.evaluate(wi, wo)
    np.testing.assert_allclose(model.evaluate(wi @ turn, wo @ turn), value, rtol=1e-3, atol=1e-3)
    mirror = np.float32([1, -1, 1])
    np.testing.assert_allclose(model.evaluate(wi * mirror, wo * mirror), value, rtol=1e-3, atol=1e-3)


def test_grid_points_are_the_corners(rng):
    for nside in (1, 3, 8):
        ours = neubrdf.grid_points(nside)
        assert len(ours) == healpix.hemisphere_point_count(nside)
        np.testing.assert_allclose(ours, healpix.corner_directions(nside)[: len(ours)], atol=1e-12)


def test_colours_differ_within_nearly_every_pixel(rng):
    colour = neubrdf.colours(16).numpy()
    corner, _ = healpix.corners(16, directions(rng, 20000))
    same = np.array([len(set(c)) < 4 for c in colour[corner]])
    # Pixels on the four seams and on the rings at |z| = 2/3: 4 seams of 16 rings and 2 rings of 64 in 1536, not more.
    assert same.mean() < 0.12
    assert len(np.unique(colour)) == 4


def prepared(model, source, rng, count=2048):
    samples = BRDFSampler(source, rng).draw(count)
    samples = {name: torch.from_numpy(value) for name, value in samples.items()}
    return {**model.prepare(samples), **LogCosine().target(samples)}


@pytest.mark.parametrize("stage", ["features", "codebook", "round"])
def test_every_trainable_tensor_gets_a_gradient(rng, stage):
    source, loss = open_brdf("analytic:ggx?roughness=0.5&f0=0.9"), LogCosine()
    model = neubrdf.build(neubrdf.configure(source, {"nside": 4, "bits": 4}), seed=0)
    batch = prepared(model, source, rng)
    if stage != "features":
        model.begin("codebook", [batch], loss, torch.Generator().manual_seed(0))
    model.enter(stage)
    loss(model.predict(batch), batch).backward()
    for parameter in model.trainable(stage):
        assert parameter.grad is not None
        assert torch.isfinite(parameter.grad).all()
        assert parameter.grad.abs().max() > 0


def test_metric_and_gradient_match_autograd(rng):
    source, loss = open_brdf("analytic:ggx?roughness=0.5&f0=0.9"), LogCosine()
    model = neubrdf.build(neubrdf.configure(source, {"nside": 2, "features": 4, "bits": 3}), seed=0)
    batches = [prepared(model, source, rng, 64), prepared(model, source, rng, 32)]
    total = sum((0.5 * loss.residual(model.predict(b), b) ** 2).sum() for b in batches)
    expected = torch.autograd.grad(total, model.table)[0]
    gradient, error = model.gradient(batches, loss)
    torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-5)
    # Every sample touches up to four points of each grid, fewer where it lies on a line between two.
    total = 2.0 * float(total.detach())
    assert 4.0 * total < float(error.sum()) < 8.001 * total

    def residuals(table):
        bag = torch.nn.functional.embedding_bag
        rows = []
        for b in batches:
            psi = bag(b["corner"].view(-1, 4), table, mode="sum", per_sample_weights=b["weight"].view(-1, 4))
            rows.append(loss.residual(torch.expm1(model.decode(psi.view(-1, 8))), b))
        return torch.cat(rows).flatten()

    jacobian = torch.autograd.functional.jacobian(residuals, model.table.detach())  # (r, n, k)
    expected = torch.einsum("rni,rnj->nij", jacobian, jacobian)
    torch.testing.assert_close(model.metric(batches, loss), expected, rtol=1e-3, atol=1e-4)


def test_reassignment_lowers_the_error(rng):
    source, loss = open_brdf("analytic:ggx?roughness=0.4&f0=0.9,0.5,0.2"), LogCosine()
    model = neubrdf.build(neubrdf.configure(source, {"nside": 8, "bits": 6}), seed=0)
    batches = [prepared(model, source, rng, 8192)]
    optimiser = torch.optim.Adam(model.trainable("features"), lr=5e-3)
    for _ in range(60):
        optimiser.zero_grad()
        loss(model.predict(batches[0]), batches[0]).backward()
        optimiser.step()
    model.begin("codebook", batches, loss, torch.Generator().manual_seed(0))

    def error():
        return float((loss.residual(model.predict(batches[0]).detach(), batches[0]) ** 2).mean())

    before = error()
    model.event("codebook", batches, loss)
    assert error() < 0.95 * before
    assert model.statistics()["codebook_used"] > 48


def test_codebook_of_separate_clusters_is_exact(rng):
    centres = torch.randn(6, 4, generator=torch.Generator().manual_seed(0)) * 10
    member = torch.from_numpy(rng.integers(0, 6, 300))
    root = torch.from_numpy(rng.normal(size=(300, 4, 4)).astype(np.float32))
    words, index = vq.fit(centres[member], root @ root.transpose(1, 2), 6, torch.Generator().manual_seed(1))
    torch.testing.assert_close(words[index], centres[member], rtol=1e-3, atol=1e-2)


def test_codebook_ignores_what_the_metric_ignores(rng):
    features = torch.from_numpy(rng.normal(size=(400, 2)).astype(np.float32))
    metric = torch.zeros(400, 2, 2)
    metric[:, 0, 0] = 1.0  # the second coordinate does not matter
    words, index = vq.fit(features, metric, 16, torch.Generator().manual_seed(0))
    assert (words[index] - features)[:, 0].abs().mean() < 0.1
    metric[200:] = 0.0
    assert (vq.fit(features, metric, 16, torch.Generator().manual_seed(0))[1][200:] == 0).all()


def test_asset_layout(rng):
    tensors, header = random_model("absolute", rng, nside=8).to_asset()
    points = 6 * 64 + 48 + 1
    assert {name: (value.dtype.name, value.shape) for name, value in tensors.items()} == {
        "codebook": ("float16", (512, 16)),
        "indices": ("uint8", (-(-2 * points * 9 // 8),)),
        "weight0": ("float16", (64, 32)),
        "bias0": ("float16", (64,)),
        "weight1": ("float16", (64, 64)),
        "bias1": ("float16", (64,)),
        "weight2": ("float16", (3, 64)),
        "bias2": ("float16", (3,)),
    }
    assert header["kind"] == "neubrdf"
    assert header["config"]["hidden"] == [64, 64]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"nsides": 4}, "no option 'nsides'; nearest: nside"),
        ({"nside": 0}, r"nside must be a whole number in \[1, 512\]"),
        ({"bits": 17}, "bits must be"),
        ({"hidden": (64,)}, "hidden must be two multiples of 8"),
        ({"frame": "iso"}, "frame must be one of absolute, isotropic"),
    ],
)
def test_wrong_options_are_explained(options, message):
    with pytest.raises(ValueError, match=message):
        neubrdf.configure(open_brdf("analytic:lambert"), options)


def test_frame_follows_the_source():
    assert neubrdf.configure(open_brdf("analytic:ggx"), {}).frame == "isotropic"
    assert neubrdf.configure(open_brdf("analytic:ggx?anisotropy=0.5"), {}).frame == "absolute"


def test_registry_names_the_nearest():
    assert models.find("neubrdf") is neubrdf
    with pytest.raises(ValueError, match="no model 'nubrdf'; nearest: neubrdf"):
        models.find("nubrdf")
