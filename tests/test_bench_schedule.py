"""The scheduler's benchmarks around their measurements: scenes, turns, settings, verdicts, plots and the command."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from bench import __main__ as command
from bench import _schedule_lab as lab
from bench import pareto, skip
from warp_neumat import metrics
from warp_neumat.pipeline.renderer import SKIPS


def test_cloth_moves_smoothly_and_is_hardly_stretched():
    sequence = lab.cloth(frames=6, cells=32)
    assert sequence.frame_count == 6
    assert sequence.face_double_sided.all()
    frames = [sequence.frame(k) for k in range(6)]
    steps = [np.linalg.norm(b.points - a.points, axis=1).max() for a, b in zip(frames, frames[1:], strict=False)]
    assert min(steps) > 0.001
    assert max(steps) < 0.1  # of a sheet 3 wide
    edges = sequence.faces[:, [0, 2]]  # along the rail
    lengths = [np.linalg.norm(np.diff(f.points[edges], axis=1), axis=2) for f in frames]
    assert np.abs(lengths[5] / lengths[0] - 1.0).mean() < 0.15
    turned = (frames[0].normals * frames[5].normals).sum(axis=1)
    assert turned.min() < 0.99
    rail = frames[0].points[:, 1] == frames[0].points[:, 1].max()
    assert np.abs(frames[5].points[rail] - frames[0].points[rail]).max() < 0.01


def test_cloth_of_fewer_frames_is_the_same_beginning():
    assert np.array_equal(lab.cloth(3, 8).frame(2).points, lab.cloth(5, 8).frame(2).points)


def test_scenes_move_what_they_say(data, monkeypatch):
    monkeypatch.setenv("NEUMAT_DATA", str(data))

    def moves(scene):
        cameras = [scene.camera.at(k).eye for k in (0, 5)]
        lights = [scene.lights.at(k).position for k in (0, 5)]
        points = [scene.sequence.frame(k).points for k in (0, 5)]
        return [not np.array_equal(*pair) for pair in (cameras, lights, points)]

    scenes = {name: lab.open_scene(name, (64, 36), 6) for name in lab.SCENES}
    assert moves(scenes["fox"]) == [True, False, True]
    assert moves(scenes["helmet"]) == [False, True, False]
    assert moves(scenes["cloth"]) == [True, False, True]
    assert (scenes["helmet"].lights.at(0).position[1:] == scenes["helmet"].lights.at(5).position[1:]).all()
    assert scenes["fox"].frames == 6


def test_a_path_is_a_scene_as_long_as_its_frames(tmp_path):
    points = np.random.default_rng(1).random((4, 3, 3), dtype=np.float32)
    np.savez(tmp_path / "three.npz", points=points, faces=np.array([[0, 1, 2]], np.int32))
    scene = lab.open_scene(str(tmp_path / "three.npz"), (64, 36))
    assert (scene.name, scene.frames, len(scene.lights)) == ("three", 4, 3)


def test_an_unknown_scene_is_refused_by_name():
    with pytest.raises(ValueError, match="SEQUENCE must be one of fox, helmet, cloth, or a path, got 'dog'"):
        lab.open_scene("dog", (64, 36))


def test_materials_are_fitted_once_and_kept(data, monkeypatch, tmp_path):
    pytest.importorskip("torch")
    monkeypatch.setenv("NEUMAT_DATA", str(data))
    monkeypatch.setenv("NEUMAT_CACHE", str(tmp_path))
    fitted = []

    def fit(source, out, **_):
        fitted.append(source)
        out.write_text("asset")

    monkeypatch.setattr("warp_neumat.training.fit.fit", fit)
    path = lab.material_path("matt", quick=False)
    assert path.is_relative_to(tmp_path)
    assert lab.material_path("matt", quick=False) == path
    assert [spec.rpartition(":")[2] for spec in fitted] == ["green-fabric"]
    assert lab.material_path("glossy", quick=False) != path
    assert lab.material_path("matt", quick=True).name == "lacquer.neumat"
    assert len(fitted) == 2


def test_turns_start_one_renderer_further_each_frame():
    order = []

    def renderer(name):
        def frame(index):
            order.append((name, index))
            stats = {"evaluations": 10 * index, "ms": {"shade": 2.0 + index, "mark": 1.0}}
            return SimpleNamespace(stats=stats, image=np.full(3, index))

        return SimpleNamespace(frame=frame)

    seen = []
    scene = SimpleNamespace(posed=lambda k: order.append(("pose", k)))
    renderers = {name: renderer(name) for name in "ab"}
    taken = lab.take_turns(scene, renderers, [4, 7], "", lambda *look: seen.append(look))
    assert order == [("pose", 4), ("a", 4), ("b", 4), ("pose", 7), ("b", 7), ("a", 7)]
    assert [(place, name, image[0]) for place, name, image in seen] == [
        (0, "a", 4),
        (0, "b", 4),
        (1, "b", 7),
        (1, "a", 7),
    ]
    assert taken["a"].evaluations.tolist() == [40, 70]
    assert taken["b"].stage("shade", "mark").tolist() == [7.0, 10.0]
    assert len(taken["a"].ms) == 2


def test_flicker_is_what_changes_in_the_error(rng):
    before, now = rng.random((2, 8, 9, 3), dtype=np.float32)
    wrong = 0.1 * rng.random((8, 9, 3), dtype=np.float32)
    assert metrics.flicker(now, now + wrong, before, before + wrong) == pytest.approx(0.0, abs=1e-7)
    assert metrics.flicker(now, now + wrong, before, before) == pytest.approx(wrong.mean(), rel=1e-5)
    assert metrics.flicker(now, before, before, before) == pytest.approx(np.abs(now - before).mean(), rel=1e-5)
    with pytest.raises(ValueError, match=r"same shape, got \(8, 9, 3\) and \(4, 9, 3\)"):
        metrics.flicker(now, now, before[:4], before[:4])


def test_errors_are_of_each_frame_and_its_mesh(rng):
    errors = lab.Errors()
    picture = rng.random((32, 40, 3), dtype=np.float32)
    covered = np.zeros((32, 40), bool)
    covered[:, :20] = True
    other = picture.copy()
    other[:, :20] = 1.0 - other[:, :20]
    errors.add(picture, picture, covered)
    errors.add(picture, other, covered)
    errors.add(picture, other, ~covered)
    errors.add(picture, picture, None)
    assert errors.flip[0] == errors.flip_p95[0] == errors.mse[0] == 0.0
    assert errors.flip[1] == pytest.approx(metrics.flip(picture, other)[0])
    assert errors.flip_p95[1] > errors.flip_p95[2]
    assert errors.flicker == pytest.approx(
        [np.abs(picture - other).mean(), 0.0, np.abs(picture - other).mean()], abs=1e-6
    )
    assert (len(errors.flip), len(errors.mse)) == (3, 4)


def test_judged_frames_have_every_age_alike():
    frames = lab.judged(lab.FRAMES)
    assert len(frames) == 15
    for interval in pareto.INTERVALS:
        counts = np.bincount(np.array(frames) % (interval + 1), minlength=interval + 1)
        assert counts.min() >= len(frames) / (interval + 1) - 1.5
        assert counts.max() <= len(frames) / (interval + 1) + 1.5
    assert lab.judged(1) == [0]
    assert lab.judged(5) == [1, 2, 3, 4]


SPENT = {f"N = {n}": 1200.0 / (n + 1) for n in pareto.INTERVALS}


def test_settings_share_out_what_fixed_spends():
    assert {policy for policy, _ in pareto.settings({})} == {"every", "fixed"}
    chosen = pareto.settings(SPENT)
    assert "rate" not in chosen["fixed", "N = 4"]["skip"]
    assert set(chosen["fixed", "N = 4"]["skip"]) == set(SKIPS) - {"rate"}
    assert chosen["staggered", "N = 2"]["budget"] == 400.0
    for policy in ("staggered", "staggered+carry", "adaptive", "adaptive plain"):
        budgets = [o["budget"] for (name, _), o in chosen.items() if name == policy]
        assert {240.0, 80.0, 40.0} <= set(budgets)
        assert len(set(budgets)) == len(budgets)
    assert chosen["staggered+carry", "1/3 of N = 4"] == {"policy": "staggered", "carry": True, "budget": 80.0}
    assert [o["target_flip"] for (name, _), o in chosen.items() if name == "adaptive target"] == [0.005, 0.01, 0.02]
    assert set(pareto.settings(SPENT, quick=True)) < set(chosen)
    assert {policy for policy, _ in chosen} == set(pareto._COLORS)


def test_a_line_reaches_an_error_between_its_settings():
    line = [(400.0, 0.01), (100.0, 0.03)]
    count, bound = pareto.reached(line, 0.02)
    assert (count, bound) == (pytest.approx(200.0), "")
    assert pareto.reached(line, 0.01) == (pytest.approx(400.0), "")
    assert pareto.reached(line, 0.04) == (100.0, "at most")
    assert pareto.reached(line, 0.005) == (None, "never")


def _row(policy, setting, evaluations, flip, **more):
    shown = {"table": "pareto", "scene": "fox", "material": "matt", "policy": policy, "setting": setting}
    figures = {"evaluations": evaluations, "later": evaluations, "flip": flip, "ms": 1.0 + flip, "spread": 1.1}
    return {**shown, **figures, "schedule_share": 0.04, "alike": True, **more}


TABLE = [
    _row("every", "N = 0", 5000.0, 0.001),
    _row("fixed", "N = 4", 1000.0, 0.02),
    *[_row("staggered", s, e, f) for s, e, f in (("N = 4", 1000.0, 0.015), ("1/2 of N = 4", 500.0, 0.025))],
    *[_row("staggered+carry", s, e, f) for s, e, f in (("N = 4", 1000.0, 0.005), ("1/2 of N = 4", 500.0, 0.01))],
    *[_row("adaptive", s, e, f) for s, e, f in (("N = 4", 800.0, 0.012), ("1/2 of N = 4", 400.0, 0.03))],
    _row("adaptive plain", "N = 4", 900.0, 0.05, spread=1.4, alike=False),
]


def test_verdicts_name_shares_and_the_worst():
    found = {row["policy"]: row for row in pareto.verdicts(TABLE)}
    assert set(found) == {"staggered", "staggered+carry", "adaptive", "adaptive plain"}
    assert all(row["flip"] == 0.02 for row in found.values())
    assert found["staggered"]["share"] == pytest.approx(math.sqrt(0.5))
    assert "over_staggered" not in found["staggered"]
    assert (found["staggered+carry"]["share"], found["staggered+carry"]["bound"]) == (0.5, "at most")
    adaptive = found["adaptive"]
    assert adaptive["share"] == pytest.approx(0.4 * 2 ** (10 / 18))
    assert adaptive["over_staggered"] == pytest.approx(1.2)  # at the smaller budget; 0.8 at the larger
    assert adaptive["over_carried"] == pytest.approx(3.0)
    plain = found["adaptive plain"]
    assert (plain["bound"], plain["share"], plain["spread"], plain["alike"]) == ("never", None, 1.4, False)
    json.dumps(list(found.values()), allow_nan=False)


def test_the_plot_has_a_column_per_panel(tmp_path):
    pytest.importorskip("matplotlib")
    from warp_neumat.io.image import read_image

    more = [{**row, "material": "glossy"} for row in TABLE]
    files = pareto.draw(TABLE + more, tmp_path / "two.5")
    assert [file.name for file in files] == ["two.5.png", "two.5.svg"]
    picture = read_image(files[0])[0]
    half = picture.shape[1] // 2
    assert picture.shape[1] > 2 * 374  # pixels of a column, at least
    assert min(picture[:, :half].std(), picture[:, half:].std()) > 0.05
    assert files[1].read_text().count('id="axes_') == 4


def test_cost_is_what_the_spared_evaluations_did_not_bring():
    ours = {"texels": 10, "evaluations": 100, "ms": 9.0, "shade": 4.0}
    peer = {"texels": 40, "evaluations": 400, "ms": 11.0, "shade": 8.0}
    row = skip._beside(ours, peer)
    assert (row["spent"], row["peer_texels"]) == (0.25, 40)
    assert row["cost_ms"] == pytest.approx(4.0)  # 6 ms of shading are spared, the frame is shorter by 2
    assert row["ratio"] == pytest.approx(11 / 9)
    assert skip._beside(ours, {**peer, "evaluations": 0})["spent"] == 1.0


def test_every_skip_and_carry_has_a_row_that_differs_in_it_alone():
    scene = lab.Scene("cloth", (sequence := lab.cloth(2, 8)), lab._orbit(sequence, (64, 36)), None, (64, 36), 2)
    found = skip.cases(scene, 3, 200)
    assert {case.skip for case in found} == {*SKIPS, "carry", "atlas"}
    for case in found:
        on, off = ({**{"skip": SKIPS}, **options} for options in (case.on, case.off))
        same = {k for k in on | off if k != "skip" and on.get(k) == off.get(k)}
        if case.skip in SKIPS:
            assert set(on["skip"]) - set(off["skip"]) == {case.skip}
            assert not set(off["skip"]) - set(on["skip"])
            assert same == (on | off).keys() - {"skip"}
        else:
            assert set(on["skip"]) == set(off["skip"]) == set(SKIPS)


def test_local_lights_reach_a_part_of_the_bounds():
    lights = skip.local_lights((-1, -1, -1), (1, 1, 1))
    assert len(lights) == 12
    assert (lights.range < 2 * math.sqrt(3)).all()
    state = lights.at(0)
    spots = state.cones[:, 0] > 0
    assert spots.sum() == 6
    toward = -(state.position * [1, 0, 1])
    assert ((state.direction * toward).sum(axis=1) > 0)[spots].all()


@pytest.fixture
def sample(monkeypatch):
    """Benchmark modules, one that takes a sequence and draws, one that does not; what they were called with."""
    calls = []

    def drawn(*, device, quick, sequence=None, plot=None):
        calls.append((sequence, plot))
        yield {"n": 1}

    def plain(*, device, quick):
        calls.append("plain")
        yield {"n": 1}

    modules = {f"bench.{f.__name__}": SimpleNamespace(rows=f, COLUMNS=["n"]) for f in (drawn, plain)}
    monkeypatch.setattr(command, "available", lambda: {"drawn": "", "plain": ""})
    monkeypatch.setattr(command.importlib, "import_module", modules.__getitem__)
    return calls


def test_a_sequence_reaches_those_that_take_one(sample, tmp_path, capsys):
    assert command.main(["drawn"]) == 0
    assert command.main(["drawn", "fox", "--json", str(tmp_path / "a.b.json")]) == 0
    assert command.main(["plain"]) == 0
    assert [(s, str(p)) for s, p in sample[:2]] == [(None, "out/drawn"), ("fox", str(tmp_path / "a.b"))]
    capsys.readouterr()
    assert command.main(["plain", "fox"]) == 2
    assert capsys.readouterr().err == "bench: plain takes no SEQUENCE, got 'fox'\n"
    assert len(sample) == 3
