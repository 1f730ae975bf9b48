"""RGL measurements against Mitsuba's `measured` plugin on synthetic files, and broken files.

Mitsuba runs in its scalar variants: the LLVM ones abort the process with LLVM versions that lack instructions they use.
"""

import numpy as np
import pytest

from warp_neumat.io.brdf import open_brdf
from warp_neumat.io.rgl import RGL, read_rgl
from warp_neumat.io.spectra import rgb_weights
from warp_neumat.io.tensor_file import write_tensors

PHI = {
    "isotropic": [0.0],
    "isotropic, two azimuths": [-np.pi, np.pi],
    "anisotropic": np.linspace(-np.pi, np.pi, 9),
    "anisotropic, half": np.linspace(-np.pi, 0, 5),
    "anisotropic, quarter": np.linspace(-np.pi, -np.pi / 2, 4),
}


def directions(rng, count):
    z = rng.uniform(0.02, 1.0, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - z * z)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1).astype(np.float32)


def synthetic(rng, phi, bands=0, jacobian=1):
    """Positive random tables, blurred a little, of different sizes along every axis."""

    def table(*shape):
        a = rng.random(shape)
        for axis in (-1, -2):
            a = (np.roll(a, 1, axis) + a + np.roll(a, -1, axis)) / 3
        return (a + 0.05).astype(np.float32)

    p, t, n = len(phi), 6, 8
    turned = p <= 2  # isotropic: the same at every azimuth of ω

    def per_azimuth(*shape):
        return np.repeat(table(1, *shape), p, 0) if turned else table(p, *shape)

    fields = {
        "theta_i": np.linspace(0, np.pi / 2, t, dtype=np.float32),
        "phi_i": np.float32(phi),
        "ndf": table(12, 20),
        "sigma": np.repeat(table(1, 11), 9, 0) if turned else table(9, 11),
        "vndf": per_azimuth(t, 16, 18),
        "luminance": per_azimuth(t, n, n),
        "jacobian": np.array([jacobian], np.uint8),
        "description": "synthetic",
    }
    if bands:
        return {
            **fields,
            "wavelengths": np.linspace(360, 1000, bands, dtype=np.float32),
            "spectra": per_azimuth(t, bands, n, n),
        }
    return {**fields, "rgb": per_azimuth(t, 3, n, n)}


def mitsuba_values(path, wi, wo, variant="scalar_rgb", wavelengths=None):
    """f(ω_i, ω_o) from the plugin: its ``wi`` is the camera's side, and its value includes the cosine of the other."""
    mi = pytest.importorskip("mitsuba", reason="the peer is not installed")
    mi.set_variant(variant)
    bsdf, context, at = (
        mi.load_dict({"type": "measured", "filename": str(path)}),
        mi.BSDFContext(),
        mi.SurfaceInteraction3f(),
    )
    if wavelengths is not None:
        at.wavelengths = wavelengths
    values = []
    for i, o in zip(wi.tolist(), wo.tolist(), strict=True):
        at.wi = mi.Vector3f(*o)
        values.append(np.array(bsdf.eval(context, at, mi.Vector3f(*i))).ravel())
    return np.array(values) / wi[:, 2:]


@pytest.mark.parametrize("jacobian", [1, 0])
@pytest.mark.parametrize("kind", PHI)
def test_rgl_matches_mitsuba(tmp_path, rng, kind, jacobian):
    path = write_tensors(tmp_path / "a.bsdf", synthetic(rng, PHI[kind], jacobian=jacobian))
    wi, wo = directions(rng, 1500), directions(rng, 1500)
    wi[:300] = wo[:300] * (-1, -1, 1)  # half vectors at the pole, whose azimuth is rounding: moved off it
    wi[:300] += np.float32(0.01) * wi[:300, ::-1]
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    if kind.startswith("isotropic"):
        # Mitsuba leaves its symmetry flag unset for these files, and so may mirror ω_o into the third quadrant by
        # chance: pairs are turned there by right angles, where a mirror changes nothing.
        for _ in range(3):
            turn = (wo[:, 0] > 0) | (wo[:, 1] > 0)
            for w in (wi, wo):
                w[turn] = np.stack([-w[turn, 1], w[turn, 0], w[turn, 2]], 1)
    source = open_brdf(str(path))
    assert source.symmetry == "none"
    assert source.isotropic == kind.startswith("isotropic")
    got, expected = source.eval(wi, wo), mitsuba_values(path, wi, wo)
    assert expected.mean() > 0.1
    # Worst seen 9e-7; x 4.
    assert (np.abs(got - expected) / (1 + expected)).max() < 4e-6


