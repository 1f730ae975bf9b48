"""Materials that share primitives: grouping, files, joining, going on, and what goes wrong."""

import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat.io.asset import FormatError, read_asset, write_asset  # noqa: E402
from warp_neumat.io.brdf import open_brdf  # noqa: E402
from warp_neumat.io.brdf_samples import BRDFSamples, write_samples  # noqa: E402
from warp_neumat.io.brdf_set import Opened, open_brdfs  # noqa: E402
from warp_neumat.io.shared_asset import digest, read_whole_asset  # noqa: E402
from warp_neumat.kernels.healpix_tree import expand  # noqa: E402
from warp_neumat.models import neubrdf, reassign  # noqa: E402
from warp_neumat.models.joined import JoinedNeuBRDF  # noqa: E402
from warp_neumat.training import joining, losses, samplers, shared_job, sharing  # noqa: E402
from warp_neumat.training.grouping import cluster, codes, groups, signature  # noqa: E402
from warp_neumat.training.loop import Plan, Trainer  # noqa: E402
from warp_neumat.training.sharing import fit_shared  # noqa: E402
from warp_neumat.training.sphere import render_sphere, sphere_error  # noqa: E402

TINY = {"nside": 4, "bits": 6, "features": 8, "hidden": (16, 16)}
SPECS = {
    "red": "analytic:lambert?albedo=0.8,0.1,0.1",
    "blue": "analytic:lambert?albedo=0.1,0.1,0.8",
    "metal": "analytic:ggx?roughness=0.4&f0=0.9",
    "gold": "analytic:ggx?roughness=0.4&f0=0.9,0.6,0.2",
}


def opened(specs: dict[str, str]) -> dict[str, Opened]:
    return {name: Opened(spec, open_brdf(spec)) for name, spec in specs.items()}


def sphere_metrics(source, eval_fn) -> dict:
    return sphere_error(render_sphere(eval_fn, 48), render_sphere(source.eval, 48))


def stored(path):
    tensors, header = read_whole_asset(path)
    return neubrdf.from_asset(tensors, header["config"]), tensors, header


