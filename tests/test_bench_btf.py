"""The BTF bench around its fits: means, ratios, cache, curves and lines; and what its problems and sheets hold."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch")

from bench import _btf_lab, _btf_networks, _btf_peers, _btf_shading, btf, btf_step  # noqa: E402
from warp_neumat.kernels import dispatch  # noqa: E402
from warp_neumat.kernels.btf import Layout, Net  # noqa: E402
from warp_neumat.simulation.open_btf import open_btf  # noqa: E402
from warp_neumat.training.btf import btf_metrics  # noqa: E402
from warp_neumat.training.lafortune import fit_lafortune  # noqa: E402

SMALL = {"size": 16, "directions": "ubo2003", "materials": ("weave", "leather"), "pairs": 81, "iterations": 1}
ERRORS = {("coarse-to-fine", "auto"): 0.011, ("coarse-to-fine", "none"): 0.014, ("neumip", "none"): 0.010}


@pytest.fixture
def fits(monkeypatch):
    """Replace our fit: an error by variant and teacher, twice that for leather; a network of the true shape."""
    asked = []

    def fit(source, out, *, model, steps, seed, **options):
        asked.append((source, options))
        variant = options["variant"]
        teacher = options.get("teacher", "none" if variant == "neumip" else "auto")
        error = ERRORS.get((variant, teacher), 0.012) * (2 if "leather" in source else 1)
        out.write_text(json.dumps(variant))
        taught = {} if teacher == "none" else {"teacher": {"l1": 0.009}, "teacher_seconds": 7.0}
        training = {"seconds": 3.0, "test_l1": [2 * error, error], **taught}
        return {"metrics": {"l1": error, "l1_relative": 10 * error}, "training": training}

    def load(path, device):
        layouts = {"coarse-to-fine": Layout(), "single-level": Layout(Net(30, (8,) * 7), None, 0)}
        layout = layouts.get(json.loads(path.read_text()), Layout(Net(14, (25,) * 5), None, 0))
        return SimpleNamespace(bytes=1000, weights=layout.parameters, layout=layout)

    monkeypatch.setattr("warp_neumat.training.fit.fit", fit)
    monkeypatch.setattr("warp_neumat.materials.load", load)
    return asked


def rows(**choices):
    return list(btf.rows(device="cpu", quick=False, **{**SMALL, **choices}))


def test_table1_has_every_method_and_ratios_of_means(fits, tmp_path):
    cache = tmp_path / "deep" / "records.jsonl"
    found = rows(only=("table1",), cache=cache)
    json.dumps([btf.COLUMNS, found], allow_nan=False)
    table = {(row["material"], row["method"]): row for row in found}
    assert len(found) == len(table) == 3 * len(btf.METHODS)
    mean = table["mean of 2", "distilled"]
    assert mean["l1"] == pytest.approx(1.5 * 0.011)
    assert mean["over_neumip"] == pytest.approx(1.1)
    assert mean["macs"] == 438
    assert mean["macs_under_neumip"] == pytest.approx(3150 / 438)
    assert mean["teacher_seconds"] == 7
    assert (mean["weights"], table["mean of 2", "single-level"]["weights"]) == (779, 779)
    lobes = table["mean of 2", "lafortune"]
    assert mean["under_lafortune"] == pytest.approx(lobes["l1"] / mean["l1"])
    assert lobes["bytes"] == 16 * 16 * 55 * 4
    assert len(fits) == 8
    assert rows(only=("table1",), cache=cache) == found  # from the cache
    assert len(fits) == 8
    rows(only=("table1",), cache=cache, materials=("weave",), methods=("neumip",), steps=7)  # another plan
    assert len(fits) == 9


def test_curves_are_those_of_the_fits_and_drawn(fits, tmp_path):
    pytest.importorskip("matplotlib")
    from warp_neumat.io.image import read_image

    found = rows(only=("figure7", "figure11"), plots=tmp_path / "plots")
    assert len(fits) == 6  # distilled, alone and NeuMIP, each once a material
    curve = [r["l1"] for r in found if (r["table"], r["material"], r["method"]) == ("figure11", "weave", "alone")]
    assert curve == [0.028, 0.014]
    for name in ("figure7.png", "figure11.png"):
        assert read_image(tmp_path / "plots" / name)[0].std() > 0.05


def test_lafortune_is_measured_as_the_networks_are():
    """The adapter gives the very slices of the fit at the texels that the metric asks for."""
    source = open_btf("microgeometry:weave?size=16&directions=ubo2003")
    lobes = fit_lafortune(source, pairs=81, iterations=1)
    exact = SimpleNamespace(parameters=lobes.parameters, value=lambda wi, wo: _slices(source, wi, wo))
    assert btf_metrics(source, _btf_lab.TexelLobes(exact))["l1"] < 1e-3 * source.slices([[3, 5]]).mean()
    pairs = np.random.default_rng(0).integers(0, 81, (200, 2))
    assert btf_metrics(source, _btf_lab.TexelLobes(lobes))["l1"] == pytest.approx(lobes.l1(source, pairs), rel=0.2)


def _slices(source, wi, wo):
    pairs = [[np.argmax(d @ row) for d, row in zip((source.lights, source.views), pair, strict=True)]
             for pair in zip(wi, wo, strict=True)]  # fmt: skip
    return source.slices(np.array(pairs))


@pytest.mark.parametrize("name", _btf_networks.SHAPES)
def test_networks_match_float64_under_every_light(name):
    run = _btf_networks.Run(name, 4096, "cpu")
    assert max(run.error(n) for n in (1, 4)) < 1e-4
    run.wi = run.wi[:, ::-1]  # another answer is expected now
    assert run.error(1) > 0.01


def test_peers_compute_the_same_networks():
    for name in _btf_peers.NAMES:
        problem = _btf_peers.Problem(name)
        for kind, call, error, texels in _btf_peers.torch_peers(problem, 8192, 1, compiled=False):
            assert error < 1e-5, kind
            assert texels == 8192
            call()
    pytest.importorskip("drjit")
    for fetches in (False, True):
        for kind, _, error, _ in _btf_peers.drjit_peers(problem, 4096, 1, fetches=fetches):
            assert error < (1e-5 if "float32" in kind else 0.03), kind


def test_half_precision_is_a_peer_where_it_is_faster():
    offers = {("a", "x float32", 0): (2.0, 0.1), ("a", "x float32", 1): (1.0, 0.1), ("a", "x float16", 2): (1.5, 0.2)}
    assert _btf_peers._fastest(offers) == {("a", "x float32"): (1.0, 0.1)}
    offers["a", "x float16", 3] = (0.5, 0.3)
    assert _btf_peers._fastest(offers)["a", "x float16"] == (0.5, 0.3)


def test_sheets_are_lit_whole_from_above_and_not_at_all_from_behind():
    materials = _btf_shading._materials("coarse-to-fine", 2, "cpu")
    stage = _btf_shading.Stage(materials, 64, 3, "cpu")
    assert stage.texels == 2 * 64 * 64
    assert [stage.shade(1), stage.shade(3), stage.shade(0), stage.shade(0, 2)] == [8192, 3 * 8192, 0, 0]
    stage.shade(2)
    shaded = stage.shader.radiance.numpy().reshape(64, 128, 4)
    assert (shaded[..., 3] >= 0).all()
    assert (shaded[..., :3].sum(2) > 0).mean() > 0.9
    assert not np.allclose(shaded[:, :64], shaded[:, 64:])  # two materials


def test_sheets_put_texels_where_their_triangles_are():
    sequence = _btf_shading.sheets(2, 3.0)
    triangle, barycentric = _btf_shading.owners(2, 40)
    weights = np.concatenate([1 - barycentric.sum(2, keepdims=True), barycentric], 2)
    assert weights.min() > -1e-6
    at = (sequence.frame(0).points[sequence.faces[triangle]] * weights[..., None]).sum(2)
    uv = (sequence.uv[sequence.faces[triangle]] * weights[..., None]).sum(2)
    centre = (np.arange(40) + 0.5) / 40
    assert np.allclose(uv[:, :40], 3 * np.stack(np.meshgrid(centre, centre), 2), atol=1e-5)
    assert np.allclose(at[..., 0], np.concatenate([centre - 1, centre]), atol=1e-5)
    assert np.allclose(at[..., 1], 0.5 - centre[:, None], atol=1e-5)


def test_lines_and_least_times():
    found = _btf_networks.line([1, 2, 3, 4], [3, 5, 7, 9])
    assert found == pytest.approx({"intercept": 1, "slope": 2, "r2": 1})
    assert _btf_networks.line([1, 2, 3], [1, 3, 1])["r2"] < 0.1
    calls = []
    _btf_networks.least({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 3)
    assert calls.count("a") == calls.count("b") == 4


def test_step_gradients_match_and_a_wrong_one_shows():
    model = btf_step._model("student", 32)
    ours, peer = btf_step._errors(model, 64, True)
    assert max(ours, peer) < 2e-5
    model.net.data[:] = model.net * 1.5
    problem = btf_step.Problem(model, 64, taught=True)
    leaves = problem.leaves(problem.model.net.dtype)
    problem.torch_step(*leaves)
    step = problem.step(dispatch.worker_count())
    step.net[:] = step.net / 1.5  # another network
    step.run(*problem.batch)
    assert float((step.weight_gradient - leaves[1].grad).abs().max()) > 0.01 * float(leaves[1].grad.abs().max())


def test_mistakes_are_one_line(capsys):
    with pytest.raises(ValueError, match="only must be among table1, .*, got 'table2'"):
        rows(only=("table2",))
    assert btf.main(["--only", "table1", "--materials", "weav"]) == 1
    assert "no pattern 'weav'" in capsys.readouterr().err