@pytest.mark.parametrize("kind", ["isotropic", "isotropic, two azimuths"])
def test_isotropic_file_is_isotropic(tmp_path, rng, kind):
    fields = synthetic(rng, PHI[kind])
    fields["sigma"] = fields["ndf"]  # varies with the azimuth, as noise may
    source = read_rgl(write_tensors(tmp_path / "a.bsdf", fields))
    assert any("sigma varies by" in note for note in source.notes)
    wi, wo = directions(rng, 3000), directions(rng, 3000)
    c, s = np.cos(1.1), np.sin(1.1)
    turn = np.float32([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    a, b = source.eval(wi, wo), source.eval(wi @ turn, wo @ turn)
    assert (np.abs(a - b) / (1 + a)).max() < 1e-3


def test_spectra_are_converted_as_each_value_would_be(tmp_path, rng):
    # Mitsuba evaluates four wavelengths at a time; all 12 of the file, weighted, must be our RGB.
    fields = synthetic(rng, PHI["anisotropic"], bands=12)
    path = write_tensors(tmp_path / "a.bsdf", fields)
    wi, wo = directions(rng, 150), directions(rng, 150)
    source = read_rgl(path)
    nm = fields["wavelengths"]
    spectra = np.concatenate(
        [mitsuba_values(path, wi, wo, "scalar_spectral", nm[k : k + 4].tolist()) for k in (0, 4, 8)], 1
    )
    expected = np.maximum(spectra @ rgb_weights(nm).T, 0)
    got = source.eval(wi, wo)
    assert (np.abs(got - expected) / (1 + expected)).max() < 2e-4
    assert any("12 wavelengths (360 to 1000 nm) as linear Rec. 709 under D65" in note for note in source.notes)


def test_below_the_horizon_and_odd_pairs(tmp_path, rng):
    source = read_rgl(write_tensors(tmp_path / "a.bsdf", synthetic(rng, PHI["anisotropic, half"])))
    up, flat = np.float32([0, 0, 1]), np.float32([1, 0, 0])
    odd = np.float32([up, flat, -up, -flat, [1e-30, 0, 1], [1, 0, 1e-38], [-1, 0, 1e-38], [0, -1, 1e-6], [np.nan] * 3])
    wi, wo = np.repeat(odd, len(odd), 0), np.tile(odd, (len(odd), 1))
    value = source.eval(wi, wo)
    assert np.isfinite(value).all()
    assert (value >= 0).all()
    assert (value[~((wi[:, 2] > 0) & (wo[:, 2] > 0))] == 0).all()


def test_negative_and_missing_entries_are_counted(rng):
    fields = synthetic(rng, [0.0])
    fields["rgb"][0, 2, 1, 3, 3] = np.nan
    fields["rgb"][0, 3, 0, 4, 4:6] = -1
    source = RGL("x", {**fields, "description": np.frombuffer(b"brass\0", np.uint8)})
    assert source.masked == 1
    assert source.notes == (
        "file says: brass",
        "1 of 1152 entries are not finite, and count as 0",
        "2 of 1152 entries are negative (noise); values below 0 are returned as 0",
    )


def test_wrong_fields_are_explained(tmp_path, rng):
    good = synthetic(rng, PHI["anisotropic"])
    path = tmp_path / "a.bsdf"
    for change, message in (
        ({"vndf": None}, r"a\.bsdf: not an RGL measurement, it has no field vndf; it has .*ndf"),
        ({"rgb": None}, "it has no field rgb, or spectra with wavelengths"),
        ({"sigma": np.ones(3, np.float32)}, r"a\.bsdf: field sigma must have 2 dimensions, got shape \(3,\)"),
        ({"vndf": good["vndf"][:, :5]}, r"field vndf must begin with \(9, 6\), got shape"),
        ({"rgb": good["rgb"][:, :, :2]}, "field rgb must hold 3 bands"),
        ({"ndf": np.ones((1, 4), np.float32)}, "field ndf must be at least 2 by 2"),
        ({"theta_i": good["theta_i"][::-1]}, "field theta_i must ascend"),
        ({"phi_i": good["phi_i"] / 3}, "phi_i must span 360°, 180° or 90°, not 120°"),
    ):
        fields = {key: value for key, value in {**good, **change}.items() if value is not None}
        write_tensors(path, fields)
        with pytest.raises(ValueError, match=message):
            read_rgl(path)
