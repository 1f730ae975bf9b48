"""BTFs by name: what is one, how it is opened, and what a wrong name says."""

from pathlib import Path

import numpy as np
import pytest

from tests.io.test_ubo2003 import folder_of, pictures, zip_of
from tests.io.test_ubo2014 import btf_bytes, colours
from warp_neumat.io.btf_source import is_btf
from warp_neumat.simulation.open_btf import is_btf_spec, open_btf


@pytest.fixture
def files(tmp_path, rng):
    """One BTF of each form."""
    folder = folder_of(tmp_path, pictures(rng))
    (tmp_path / "cloth.BTF").write_bytes(btf_bytes(colours(rng)))
    return {"folder": folder, "zip": zip_of(tmp_path, folder), "btf": tmp_path / "cloth.BTF"}


def test_every_form_is_recognised_and_opened(files):
    for form, path in files.items():
        for spec in (path, str(path), f"{path}?scale=2"):
            assert is_btf_spec(spec), form
            source = open_btf(spec)
            assert is_btf(source)
            value = source.slices(np.array([[0, 0]]))
            assert value.shape == (1, source.height, source.width, 3)
        single = open_btf(f"{path}?scale=1").slices(np.array([[0, 0]]))
        assert float(value.max()) == pytest.approx(2 * float(single.max()), rel=1e-3)
    assert is_btf_spec("microgeometry:anything")  # of the form; whether it can be opened is another question
    source = open_btf("microgeometry:carpet?size=16&directions=ubo2003&tufts=4")
    assert (source.width, len(source.lights)) == (16, 81)
    assert source.opening == {"spec": "microgeometry:carpet?size=16&directions=ubo2003&tufts=4"}


def test_what_is_no_btf(tmp_path, files):
    for name in ("bricks_basecolor.png", "bricks_normal.png"):
        (tmp_path / "maps").mkdir(exist_ok=True)
        (tmp_path / "maps" / name).touch()
    for spec in (tmp_path / "maps", "analytic:ggx", "FILE.npz:gold", "a.binary", "missing", {"maps": {}}, 3, None):
        assert not is_btf_spec(spec)
    assert is_btf_spec("missing.btf")
    assert is_btf_spec(Path("missing.ZIP"))
    # Pictures up to two folders down tell, and nothing else does.
    deep = tmp_path / "a" / "b"
    deep.mkdir(parents=True)
    (deep / "00001 tl000 pl000 tv015 pv060.jpg").touch()
    assert is_btf_spec(tmp_path / "a")


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        ("missing.btf", FileNotFoundError, "missing.btf: no such file or folder; a BTF is FILE.btf"),
        ("maps", ValueError, "maps: not a BTF; known: FILE.btf"),
        ("cloth.BTF?gain=2", ValueError, "no option 'gain' here, or it is given twice; known: azimuth, scale"),
        ("cloth.BTF?scale=2&scale=3", ValueError, "no option 'scale' here, or it is given twice"),
        ("cloth.BTF?scale=large", ValueError, "scale must be a number, got 'large'"),
        ("UBO_TEST.zip?transfer=gamma", ValueError, "transfer"),
        ("microgeometry:wool", ValueError, "no pattern 'wool'; nearest: wood"),
        ("microgeometry:wood?samples=5", ValueError, "samples must be 4 or 16"),
        ("microgeometry:wood?rays=1e9", ValueError, r"rays must be a whole number in \[4, 256\]"),
        ("microgeometry:wood?size", ValueError, "must be given once, as size=VALUE"),
    ],
)
def test_wrong_names_are_one_line(files, tmp_path, monkeypatch, spec, error, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "maps").mkdir()
    with pytest.raises(error, match=message) as caught:
        open_btf(spec)
    assert "\n" not in str(caught.value)
