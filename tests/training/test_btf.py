"""BTF fits from end to end on tiny textures: the teacher, the student, interruptions, and schedules."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.fake_assets import random_btf  # noqa: E402
from warp_neumat.io.asset import FormatError, read_asset, write_asset  # noqa: E402
from warp_neumat.io.btf_directions import ubo2003_directions  # noqa: E402
from warp_neumat.io.cache import cache_folder  # noqa: E402
from warp_neumat.materials import load  # noqa: E402
from warp_neumat.materials.btf import BTF as Material  # noqa: E402
from warp_neumat.models import btf  # noqa: E402
from warp_neumat.simulation.open_btf import open_btf  # noqa: E402
from warp_neumat.training import loop  # noqa: E402
from warp_neumat.training.btf import BTFData, btf_metrics, mean_value  # noqa: E402
from warp_neumat.training.btf_sheet import asset_slices  # noqa: E402
from warp_neumat.training.fit import checkpoint_path, default_model, fit, presets  # noqa: E402
from warp_neumat.training.loop import Plan, Trainer  # noqa: E402

SPEC = "microgeometry:weave?size=16&directions=ubo2003&bounces=0"
TINY = {"teacher_hidden": (32, 32), "epochs": 2, "mips": 2, "batch": 256}


class Ripples:
    """A glossy texture in closed form: quick to ask, and no cache."""

    name, notes, opening, width, height = "ripples", (), {}, 16, 16
    lights = views = ubo2003_directions()[::3]

    def slices(self, pairs):
        light, view = self.lights[np.asarray(pairs)[:, 0]], self.views[np.asarray(pairs)[:, 1]]
        y, x = np.mgrid[:16, :16] * (2 * np.pi / 16)
        tilt = np.stack([0.4 * np.sin(x), 0.4 * np.cos(y), np.ones_like(x)], -1)
        normal = tilt / np.linalg.norm(tilt, axis=-1, keepdims=True)
        half = (light + view) / np.linalg.norm(light + view, axis=1, keepdims=True)
        lit, shine = (np.maximum(np.einsum("yxc,nc->nyx", normal, d), 0.0) for d in (light, half))
        color = 0.5 + 0.4 * np.sin(x[..., None] * (1, 2, 0) + y[..., None] * (0, 1, 2))
        return (lit[..., None] * color / np.pi + 0.2 * shine[..., None] ** 20).astype(np.float32)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUMAT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def make(checkpoint=None, plan=None, spec="ripples", **options):
    """Return what trains teacher and student, as ``fit`` makes it."""
    source = Ripples()
    shape = btf.configure(source, {k: v for k, v in {**TINY, **options}.items() if k != "batch"})
    settled = Plan(**{"steps": 260, "batch": 256, "seed": 0, **(plan or {})})
    return BTFData.trainer(
        btf, source, shape, settled, "cpu", checkpoint=checkpoint,
        identity={"source": spec, "opening": {}, "model": "btf", "config": repr(shape)},
    )  # fmt: skip


def tensors_of(job):
    return job.model.to_asset()[0]


def assert_same(one, two):
    assert set(one) == set(two)
    for name, value in one.items():
        np.testing.assert_array_equal(two[name], value, err_msg=name)


# --- from end to end --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """(asset, header, what progress said, what was announced) of a simulated weave."""
    folder = tmp_path_factory.mktemp("btf")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NEUMAT_CACHE", str(folder / "cache"))
        seen, said = [], []
        header = fit(
            SPEC, folder / "weave.neumat", steps=400, progress=lambda *a: seen.append(a), announce=said.append, **TINY
        )
    return folder / "weave.neumat", header, seen, said


def test_fit_learns_and_stores_what_it_says(fitted):
    out, header, _, said = fitted
    assert default_model(SPEC) == "btf"
    assert presets("btf") == ("quick", "standard", "fine")
    tensors, stored = read_asset(out)
    assert header["training"]["seconds"] > 0
    spent = {"seconds", "teacher_seconds"}
    kept = {name: value for name, value in header["training"].items() if name not in spent}
    assert stored == {**header, "training": kept}
    assert not checkpoint_path(out).exists()
    assert stored["source"]["spec"] == stored["source"]["name"] == SPEC
    assert stored["metrics"]["weights"] == 667
    assert stored["metrics"]["bytes"] == sum(t.nbytes for t in tensors.values())
    history = stored["training"]["test_l1"]
    assert len(history) == 2
    assert history[-1] < history[0]
    assert "81 lights × 81 views" in said[0]
    assert "16×16 texels" in said[0]
    # The numbers are those of the file, and far better than the mean of the data.
    source, material = open_btf(SPEC), load(out)
    again = btf_metrics(source, material)
    assert again["l1"] == pytest.approx(stored["metrics"]["l1"], rel=1e-6)
    assert len(again["levels"]) == 2
    pairs = np.random.default_rng(1).integers(0, 81, (64, 2))
    values = source.slices(pairs)
    assert again["l1"] < 0.7 * np.abs(values - values.mean()).mean()
    assert again["l1_relative"] == pytest.approx(again["l1"] / mean_value(source), rel=0.1)


def test_progress_goes_through_teacher_and_student(fitted):
    _, header, seen, _ = fitted
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    texts = [text.partition(":")[0] for _, text in seen]
    assert texts.index("student") > texts.index("teacher")
    first = fractions[texts.index("student")]
    assert 0.05 < first < 0.95
    assert header["training"]["teacher_seconds"] > 0


def test_metrics_are_of_texel_centres():
    """The same L1 from whole slices under other pairs, of an asset that is off everywhere alike."""
    source = Ripples()
    material = Material(*random_btf(np.random.default_rng(0), width=16, height=16))
    pairs = np.random.default_rng(2).integers(0, 27, (400, 2))
    apart = np.abs(asset_slices(source, material)(pairs) - source.slices(pairs))
    found = btf_metrics(source, material)
    assert found["l1"] == pytest.approx(apart.mean(), rel=0.03)
    assert found["l1_relative"] == pytest.approx(apart.mean() / source.slices(pairs).mean(), rel=0.06)
    assert len(found["levels"]) == 3


# --- teachers ---------------------------------------------------------------------------------------------------------


def test_a_teacher_is_kept_and_made_again_where_it_is_damaged(cache):
    first = make(plan={"steps": 60})
    found = first.run()
    facts = found["teacher"]
    assert found["teacher_seconds"] > 0
    path = cache / facts["file"]
    assert [f.name for f in cache.iterdir()] == [path.name]  # no checkpoint is left
    content = path.read_bytes()
    second = make(plan={"steps": 60})
    again = second.run()
    assert (again["teacher"], again["teacher_seconds"]) == (facts, None)
    assert_same(tensors_of(first), tensors_of(second))
    path.write_bytes(content[: len(content) // 2])
    third = make(plan={"steps": 60})
    assert third.run()["teacher_seconds"] > 0
    assert_same(tensors_of(first), tensors_of(third))
    tensors, header = read_asset(path)
    assert_same(load_bytes(content, cache), tensors)
    # Another seed, source or length is another teacher; another student is not.
    for change in ({"plan": {"steps": 60, "seed": 1}}, {"spec": "others"}, {"teacher_steps": 7}):
        assert make(**{"plan": {"steps": 60}, **change})._cached() != path
    assert make(plan={"steps": 60}, sigma=0.7, channels=4)._cached() == path


def load_bytes(content, folder):
    (folder / "copy").write_bytes(content)
    return read_asset(folder / "copy")[0]


def test_a_given_teacher_is_used_or_refused(cache, tmp_path):
    path = tmp_path / "large.neumat"
    teacher = btf.build(btf.configure(Ripples, {"variant": "teacher", "hidden": (32, 32), "mips": 2}), 5)
    tensors, header = teacher.to_asset()
    write_asset(path, tensors, {**header, "metrics": {"l1": 0.5}})
    found = make(plan={"steps": 8}, teacher=str(path)).run()["teacher"]
    assert found == {"file": "large.neumat", "l1": 0.5}
    assert not cache.exists()
    with pytest.raises(FormatError, match="a teacher must be 16×16 with 3 mips, as what it teaches, got 16×16 with 2"):
        make(plan={"steps": 8}, teacher=str(path), mips=3).run()
    path.write_bytes(b"nothing")
    with pytest.raises(FormatError, match="no safetensors file"):
        make(plan={"steps": 8}, teacher=str(path)).run()
    with pytest.raises(FileNotFoundError, match="no such file"):
        make(plan={"steps": 8}, teacher=str(tmp_path / "missing.neumat")).run()


def test_without_a_teacher_there_is_none(cache):
    facts = make(plan={"steps": 8}, teacher="none").run()
    assert "teacher" not in facts
    assert not cache.exists()


def test_distillation_brings_the_student_closer_to_its_teacher(cache):
    """Outputs by σ, hidden layers by λ₁ and λ₂: each falls against a student that does without."""
    alone = {"sigma": 0.0, "lambda1": 0.0, "lambda2": 0.0}
    distance = {}
    for name, weights in (
        ("none", {"sigma": 1e-12}), ("outputs", {"sigma": 20.0}), ("hidden", {"lambda1": 1.0, "lambda2": 1.0}),
    ):  # fmt: skip
        # The teacher stays untrained: whoever follows the data ends up elsewhere.
        job = make(plan={"steps": 300}, teacher_steps=1, **{**alone, **weights})
        job.run()
        trainer, model = job._trainer, job.model
        batch = next(iter(trainer._event_batches(0)))
        y, z1, z2 = model.predict(batch["angles"], batch["place"], export=True)
        hidden = [
            float(((z.reshape(-1, mapped.shape[1]) - hint.reshape(-1, mapped.shape[0]) @ mapped) ** 2).mean().detach())
            for z, hint, mapped in ((z1, batch["z1"], model.map1), (z2, batch["z2"], model.map2))
        ]
        distance[name] = {
            "outputs": float((y - batch["teacher"]).abs().mean()), "z1": hidden[0], "z2": hidden[1],
            "data": float((y - batch["target"]).abs().mean()),
        }  # fmt: skip
    assert distance["outputs"]["outputs"] < 0.5 * distance["none"]["outputs"]
    assert distance["outputs"]["data"] > distance["none"]["data"]
    assert distance["hidden"]["z1"] < 0.5 * distance["none"]["z1"]
    assert distance["hidden"]["z2"] < 0.5 * distance["none"]["z2"]


# --- interruptions ----------------------------------------------------------------------------------------------------


def test_same_seed_same_tensors_other_seed_others(cache):
    found = []
    for seed in (0, 0, 1):
        job = make(plan={"steps": 40, "seed": seed})
        job.run()
        found.append(tensors_of(job))
    assert_same(found[0], found[1])
    assert not np.array_equal(found[0]["fine.mip0"], found[2]["fine.mip0"])


@pytest.mark.parametrize("interrupted_in", ["teacher", "student"])
def test_resumed_fit_equals_an_uninterrupted_one(tmp_path, monkeypatch, interrupted_in):
    plan = {"steps": 300, "checkpoint_seconds": 0.0}
    options = {"teacher_steps": 300, "schedule": "plateau", "epochs": 4}
    monkeypatch.setattr(loop, "PLATEAU", 1e9)  # every event halves the rate
    monkeypatch.setenv("NEUMAT_CACHE", str(tmp_path / "whole"))
    whole = make(tmp_path / "w", plan, **options)
    whole.run()

    monkeypatch.setenv("NEUMAT_CACHE", str(tmp_path / "halves"))
    save = Trainer._save

    def save_then_stop(trainer, *arguments):
        save(trainer, *arguments)
        if trainer.stages[0]["name"] == interrupted_in and trainer._step > 128:
            raise KeyboardInterrupt

    path = tmp_path / "c"
    first = make(path, plan, **options)
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_save", save_then_stop)
        with pytest.raises(KeyboardInterrupt):
            first.run()
    assert path.is_file() == (interrupted_in == "student")
    assert bool(list(cache_folder().glob("*.checkpoint"))) == (interrupted_in == "teacher")

    second = make(path, plan, **options)
    assert second.resume()
    steps, note = [], Trainer._note
    monkeypatch.setattr(Trainer, "_note", lambda t, stage, loss: (steps.append(t._step), note(t, stage, loss)))
    facts = second.run()
    assert steps[0] > 128  # it went on, and did not begin anew
    assert (facts["teacher_seconds"] is None) == (interrupted_in == "student")
    assert_same(tensors_of(whole), tensors_of(second))
    assert whole.model.statistics() == second.model.statistics()


def test_a_checkpoint_of_other_settings_is_refused(cache, tmp_path):
    job = make(tmp_path / "c", {"steps": 8, "checkpoint_seconds": 0.0}, teacher="none")
    job.run()
    assert (tmp_path / "c").is_file()
    other = make(tmp_path / "c", {"steps": 8, "checkpoint_seconds": 0.0}, teacher="none", lr=(1e-3, 1e-4))
    assert other.resume()
    with pytest.raises(FormatError, match="config: was .*use the same settings, or fit again without --resume"):
        other.run()


# --- schedules --------------------------------------------------------------------------------------------------------


def test_the_plateau_schedule_halves_where_the_error_does_not_fall(cache, monkeypatch):
    """Every event but the first finds a plateau where nothing moves; none does where the error falls each time."""
    rates = []
    note = Trainer._note

    def noted(trainer, stage, loss):
        rates.append(trainer._learning_rate(stage, 0.5))
        note(trainer, stage, loss)

    monkeypatch.setattr(Trainer, "_note", noted)
    job = make(plan={"steps": 640}, teacher="none", schedule="plateau", lr=(1e-9, 1e-12), epochs=5)
    job.run()
    assert job._trainer._plateau["halved"] == 4
    assert rates[0] == 1e-9
    assert rates[-1] == pytest.approx(1e-9 / 2**4)
    assert len(job.model.history) == 5
    monkeypatch.setattr(loop, "PLATEAU", -1e9)
    job = make(plan={"steps": 256}, teacher="none", schedule="plateau", epochs=5)
    job.run()
    assert job._trainer._plateau["halved"] == 0


def test_a_budget_is_shared_by_teacher_and_student(cache):
    job = make(plan={"budget_seconds": 1.0})
    facts = job.run()
    assert facts["steps"] > 10
    assert 0.9 < facts["seconds"] < 20
    assert facts["teacher_seconds"] < 15
    assert job._teacher_plan().budget_seconds == 0.5


# --- mistakes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"batch": 100}, ValueError, "batch must be a multiple of 64, got 100"),
        ({"mips": 99}, ValueError, "mips must be a whole number"),
        ({"lambda3": 1.0}, ValueError, "no option 'lambda3'; nearest: lambda"),
        ({"preset": "fast"}, ValueError, "no preset 'fast'"),
        ({"crop": (0, 0, 8, 8)}, ValueError, "no option 'crop'"),
        ({"out": "missing/a.neumat"}, FileNotFoundError, "no folder"),
        ({"source": "microgeometry:wave"}, ValueError, "no pattern 'wave'; nearest: weave"),
        ({"source": "missing.btf"}, FileNotFoundError, "missing.btf: no such file"),
    ],
)
def test_wrong_arguments_are_explained_before_training(cache, tmp_path, monkeypatch, arguments, error, message):
    monkeypatch.chdir(tmp_path)
    out, source = arguments.pop("out", "a.neumat"), arguments.pop("source", SPEC)
    with pytest.raises(error, match=message):
        fit(source, out, **arguments)
    assert list(tmp_path.iterdir()) == []


# --- blocks -----------------------------------------------------------------------------------------------------------


def test_features_become_blocks_and_the_networks_adapt(cache, tmp_path):
    """What is stored is what was trained on, at 3/16 of the bytes; and a checkpoint of it can be loaded."""
    found = {}
    for features in ("half", "bc6h"):
        job = make(plan={"steps": 256, "batch": 64}, teacher="none", features=features, mips=1)
        job.run()
        tensors, header = job.model.to_asset()
        material = Material(tensors, header)
        again = btf.from_asset(tensors, header["config"])
        assert_same(again.to_asset()[0], tensors)
        sizes = sum(t.nbytes for name, t in tensors.items() if "mip" in name)
        found[features] = sizes, btf_metrics(job.source, material)["l1"]
        if features == "bc6h":
            np.testing.assert_array_equal(again.texels.detach(), job.model.texels.detach())
            fresh = make(teacher="none", features=features, mips=1)
            fresh = btf.build(fresh.shape, 3, fresh.scale or 1.0)
            fresh.scale = job.model.scale
            fresh.load_state_dict(job.model.state_dict())
            assert_same(fresh.to_asset()[0], tensors)
    assert found["bc6h"][0] * 16 == found["half"][0] * 3  # 8 halves a texel against three blocks of 16 texels
    assert found["bc6h"][1] < 1.5 * found["half"][1]  # 1.15 was seen