@pytest.fixture(scope="module", autouse=True)
def small_metrics():
    """Metrics of a small picture: those of a fit proper take longer than the fits of this file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shared_job, "brdf_metrics", sphere_metrics)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("shared") / "dir"
    seen, told = [], []
    headers = fit_shared(
        opened(SPECS), out, count=2, steps=260, progress=lambda f, t: seen.append(f), announce=told.append, **TINY
    )
    return out, headers, seen, told


def test_codes_and_clusters_find_what_belongs_together(rng):
    centres = rng.normal(size=(3, 40)) * 10
    member = rng.integers(0, 3, 30)
    found = cluster(codes(centres[member] + 0.1 * rng.normal(size=(30, 40)), 4), 3)
    assert all(len(set(found[member == m])) == 1 for m in range(3))
    assert len(set(found)) == 3
    assert cluster(np.zeros((4, 2)), 3).max() <= 2  # all alike: nothing to tell apart, and no endless loop


def test_groups_keep_anisotropic_materials_apart():
    mixed = [*(o.source for o in opened(SPECS).values()), open_brdf("analytic:ggx?roughness=0.4&anisotropy=0.8")]
    found = groups(mixed, 2)
    assert sorted(n for group in found for n in group) == [0, 1, 2, 3, 4]
    assert [4] in found
    assert [0, 1] in found  # the two matt ones
    assert signature(mixed[0].eval).shape == signature(mixed[4].eval).shape


def test_a_group_shares_codebook_and_decoder(folder):
    out, headers, seen, told = folder
    assert set(headers) == set(SPECS)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    assert any("red, blue" in text for text in told)
    assert sorted(path.name for path in out.glob("group-*")) == ["group-0.neumat", "group-1.neumat"]
    assert not list(out.glob("*.checkpoint"))
    for name, opening in opened(SPECS).items():
        own, header = read_asset(out / f"{name}.neumat")
        assert set(own) <= {"indices", "live"}
        assert header["source"]["spec"] == SPECS[name]
        model, tensors, whole = stored(out / f"{name}.neumat")
        metrics = header["metrics"]
        assert metrics["bytes_own"] == whole["own_bytes"] == sum(t.nbytes for t in own.values())
        assert metrics["bytes"] == sum(t.nbytes for t in tensors.values())
        assert metrics["bytes_shared"] == metrics["bytes"] - metrics["bytes_own"]
        assert metrics["sharers"] == 2
        assert metrics["mae"] == sphere_metrics(opening.source, model.evaluate)["mae"]
        assert metrics["mae"] < 0.03


def sparse(path, count: int, seed: int):
    rng = np.random.default_rng(seed)
    wi, wo = samplers.measured_directions(count, rng)
    write_samples(path, wi, wo, open_brdf("analytic:ggx?roughness=0.5&anisotropy=0.5").eval(wi, wo))


def test_metrics_are_of_what_the_pruned_file_expands_to(tmp_path, monkeypatch):
    # What a trained model holds at points that are not stored must not matter.
    monkeypatch.setattr(neubrdf.NeuBRDF, "_inherit", lambda self: None)
    few, told, out = tmp_path / "few", [], tmp_path / "out"
    few.mkdir()
    for seed, name in enumerate(("one", "two")):
        sparse(few / f"{name}.csv", 60, seed)
    sparse(tmp_path / "three.csv", 60, 7)
    headers = fit_shared(open_brdfs(str(few)), out, steps=20, announce=told.append, **TINY)
    headers |= fit_shared(open_brdfs(str(tmp_path / "three.csv")), out, steps=20, announce=told.append)
    assert set(headers) == {"one", "two", "three"}
    for name, header in headers.items():
        model, tensors, written = stored(out / f"{name}.neumat")
        assert "live" in tensors
        source = open_brdf(written["source"]["spec"])
        assert header["metrics"]["mae"] == written["metrics"]["mae"] == sphere_metrics(source, model.evaluate)["mae"]
        assert written["training"]["points_live"] == int(model.live.sum()) < len(model.live)
        assert written["source"]["notes"] == list(source.notes)
        assert all(f"note: {name}: {note}" in told for note in source.notes)


def test_a_material_joins_and_nothing_else_is_touched(folder, tmp_path, monkeypatch):
    out = tmp_path / "dir"
    shutil.copytree(folder[0], out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    told, texts, sweeps, sweep = [], [], [], reassign.sweep
    monkeypatch.setattr(reassign, "sweep", lambda *a: (sweeps.append(1), sweep(*a)))
    added = opened({"copper": "analytic:ggx?roughness=0.42&f0=0.9,0.5,0.3"})
    headers = fit_shared(
        added, out, steps=200, announce=told.append, progress=lambda f, t: texts.append(t), reciprocal=True
    )
    assert told == ["copper: joins group-1.neumat, as gold"]
    assert all(text.startswith("copper: ") for text in texts[:-1])
    assert len(sweeps) == 8
    assert {name: (out / name).read_bytes() for name in before} == before
    assert sorted({path.name for path in out.iterdir()} - set(before)) == ["copper.neumat"]
    model, tensors, header = stored(out / "copper.neumat")
    assert header["source"]["spec"] == added["copper"].spec
    assert header["metrics"]["sharers"] == 3
    assert headers["copper"]["metrics"]["bytes"] == sum(t.nbytes for t in tensors.values())
    assert headers["copper"]["metrics"]["bytes_own"] == header["own_bytes"]
    gold, source = stored(out / "gold.neumat")[0], added["copper"].source
    assert header["metrics"]["mae"] == sphere_metrics(source, model.evaluate)["mae"]
    assert header["metrics"]["mae"] < sphere_metrics(source, gold.evaluate)["mae"]
    with pytest.raises(ValueError, match="a group's shape is fixed: it cannot be given nside"):
        fit_shared({"x": added["copper"]}, out, nside=8)
    with pytest.raises(ValueError, match="join the groups that are there; leave out groups"):
        fit_shared({"x": added["copper"]}, out, count=2)
    with pytest.raises(ValueError, match=r"copper.neumat: is there already"):
        fit_shared(added, out)
    told.clear()
    assert set(fit_shared(added, out, resume=True, announce=told.append, **TINY)) == {"copper"}
    assert told == ["note: copper: is there already"]


def test_an_interrupted_join_goes_on(folder, tmp_path):
    added, contents, texts = opened({"copper": "analytic:ggx?roughness=0.42&f0=0.9,0.5,0.3"}), [], []
    settings = {"steps": 140, "checkpoint_seconds": 0.0}

    def stop(fraction, text):
        if text == "copper: indices: preparing":
            raise KeyboardInterrupt

    for name in ("whole", "cut"):
        out = tmp_path / name
        shutil.copytree(folder[0], out)
        if name == "cut":
            with pytest.raises(KeyboardInterrupt):
                fit_shared(added, out, progress=stop, **settings)
            with pytest.raises(FormatError, match=r"copper.neumat.checkpoint: plan: was .* now "):
                fit_shared(added, out, resume=True, seed=1, **settings)
        fit_shared(added, out, resume=name == "cut", progress=lambda f, t: texts.append(t), **settings)
        contents.append({path.name: path.read_bytes() for path in out.iterdir()})
    assert texts.count("copper: features: preparing") == 1  # of the whole one
    assert contents[0] == contents[1]


def member(name, frame, symmetry, code=0.0):
    config = {"frame": frame, "symmetry": symmetry}
    return joining.Member(name, {}, {"config": config, "group": {"file": f"group-{name}.neumat"}}, code)


@pytest.mark.parametrize(
    ("frame", "symmetry", "isotropic", "own", "takes"),
    [
        ("half-isotropic", "bilateral", True, "bilateral", True),
        ("half-isotropic", "bilateral", True, "reciprocal", False),
        ("half-isotropic", "none", True, "none", True),
        ("half-isotropic", "none", False, "reciprocal", False),
        ("isotropic", "none", False, "reciprocal", False),
        ("half", "reciprocal", False, "reciprocal", True),
        ("half", "reciprocal", True, "bilateral", True),
        ("half", "reciprocal", True, "none", False),
        ("absolute", "none", False, "none", True),
    ],
)
def test_groups_take_what_keeps_their_assumptions(frame, symmetry, isotropic, own, takes):
    source = SimpleNamespace(isotropic=isotropic)
    assert member("x", frame, symmetry).takes(source, own) == takes


def test_the_nearest_is_sought_among_the_compatible(folder, tmp_path):
    brushed = open_brdf("analytic:ggx?roughness=0.4&anisotropy=0.8")
    own = signature(brushed.eval)
    members = [member("alike", "half-isotropic", "bilateral", own), member("far", "half", "reciprocal", own + 1)]
    job = SimpleNamespace(sources={"brushed": Opened("", brushed)}, folder="dir")
    assert joining._nearest(job, "brushed", members, False).name == "far"
    plain = SimpleNamespace(isotropic=True, symmetry="none", eval=brushed.eval)
    job.sources["plain"] = Opened("", plain)
    assert joining._nearest(job, "plain", members, True).name == "far"  # taken for reciprocal, as asked
    with pytest.raises(ValueError, match="plain: can join no group in dir: it is isotropic with symmetry none, they"):
        joining._nearest(job, "plain", members, False)
    out = tmp_path / "dir"
    shutil.copytree(folder[0], out)
    before, told = sorted(out.iterdir()), []
    mixed = {**opened({"copper": SPECS["gold"]}), "brushed": Opened("", brushed)}
    with pytest.raises(ValueError, match="brushed: can join no group .* anisotropic .*; fit it by itself, or into"):
        fit_shared(mixed, out, steps=8, announce=told.append)
    assert sorted(out.iterdir()) == before
    assert not told


@pytest.mark.parametrize("sweeps", [0, 2])
def test_a_joined_material_names_only_what_its_group_holds(sweeps):
    rows, source = 10, open_brdf(SPECS["red"])
    like = neubrdf.build(neubrdf.configure(source, TINY), 0)
    with torch.no_grad():
        like.codebook[:rows] = 3 * torch.randn(rows, TINY["features"], generator=torch.Generator().manual_seed(0))
        like.indices += torch.arange(len(like.indices), dtype=torch.int32) % rows
    model = JoinedNeuBRDF(like, rows)
    model.SWEEPS = sweeps
    wi, wo = samplers.measured_directions(40, np.random.default_rng(0))
    few = BRDFSamples("few", wi, wo, source.eval(wi, wo), isotropic=True)
    Trainer(model, lambda rng, n: samplers.sampler(few, rng).draw(n), losses.LogCosine(), Plan(2)).run()
    assert int(model.indices.max()) < rows
    live = model.live.numpy()
    assert not live.all()
    assert (model.indices.numpy() == expand(TINY["nside"], live, model.indices.numpy()[live])).all()


def test_an_interrupted_fit_goes_on(tmp_path, monkeypatch):
    out, few = tmp_path / "dir", opened(dict(list(SPECS.items())[:3]))
    settings = {"count": 2, "steps": 64, "checkpoint_seconds": 0.0, **TINY}

    def stop(fraction, text):
        if text == "group 1: round: preparing":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_shared(few, out, progress=stop, **settings)
    done = {path.name: path.read_bytes() for path in out.glob("*.neumat")}
    assert set(done) == {"group-0.neumat", "red.neumat", "blue.neumat"}
    assert (out / "group-1.checkpoint").is_file()

    for changed, message in (
        ({"seed": 1}, r"groups.checkpoint: seed: was 0 when the fit was interrupted, now 1; use the same settings, or"),
        ({"count": 1}, "groups: was 2 .* now 1"),
        ({"length": 2.0}, "length: was 1.0 .* now 2.0"),
        ({"nside": 8}, "config: was .* now "),
    ):
        with pytest.raises(FormatError, match=message):
            fit_shared(few, out, resume=True, **{**settings, **changed})
    with pytest.raises(FormatError, match="names: was"):
        fit_shared({**few, **opened({"gold": SPECS["gold"]})}, out, resume=True, **settings)
    with pytest.raises(FormatError, match="specs: was"):
        fit_shared({**few, "metal": opened(SPECS)["gold"]}, out, resume=True, **settings)
    with pytest.raises(FormatError, match=r"groups.checkpoint: fit: was interrupted; resume it"):
        fit_shared(opened({"gold": SPECS["gold"]}), out)
    tensors, header = read_asset(out / "red.neumat")
    write_asset(out / "red.neumat", tensors, {**header, "group": {**header["group"], "file": "group-7.neumat"}})
    with pytest.raises(FormatError, match=r"red.neumat: group.file: must be group-0.neumat.* got 'group-7.neumat'"):
        fit_shared(few, out, resume=True, **settings)
    (out / "red.neumat").write_bytes(done["red.neumat"])
    (out / "group-0.neumat").write_bytes(_other_group(out, tmp_path))
    with pytest.raises(FormatError, match=r"group-0.neumat: digest: is another than"):
        fit_shared(few, out, resume=True, **settings)
    (out / "group-0.neumat").write_bytes(done["group-0.neumat"])
    assert {path.name: path.read_bytes() for path in out.glob("*.neumat")} == done

    (out / "group-0.checkpoint").write_bytes(b"left over")
    texts = []
    with monkeypatch.context() as patch:
        patch.setattr(sharing, "groups", lambda *a, **k: pytest.fail("the groups were planned again"))
        headers = fit_shared(few, out, resume=True, progress=lambda f, t: texts.append(t), **settings)
    assert set(headers) == set(few)
    assert not [text for text in texts if "features" in text]  # it went on from the checkpoint
    assert not list(out.glob("*.checkpoint"))
    for name, content in done.items():
        assert (out / name).read_bytes() == content
    again = tmp_path / "again"
    fit_shared(few, again, **settings)
    assert {p.name: p.read_bytes() for p in out.iterdir()} == {p.name: p.read_bytes() for p in again.iterdir()}


def _other_group(out, tmp_path) -> bytes:
    """Return the content of a group's file that differs from that in ``out`` by one number."""
    tensors, header = read_asset(out / "group-0.neumat")
    write_asset(tmp_path / "other.neumat", {**tensors, "bias0": tensors["bias0"] + np.float16(1)}, header)
    return (tmp_path / "other.neumat").read_bytes()


