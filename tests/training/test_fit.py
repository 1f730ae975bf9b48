"""`fit` from end to end on tiny models: determinism, resumption, the stored numbers, and errors."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat.io.asset import read_asset  # noqa: E402
from warp_neumat.io.brdf import open_brdf  # noqa: E402
from warp_neumat.models import neubrdf  # noqa: E402
from warp_neumat.reference.neubrdf import reference_eval  # noqa: E402
from warp_neumat.training import fit as fitting  # noqa: E402
from warp_neumat.training.fit import checkpoint_path, default_model, fit, presets  # noqa: E402
from warp_neumat.training.loop import Plan, Trainer  # noqa: E402
from warp_neumat.training.losses import LogCosine  # noqa: E402
from warp_neumat.training.sphere import render_sphere, sphere_error  # noqa: E402

SOURCE = "analytic:ggx?roughness=0.5&f0=0.9,0.6,0.3&diffuse=0.1"
TINY = {"nside": 4, "bits": 5, "features": 8, "hidden": (16, 16), "frame": "isotropic"}


def make_trainer(checkpoint=None, seed=0, **plan):
    source = open_brdf(SOURCE)
    model = neubrdf.build(neubrdf.configure(source, TINY), seed)
    sampler, plan = fitting.BRDFData.sampler(source), Plan(**{"steps": 150, "batch": 256, "seed": seed, **plan})
    return Trainer(model, sampler, LogCosine(), plan, checkpoint=checkpoint, identity={"source": SOURCE})


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    out = tmp_path_factory.mktemp("fit") / "a.neumat"
    seen = []
    header = fit(SOURCE, out, steps=250, progress=lambda fraction, text: seen.append((fraction, text)), **TINY)
    return out, header, seen


def test_fit_learns_and_stores_what_it_says(fitted):
    out, header, seen = fitted
    tensors, stored = read_asset(out)
    assert header["training"].pop("seconds") > 0  # returned, not stored: the same seed gives the same file
    assert stored == header
    assert not checkpoint_path(out).exists()
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    # The numbers in the header are those of the stored fp16 values, seen by the float64 reference.
    source = open_brdf(SOURCE)
    picture = render_sphere(lambda wi, wo: reference_eval(tensors, stored["config"], wi, wo))
    error = sphere_error(picture, render_sphere(source.eval))
    assert error["mae"] == pytest.approx(header["metrics"]["mae"], rel=1e-3)
    assert error["rmse"] == pytest.approx(header["metrics"]["rmse"], rel=1e-3)
    assert header["metrics"]["bytes"] == sum(t.nbytes for t in tensors.values())
    flat = sphere_error(render_sphere(lambda wi, wo: np.full((len(wi), 3), 0.1)), render_sphere(source.eval))
    assert error["mae"] < 0.25 * flat["mae"]


def test_same_seed_same_tensors_other_seed_others():
    runs = []
    for seed in (0, 0, 1):
        trainer = make_trainer(seed=seed, steps=60)
        trainer.run()
        runs.append(trainer.model.to_asset()[0])
    assert all(np.array_equal(runs[0][name], runs[1][name]) for name in runs[0])
    assert not np.array_equal(runs[0]["indices"], runs[2]["indices"])


def test_the_model_follows_the_source(tmp_path):
    assert default_model(tmp_path) == default_model(str(tmp_path)) == "bcf"
    assert default_model({"maps": {}}) == default_model("set.JSON") == "bcf"
    assert default_model(SOURCE) == default_model("brdfs.npz:gold") == default_model("brdfs.npz") == "neubrdf"
    assert default_model(tmp_path / "missing") == "bcf"
    assert presets("neubrdf") == ("quick", "standard", "fine")
    assert presets("bcf")[:4] == ("0.5k", "1k", "2k", "2k++")


@pytest.mark.parametrize("interrupted_in", ["features", "codebook", "round"])
def test_resumed_fit_equals_an_uninterrupted_one(tmp_path, interrupted_in):
    whole = make_trainer(steps=700)
    whole.run()

    path = tmp_path / "c"
    first = make_trainer(path, steps=700, checkpoint_seconds=0.0)
    save = first._save

    def save_then_stop(*arguments):
        save(*arguments)
        within = first._step > 0 or interrupted_in == "round"  # that is too short here to have a boundary within
        if first.stages[first._stage]["name"] == interrupted_in and within:
            raise KeyboardInterrupt

    first._save = save_then_stop
    with pytest.raises(KeyboardInterrupt):
        first.run()

    second = make_trainer(path, steps=700, checkpoint_seconds=0.0)
    assert second.resume()
    second.run()
    for name, value in whole.model.to_asset()[0].items():
        np.testing.assert_array_equal(second.model.to_asset()[0][name], value, err_msg=name)


def test_checkpoint_of_other_settings_is_refused(tmp_path):
    path = tmp_path / "c"
    trainer = make_trainer(path, steps=150)
    trainer._save(torch.optim.Adam(trainer.model.parameters()), [])
    with pytest.raises(ValueError, match=r"c: plan: was .*'seed': 0.* now .*'seed': 7.*; use the same settings"):
        make_trainer(path, seed=7).resume()
    path.write_bytes(b"not a checkpoint at all")
    with pytest.raises(ValueError, match="c: file: no readable checkpoint"):
        make_trainer(path).resume()
    assert not make_trainer(tmp_path / "none").resume()


def test_budget_ends_in_time():
    trainer = make_trainer(budget_seconds=1.0)
    facts = trainer.run()
    assert facts["steps"] > 10
    assert facts["seconds"] < 20  # a stage's preparation is not cut short
    assert trainer.model.quantised


def test_divergence_is_an_error():
    trainer = make_trainer()
    with torch.no_grad():
        trainer.model.net.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="diverged in stage features"):
        trainer.run()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"model": "nubrdf"}, ValueError, "nearest: neubrdf"),
        ({"nsides": 8}, ValueError, "no option 'nsides'; nearest: nside"),
        ({"preset": "standart"}, ValueError, "nearest: standard"),
        ({"steps": 0}, ValueError, "steps must be a whole number of at least 1"),
        ({"seed": -1}, ValueError, "seed must be"),
        ({"budget_seconds": -2.0}, ValueError, "budget_seconds must be above 0"),
        ({"checkpoint_seconds": -1.0}, ValueError, "checkpoint_seconds must be at least 0"),
        ({"model": "bcff"}, ValueError, "no model 'bcff'; nearest: bcf"),
        ({"device": "cuda:99"}, ValueError, "device 'cuda:99' cannot be used"),
        ({"device": "gpu"}, ValueError, "device 'gpu' cannot be used"),
        ({"out": "missing/a.neumat"}, FileNotFoundError, "no folder"),
    ],
)
def test_wrong_arguments_are_explained_before_training(tmp_path, monkeypatch, arguments, error, message):
    monkeypatch.chdir(tmp_path)
    out = arguments.pop("out", "a.neumat")
    with pytest.raises(error, match=message):
        fit(SOURCE, out, **arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_fit_that_creates_energy_trains_on(tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "MOST_EXCESS", 1e9)
    kept = fit(SOURCE, tmp_path / "kept.neumat", steps=64, **TINY)
    assert "energy_rounds" not in kept["metrics"]
    monkeypatch.setattr(fitting, "MOST_EXCESS", 0.0)  # as if any light were too much
    monkeypatch.setattr(fitting, "ENERGY_ROUNDS", 2)
    headers = [fit(SOURCE, tmp_path / f"{name}.neumat", steps=64, **TINY) for name in "ab"]
    assert headers[0]["metrics"]["energy_rounds"] == 2
    kept, first, second = (read_asset(tmp_path / f"{name}.neumat")[0] for name in ("kept", "a", "b"))
    assert not np.array_equal(kept["codebook"], first["codebook"])
    assert all(np.array_equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("suffix", ["binary", "bsdf", "csv", "csv?isotropic=1", "npz"])
def test_measured_files_are_for_neubrdf(suffix):
    assert default_model(f"measured.{suffix}") == "neubrdf"
