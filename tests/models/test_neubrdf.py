"""The fitting side of NeuBRDF: evaluation against float64, gradients, quantisation, storage."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat import models  # noqa: E402
from warp_neumat.io.brdf import open_brdf  # noqa: E402
from warp_neumat.kernels.healpix_tree import directions as grid_directions  # noqa: E402
from warp_neumat.models import codebook as vq  # noqa: E402
from warp_neumat.models import healpix_grid, neubrdf, reassign  # noqa: E402
from warp_neumat.models.local_frame import corner_weights, to_local_frame  # noqa: E402
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
        model.live.fill_(True)
        model.level.fill_(len(model._levels) - 1)
        model.layers(model.net.data)[-1][0].mul_(10)
    return model


@pytest.mark.parametrize("frame", ["absolute", "isotropic", "half", "half-isotropic", "half-light"])
@pytest.mark.parametrize(
    "shape",
    [
        {"nside": 4, "bits": 5, "interpolation": "idw"},
        {"nside": 32},
        {"nside": 6, "features": 8, "hidden": (32, 16, 8)},
    ],
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
        ours = grid_directions(nside)
        assert len(ours) == healpix.hemisphere_point_count(nside)
        np.testing.assert_allclose(ours, healpix.corner_directions(nside)[: len(ours)], atol=1e-12)


def test_colours_differ_within_nearly_every_pixel(rng):
    colour = healpix_grid.colours(16).numpy()
    corner, _ = healpix.corners(16, directions(rng, 20000))
    same = np.array([len(set(c)) < 4 for c in colour[corner]])
    # Pixels on the four seams and on the rings at |z| = 2/3: 4 seams of 16 rings and 2 rings of 64 in 1536, not more.
    assert same.mean() < 0.12
    assert len(np.unique(colour)) == 4


def prepared(model, source, rng, count=2048):
    samples = BRDFSampler(source, rng).draw(count)
    if model.texture is not None:
        samples |= {"uv": rng.random((count, 2), np.float32), "lod": 3 * rng.random(count, np.float32)}
    samples = {name: torch.from_numpy(value) for name, value in samples.items()}
    return {**model.prepare(samples), **LogCosine().target(samples)}


def stage_of(model, kind):
    return next(stage for stage in model.stages() if stage["kind"] == kind)


def begin_codebook(model, batches, loss):
    model.begin(stage_of(model, "codebook"), lambda: iter(batches), loss, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("kind", ["features", "codebook", "round"])
@pytest.mark.parametrize("texture", [None, (4, 2, 3)])
def test_fused_gradients_match_autograd(rng, kind, texture):
    source, loss = open_brdf("analytic:ggx?roughness=0.5&f0=0.9"), LogCosine()
    model = neubrdf.build(neubrdf.configure(source, {"nside": 4, "bits": 4, "texture": texture}), seed=0)
    batch = prepared(model, source, rng)
    if kind != "features":
        begin_codebook(model, [batch], loss)
    model.enter(stage_of(model, kind))
    expected_loss = loss(model.predict(batch), batch)
    parameters = model.trainable(stage_of(model, kind))
    expected = torch.autograd.grad(expected_loss, parameters)
    assert float(model.gradients(batch, loss)) == pytest.approx(float(expected_loss.detach()), rel=1e-4)
    assert len(parameters) == (2 if texture is None else 3)
    for parameter, gradient in zip(parameters, expected, strict=True):
        assert gradient.abs().max() > 0
        # A hidden unit at 0 that rounding switches on moves single entries.
        assert (parameter.grad - gradient).norm() < 1e-3 * gradient.norm()


@pytest.mark.parametrize("kind", ["features", "codebook", "round"])
def test_every_trainable_tensor_gets_a_gradient(rng, kind):
    source, loss = open_brdf("analytic:ggx?roughness=0.5&f0=0.9"), LogCosine()
    model = neubrdf.build(neubrdf.configure(source, {"nside": 4, "bits": 4}), seed=0)
    batch = prepared(model, source, rng)
    stage = stage_of(model, kind)
    if kind != "features":
        begin_codebook(model, [batch], loss)
    model.enter(stage)
    model.gradients(batch, loss)
    for parameter in model.trainable(stage):
        assert parameter.grad is not None
        assert torch.isfinite(parameter.grad).all()
        assert parameter.grad.abs().max() > 0


def test_metric_and_gradient_match_autograd(rng):
    source, loss = open_brdf("analytic:ggx?roughness=0.5&f0=0.9"), LogCosine()
    model = neubrdf.build(
        neubrdf.configure(source, {"nside": 2, "features": 4, "bits": 3, "frame": "isotropic"}), seed=0
    )
    batches = [prepared(model, source, rng, 64), prepared(model, source, rng, 32)]
    total = sum((0.5 * loss.residual(model.predict(b), b) ** 2).sum() for b in batches)
    expected = torch.autograd.grad(total, model.table)[0]
    gradient, error = reassign.gradient(model, batches, loss)
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
    torch.testing.assert_close(reassign.metric(model, batches, loss), expected, rtol=1e-3, atol=1e-4)


def test_reassignment_lowers_the_error(rng):
    source, loss = open_brdf("analytic:ggx?roughness=0.4&f0=0.9,0.5,0.2"), LogCosine()
    shape = neubrdf.configure(source, {"nside": 8, "bits": 6, "frame": "isotropic"})
    model = neubrdf.build(shape, seed=0)
    batches = [prepared(model, source, rng, 8192)]
    optimiser = torch.optim.Adam(model.trainable(model.stages()[0]), lr=5e-3)
    for _ in range(60):
        model.gradients(batches[0], loss)
        optimiser.step()
    begin_codebook(model, batches, loss)

    def error():
        return float((loss.residual(model.predict(batches[0]).detach(), batches[0]) ** 2).mean())

    before = error()
    model.event(stage_of(model, "codebook"), lambda: iter(batches), loss)
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
        ({"hidden": (64, 20)}, "hidden must be 1 to 4 multiples of 8"),
        ({"frame": "iso"}, "frame must be one of absolute, isotropic, half, half-isotropic, half-light"),
        ({"frame": "absolute", "symmetry": "reciprocal"}, "symmetry 'reciprocal' needs frame half"),
        ({"frame": "half", "symmetry": "bilateral"}, "needs frame half-isotropic"),
        ({"reciprocal": True, "symmetry": "none"}, "contradict each other"),
        ({"texture": (4, 4)}, "texture must be WIDTH,HEIGHT,CHANNELS"),
    ],
)
def test_wrong_options_are_explained(options, message):
    with pytest.raises(ValueError, match=message):
        neubrdf.configure(open_brdf("analytic:lambert"), options)


def test_frame_follows_the_source():
    isotropic = neubrdf.configure(open_brdf("analytic:ggx"), {})
    assert (isotropic.frame, isotropic.symmetry, isotropic.nside) == ("half-isotropic", "bilateral", 16)
    anisotropic = neubrdf.configure(open_brdf("analytic:ggx?anisotropy=0.5"), {})
    assert (anisotropic.frame, anisotropic.symmetry, anisotropic.nside) == ("half", "reciprocal", 64)
    assert neubrdf.configure(open_brdf("analytic:ggx"), {"reciprocal": True}).symmetry == "bilateral"


def test_registry_names_the_nearest():
    assert models.find("neubrdf") is neubrdf
    with pytest.raises(ValueError, match="no model 'nubrdf'; nearest: neubrdf"):
        models.find("nubrdf")


@pytest.mark.parametrize("interpolation", ["bilinear", "idw", "uniform"])
def test_corner_weights_are_means(rng, interpolation):
    direction = torch.from_numpy(directions(rng, 500))
    corner, weight = corner_weights(8, direction, interpolation)
    torch.testing.assert_close(weight.sum(1), torch.ones(500))
    points = grid_directions(8)
    if interpolation == "idw":
        distance = np.arccos(
            np.clip(np.einsum("btc,bc->bt", points[corner.numpy()], direction.double().numpy()), -1, 1)
        )
        expected = 1 / np.maximum(distance, 1e-6)
        np.testing.assert_allclose(weight.numpy(), expected / expected.sum(1, keepdims=True), atol=2e-3)
        at_corner = corner_weights(8, torch.from_numpy(points[40:41].astype(np.float32)), "idw")
        assert at_corner[1].max() > 0.999


@pytest.mark.parametrize(("frame", "symmetry"), [("half", "reciprocal"), ("half-isotropic", "bilateral")])
def test_half_frames_fold_what_is_symmetric(rng, frame, symmetry):
    wi, wo = (torch.from_numpy(directions(rng, 300)) for _ in range(2))
    there, back = to_local_frame(wi, wo, frame, symmetry), to_local_frame(wo, wi, frame, symmetry)
    for a, b in zip(there, back, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=2e-6)
        torch.testing.assert_close(a.norm(dim=1), torch.ones(300), rtol=0, atol=2e-6)
    if symmetry == "bilateral":
        mirror = torch.tensor([1.0, -1.0, 1.0])
        for a, b in zip(there, to_local_frame(wi * mirror, wo * mirror, frame, symmetry), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=2e-6)


def test_refined_features_show_what_the_coarse_ones_showed(rng):
    coarse = torch.from_numpy(rng.normal(size=(healpix.hemisphere_point_count(4), 3)).astype(np.float32))
    fine = healpix_grid.refine(coarse, 4)
    assert fine.shape == (healpix.hemisphere_point_count(8), 3)
    inside = grid_directions(4)[:, 2] >= 0
    corner, weight = corner_weights(8, torch.from_numpy(grid_directions(4)[inside].astype(np.float32)))
    torch.testing.assert_close((fine[corner.long()] * weight[..., None]).sum(1), coarse[inside], rtol=0, atol=1e-4)


def test_probe_equals_the_torch_gradient(rng):
    source, loss = open_brdf("analytic:ggx?roughness=0.4&f0=0.9"), LogCosine()
    model = neubrdf.build(neubrdf.configure(source, {"nside": 4, "bits": 4}), seed=0)
    batches = [prepared(model, source, rng, 1024) for _ in range(2)]
    begin_codebook(model, batches, loss)
    expected_pull, expected_error = reassign.gradient(model, batches, loss)
    pull, error = reassign.Probe(model, batches, loss)()
    assert (pull - expected_pull).norm() < 1e-3 * expected_pull.norm()
    torch.testing.assert_close(error, expected_error, rtol=1e-3, atol=1e-4)


def test_several_materials_share_primitives_and_keep_their_own_grids(rng):
    model = neubrdf.build(neubrdf.NeuBRDFConfig(nside=4, bits=5, frame="half-isotropic"), seed=0, count=2)
    points = 2 * model.config.points
    assert len(model.indices) == 2 * points
    with torch.no_grad():
        model.codebook.copy_(torch.randn(model.codebook.shape, generator=torch.Generator().manual_seed(1)))
        model.indices.copy_(torch.from_numpy(rng.integers(0, 32, 2 * points)))
        model.live.fill_(True)
        model.quantised.fill_(True)
    wi, wo = directions(rng, 200), directions(rng, 200)
    for number in range(2):
        tensors, header = model.to_asset(number)
        alone = neubrdf.from_asset(tensors, header["config"])
        model.rounded = True
        np.testing.assert_allclose(
            model.evaluate(wi, wo, material=number), alone.evaluate(wi, wo), rtol=1e-4, atol=1e-5
        )
    assert not np.array_equal(model.evaluate(wi, wo, material=0), model.evaluate(wi, wo, material=1))


def test_texture_taps_are_the_trilinear_look_up(rng):
    from warp_neumat.models.neural_texture import NeuralTexture

    texture = NeuralTexture(5, 4, 2, generator=torch.Generator().manual_seed(0))
    assert texture.sizes == [(5, 4), (2, 2), (1, 1)]
    centres = torch.tensor([[(i + 0.5) / 5, (j + 0.5) / 4] for j in range(4) for i in range(5)])
    row, weight = texture.taps(centres, torch.zeros(20))
    value = (texture.texels[row.long()] * weight[..., None]).sum(1)
    torch.testing.assert_close(value, texture.texels[:20], rtol=0, atol=1e-6)
    row, weight = texture.taps(torch.rand(50, 2) * 6 - 3, torch.rand(50) * 9 - 2)
    torch.testing.assert_close(weight.sum(1), torch.ones(50))
    assert 0 <= int(row.min()) <= int(row.max()) < len(texture.texels)
    last = texture.taps(torch.rand(9, 2), torch.full((9,), 7.0))
    value = (texture.texels[last[0].long()] * last[1][..., None]).sum(1)
    torch.testing.assert_close(value, texture.texels[-1:].expand(9, 2))
    loaded = NeuralTexture(5, 4, 2, generator=torch.Generator().manual_seed(1))
    loaded.load(texture.mips())
    torch.testing.assert_close(loaded.texels, texture.texels.half().float())


@pytest.mark.parametrize("pixelation", ["lonlat", "sukharev", "fibonacci"])
@pytest.mark.parametrize("storage", ["raw", "codebook"])
def test_other_pixelations_and_storages_are_trained_with_their_own_counts(rng, pixelation, storage):
    source, loss = open_brdf("analytic:ggx?roughness=0.5&f0=0.9"), LogCosine()
    options = {"nside": 8, "bits": 4, "features": 4, "pixelation": pixelation, "storage": storage, "frame": "half"}
    model = neubrdf.build(neubrdf.configure(source, options), seed=0)
    assert not model.has_file
    batches = [prepared(model, source, rng, 1024) for _ in range(2)]
    for stage in model.stages():
        model.begin(stage, lambda: iter(batches), loss, torch.Generator().manual_seed(0))
        model.enter(stage)
        model.gradients(batches[0], loss)
        if stage["events"]:
            model.event(stage, lambda: iter(batches), loss)
    wi, wo = directions(rng, 200), directions(rng, 200)
    assert np.isfinite(model.evaluate(wi, wo)).all()
    assert model.bytes > 0
    with pytest.raises(ValueError, match="is for comparison; it has no file"):
        model.to_asset()


def test_points_that_no_sample_touched_evaluate_as_in_the_file(rng):
    source, loss = open_brdf("analytic:ggx?roughness=0.5&f0=0.9&anisotropy=0.5"), LogCosine()
    model = neubrdf.build(neubrdf.configure(source, {"nside": 8, "bits": 4}), seed=0)
    batch = prepared(model, source, rng, 64)  # few samples on many points
    with torch.no_grad():
        model.table.normal_()
    model.level.fill_(len(model._levels) - 1)
    batch = prepared(model, source, rng, 64)
    begin_codebook(model, [batch], loss)
    model.event(stage_of(model, "codebook"), lambda: iter([batch]), loss)
    assert 0.05 < model.live.float().mean() < 0.7
    tensors, header = model.to_asset()
    stored = neubrdf.from_asset(tensors, header["config"])
    assert torch.equal(stored.indices, model.indices)
    model.rounded = True
    wi, wo = directions(rng, 500), directions(rng, 500)
    np.testing.assert_allclose(stored.evaluate(wi, wo), model.evaluate(wi, wo), rtol=1e-4, atol=1e-5)


def test_uniform_weights_are_evaluated_as_they_run(rng):
    model = random_model("half", rng, nside=6, interpolation="uniform")
    tensors, header = model.to_asset()
    wi, wo = directions(rng, 500), directions(rng, 500)
    expected = reference_eval(tensors, header["config"], wi, wo)
    got = neubrdf.from_asset(tensors, header["config"]).evaluate(wi, wo)
    close = np.abs(got - expected) / (1 + expected) < 1e-4
    assert close.all(1).mean() > 0.97  # weights of 1/4 jump at pixel edges, where rounding decides


@pytest.mark.parametrize(("count", "nside"), [(100, 2), (576, 4), (2000, 8), (10000, 16)])
def test_the_grid_of_sparse_samples_follows_their_number(count, nside):
    class Listed:
        isotropic, symmetry, name = True, "reciprocal", "listed"
        samples = (np.zeros((count, 3), np.float32),) * 3

    assert neubrdf.configure(Listed(), {}).nside == nside
    assert neubrdf.configure(Listed(), {"nside": 32}).nside == 32