@pytest.mark.parametrize("content", ["", "[]", '{"names": ["a"], "plan": [[1]]}', '{"names": ["a"]}'])
def test_a_broken_plan_is_named(tmp_path, content):
    (tmp_path / "groups.checkpoint").write_text(content)
    with pytest.raises(FormatError, match=r"groups.checkpoint: (file: no readable plan|plan: must name)"):
        fit_shared(opened({"a": SPECS["red"]}), tmp_path, resume=True)


def test_length_and_threads(tmp_path, monkeypatch):
    monkeypatch.setattr(neubrdf, "DEFAULT_STEPS", 40)
    monkeypatch.setattr(shared_job, "brdf_metrics", lambda source, eval_fn: {})
    before, seen, names = torch.get_num_threads(), set(), list(SPECS)
    torch.set_num_threads(1)
    try:
        few = opened({name: SPECS[name] for name in names[:2]})
        headers = fit_shared(few, tmp_path, length=0.5, progress=lambda f, t: seen.add(torch.get_num_threads()), **TINY)
        assert headers["red"]["training"]["steps"] == 28  # 40 · ½ · √2
        added = fit_shared(opened({"gold": SPECS["gold"]}), tmp_path, length=0.5)
        assert added["gold"]["training"]["steps"] == 10
        assert len(os.sched_getaffinity(0)) in seen if hasattr(os, "sched_getaffinity") else seen
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"storage": "raw"}, "storage raw is for comparison and has no file; use codebook"),
        ({"pixelation": "lonlat"}, "pixelation lonlat is for comparison and has no file; use healpix"),
        ({"texture": (8, 8, 4)}, "texture is for what varies over a surface"),
        ({"device": "cuda:0"}, "run on the cpu, got device 'cuda:0'"),
        ({"steps": 0}, "steps must be a whole number of at least 1, got 0"),
        ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ({"count": 0}, "count must be a whole number of at least 1, got 0"),
        ({"length": 0.0}, "length must be above 0"),
        ({"checkpoint_seconds": -1.0}, "checkpoint_seconds must be at least 0"),
        ({"nsied": 8}, "nearest: nside"),
    ],
)
def test_wrong_options_are_found_before_anything_is_written(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        fit_shared(opened({"a": SPECS["red"]}), tmp_path / "dir", **options)
    assert not (tmp_path / "dir").exists()


def test_wrong_folders_and_names_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    few = opened({"a": SPECS["red"]})
    with pytest.raises(NotADirectoryError, match="file: is a file; give a folder"):
        fit_shared(few, tmp_path / "file")
    with pytest.raises(ValueError, match="no material can be called group-"):
        fit_shared({"group-a": few["a"]}, tmp_path / "dir")
    with pytest.raises(ValueError, match="no source is given"):
        fit_shared({}, tmp_path / "dir")
    write_asset(tmp_path / "a.neumat", {}, {"kind": "neubrdf", "version": 2})
    with pytest.raises(FormatError, match="a.neumat: group.file: must be group-0.neumat"):
        fit_shared(few, tmp_path, resume=True)


def test_files_that_do_not_belong_together_are_refused(folder, tmp_path):
    shutil.copy(folder[0] / "red.neumat", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"red.neumat: its group group-0.neumat is not beside it; put"):
        read_whole_asset(tmp_path / "red.neumat")
    shutil.copy(folder[0] / "group-1.neumat", tmp_path / "group-0.neumat")
    with pytest.raises(FormatError, match=r"group-0.neumat: digest: is another than red.neumat was fitted to"):
        read_whole_asset(tmp_path / "red.neumat")
    with pytest.raises(FormatError, match="is a group of primitives, no material"):
        read_whole_asset(folder[0] / "group-0.neumat")
    tensors, header = read_asset(folder[0] / "red.neumat")
    write_asset(tmp_path / "evil.neumat", tensors, {**header, "group": {"file": "../x.neumat", "digest": ""}})
    with pytest.raises(FormatError, match="group.file: must name a file beside this one"):
        read_whole_asset(tmp_path / "evil.neumat")
    shared, _ = read_asset(folder[0] / "group-0.neumat")
    changed = {**shared, "bias0": shared["bias0"] + np.float16(1)}
    assert digest(shared) != digest(changed)
