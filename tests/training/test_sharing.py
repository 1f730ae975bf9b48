"""Materials that share primitives: grouping, files, joining, and what goes wrong."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat.io.asset import FormatError, read_asset, write_asset  # noqa: E402
from warp_neumat.io.brdf import open_brdf  # noqa: E402
from warp_neumat.io.shared_asset import digest, read_whole_asset  # noqa: E402
from warp_neumat.models import neubrdf  # noqa: E402
from warp_neumat.training.grouping import cluster, codes, groups, signature  # noqa: E402
from warp_neumat.training.sharing import fit_shared  # noqa: E402
from warp_neumat.training.sphere import render_sphere, sphere_error  # noqa: E402

TINY = {"nside": 4, "bits": 6, "features": 8, "hidden": (16, 16)}


def sources():
    return {
        "red": open_brdf("analytic:lambert?albedo=0.8,0.1,0.1"),
        "blue": open_brdf("analytic:lambert?albedo=0.1,0.1,0.8"),
        "metal": open_brdf("analytic:ggx?roughness=0.4&f0=0.9"),
        "gold": open_brdf("analytic:ggx?roughness=0.4&f0=0.9,0.6,0.2"),
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("shared") / "dir"
    seen, told = [], []
    headers = fit_shared(
        sources(), out, count=2, steps=260, progress=lambda f, t: seen.append(f), announce=told.append, **TINY
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
    mixed = [*sources().values(), open_brdf("analytic:ggx?roughness=0.4&anisotropy=0.8")]
    found = groups(mixed, 2)
    assert sorted(n for group in found for n in group) == [0, 1, 2, 3, 4]
    assert [4] in found
    assert [0, 1] in found  # the two matt ones
    assert signature(mixed[0].eval).shape == signature(mixed[4].eval).shape


def test_a_group_shares_codebook_and_decoder(folder):
    out, headers, seen, told = folder
    assert set(headers) == set(sources())
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    assert any("red, blue" in text for text in told)
    assert sorted(path.name for path in out.glob("group-*")) == ["group-0.neumat", "group-1.neumat"]
    assert not list(out.glob("*.checkpoint"))
    for name, source in sources().items():
        own, header = read_asset(out / f"{name}.neumat")
        assert set(own) <= {"indices", "live"}
        tensors, whole = read_whole_asset(out / f"{name}.neumat")
        assert whole["own_bytes"] == sum(t.nbytes for t in own.values()) == header["metrics"]["bytes"]
        model = neubrdf.from_asset(tensors, header["config"])
        error = sphere_error(render_sphere(model.evaluate, 64), render_sphere(source.eval, 64))
        # The number in the header is of a larger picture.
        assert error["mae"] == pytest.approx(header["metrics"]["mae"], rel=0.3, abs=1e-3)
        assert error["mae"] < 0.03


def test_a_material_joins_and_nothing_else_is_touched(folder, tmp_path):
    import shutil

    out = tmp_path / "dir"
    shutil.copytree(folder[0], out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    told = []
    added = {"copper": open_brdf("analytic:ggx?roughness=0.42&f0=0.9,0.5,0.3")}
    headers = fit_shared(added, out, steps=200, announce=told.append)
    assert told == ["copper: joins group-1.neumat, as gold"]
    assert {name: (out / name).read_bytes() for name in before} == before
    assert sorted({path.name for path in out.iterdir()} - set(before)) == ["copper.neumat"]
    tensors, header = read_whole_asset(out / "copper.neumat")
    model = neubrdf.from_asset(tensors, header["config"])
    picture = render_sphere(added["copper"].eval, 64)
    error = sphere_error(render_sphere(model.evaluate, 64), picture)["mae"]
    gold = neubrdf.from_asset(*(lambda t, h: (t, h["config"]))(*read_whole_asset(out / "gold.neumat")))
    assert error < sphere_error(render_sphere(gold.evaluate, 64), picture)["mae"]
    assert headers["copper"]["metrics"]["bytes"] == header["own_bytes"]
    with pytest.raises(ValueError, match="a group's shape is fixed: it cannot be given nside"):
        fit_shared({"x": added["copper"]}, out, nside=8)
    with pytest.raises(ValueError, match=r"copper.neumat: is there already"):
        fit_shared(added, out)


def test_an_interrupted_fit_goes_on(tmp_path):
    out, few = tmp_path / "dir", dict(list(sources().items())[:3])
    stop = []

    def progress(fraction, text):
        if fraction > 0.8 and not stop:
            stop.append(fraction)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_shared(few, out, count=2, steps=64, progress=progress, **TINY)
    done = {path.name: path.read_bytes() for path in out.glob("*.neumat")}
    assert done
    headers = fit_shared(few, out, count=2, steps=64, resume=True, **TINY)
    assert set(headers) == set(few)
    for name, content in done.items():
        assert (out / name).read_bytes() == content
    again = tmp_path / "again"
    fit_shared(few, again, count=2, steps=64, **TINY)
    for path in out.iterdir():
        assert (again / path.name).read_bytes() == path.read_bytes()


def test_files_that_do_not_belong_together_are_refused(folder, tmp_path):
    import shutil

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
