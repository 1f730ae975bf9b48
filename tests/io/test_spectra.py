"""Spectra to RGB: white stays white, the fit of the observer, and known colours."""

import numpy as np
import pytest

from warp_neumat.io.spectra import _D65, observer, rgb_weights


@pytest.mark.parametrize("nm", [np.linspace(360, 1000, 195), [400, 500, 650], [555.0], np.linspace(200, 300, 4)])
def test_flat_spectra_are_grey(nm):
    np.testing.assert_allclose(rgb_weights(nm) @ np.full(len(nm), 0.7), 0.7, rtol=1e-12)


def test_weights_integrate_the_piecewise_linear_spectrum(rng):
    nm = np.sort(rng.uniform(380, 900, 40))
    spectrum = rng.random(40)
    fine = np.arange(360.0, 831.0)
    np.testing.assert_allclose(
        rgb_weights(nm) @ spectrum, rgb_weights(fine) @ np.interp(fine, nm, spectrum), rtol=1e-10
    )


def test_reflectance_is_seen_under_d65():
    # By way of XYZ and the published matrix from Rec. 709 to it. Under another light the ramp's red is off by 2 %.
    nm = np.arange(360.0, 831.0)
    ramp = (nm - 360) / 470
    seen = observer(nm) * np.interp(nm, np.arange(360.0, 831.0, 10.0), _D65)
    xyz_of_rgb = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    expected = np.linalg.solve(xyz_of_rgb, (seen * ramp).sum(1) / seen[1].sum())
    np.testing.assert_allclose(rgb_weights(nm) @ ramp, expected, rtol=3e-3)


def test_bands_have_their_colour():
    nm = np.arange(360.0, 831.0)
    for channel, (low, high) in enumerate([(590, 700), (510, 570), (430, 480)]):
        rgb = rgb_weights(nm) @ ((nm > low) & (nm < high)).astype(float)
        assert rgb.argmax() == channel
    # Beyond red nothing is seen.
    assert np.abs(rgb_weights(nm) @ (nm > 780)).max() < 1e-4


def test_white_of_d65():
    nm = np.arange(360.0, 831.0)
    power = np.interp(nm, np.arange(360.0, 831.0, 10.0), _D65)
    xyz = (observer(nm) * power).sum(1)
    np.testing.assert_allclose(xyz / xyz[1], [0.95047, 1, 1.08883], atol=4e-4)


def test_tables_match_mitsuba():
    mi = pytest.importorskip("mitsuba", reason="the peer is not installed")
    mi.set_variant("scalar_spectral")
    nm = np.arange(360.0, 831.0, 10.0)
    theirs = np.array([np.array(mi.cie1931_xyz(float(w))).ravel() for w in nm]).T
    assert np.abs(observer(nm) - theirs).max() < 0.036
    light, at = mi.load_dict({"type": "d65"}), mi.SurfaceInteraction3f()
    power = []
    for w in nm:
        at.wavelengths = [float(w)] * 4
        power.append(np.array(light.eval(at)).ravel()[0])
    np.testing.assert_allclose(np.array(power) / power[20] * 100, _D65, atol=1e-3)


def test_wavelengths_must_ascend():
    with pytest.raises(ValueError, match="wavelengths must be one ascending row"):
        rgb_weights([400, 500, 500])
