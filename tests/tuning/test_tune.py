"""Tuning: what it tries, what it chooses, what "auto" becomes, and that times are plausible."""

import dataclasses
import functools
import re
import sys

import numpy as np
import pytest
from test_point_sample import make_scene

import warpshadow as ws
from warpshadow.scene import blockers
from warpshadow.spheres.refine import Refinement
from warpshadow.tuning import tune
from warpshadow.tuning.point_sample import PointSample
from warpshadow.tuning.tune import Trial, pareto_front, resolved

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@pytest.fixture(autouse=True)
def small_sample(monkeypatch):
    """Fewer points and rays, so that a test takes no time."""
    monkeypatch.setattr(tune, "PointSample", functools.partial(PointSample, count=200, direction_count=256))


@pytest.fixture
def few(monkeypatch):
    """Fewer settings."""
    monkeypatch.setattr(tune, "DIRECTION_COUNTS", (32, 64))
    monkeypatch.setattr(tune, "ORDERS", (4,))
    monkeypatch.setattr(tune, "LOGS", ("eigen",))


@pytest.fixture
def instant(few, monkeypatch):
    """Times that are given, the same each time: 1 ms a setting, in the order in which they are tried."""
    given = {}

    def estimate(scenes, **_):
        given.update({id(scene): 1.0 + number for number, scene in enumerate(scenes)})
        return [given[id(scene)] for scene in scenes]

    monkeypatch.setattr(tune, "image_times", estimate)
    monkeypatch.setattr(tune, "whole_image_times", lambda scenes, **_: [given[id(scene)] for scene in scenes])


@pytest.fixture
def fitted(monkeypatch):
    """Fits that take no time and are worse than they need be: a ball of so many equal spheres; what was asked for."""
    asked = []

    def fit(mesh, count, **_):
        asked.append(count)
        radius = 0.6 * (1 - 1 / count)
        return ws.spheres.SphereFit(ws.Spheres(np.zeros((count, 3)), np.full(count, radius)), None)

    monkeypatch.setattr(blockers, "fit_spheres", fit)
    return asked


def asking(count, **options):
    """The scene with a ball that asks for so many spheres."""
    scene = make_scene(**options)
    ball, ground = scene.bodies
    return dataclasses.replace(scene, bodies=(dataclasses.replace(ball, blockers=count), ground))


def error_of(scene):
    sample = tune.PointSample(scene)
    return sample.error(sample.shading(scene))


# ---------------------------------------------------------------------------------------------- the choice


def test_the_front_is_what_no_other_point_beats():
    assert pareto_front([(1, 9), (2, 5), (2, 4), (3, 4), (4, 7), (5, 1), (5, 1)]) == [0, 2, 5]
    assert pareto_front([]) == []


def test_the_cheapest_setting_that_reaches_an_error_is_chosen(instant):
    scene = make_scene()
    errors = [trial.error for trial in ws.tune(scene, error=1).trials]
    wanted = sorted(errors)[len(errors) // 2]
    tuning_ = ws.tune(scene, error=wanted)
    assert tuning_.is_reached and tuning_.error <= wanted
    first = next(trial.milliseconds for trial in tuning_.trials if trial.error <= wanted)
    assert first <= tuning_.milliseconds <= 1.1 * first
    assert tuning_.error == pytest.approx(error_of(tuning_.scene), rel=1e-6)


def test_the_most_accurate_setting_within_a_time_is_chosen(instant):
    tuning_ = ws.tune(make_scene(), milliseconds=3.5)
    assert tuning_.is_reached
    assert tuning_.error == min(trial.error for trial in tuning_.trials[:3])


def test_settings_that_miss_the_error_are_not_timed(few, monkeypatch):
    timed = []

    def times(scenes, **_):
        timed.extend(scenes)
        return [1.0] * len(scenes)

    monkeypatch.setattr(tune, "image_times", times)
    monkeypatch.setattr(tune, "whole_image_times", lambda scenes, **_: [1.0] * len(scenes))
    errors = sorted(trial.error for trial in ws.tune(make_scene(), milliseconds=1.0).trials)
    assert len(timed) == len(errors)  # within a time all are
    timed.clear()
    found = ws.tune(make_scene(), error=errors[1])
    late = {id(trial.scene) for trial in found.trials if trial.milliseconds == np.inf}
    least = max(errors[1], errors[0] + max(0.1 * errors[0], 0.003))
    assert {trial.error <= least for trial in found.trials if id(trial.scene) in late} == {False}
    assert {id(scene) for scene in timed} | late == {id(trial.scene) for trial in found.trials}
    assert "– not timed" in str(found) and str(found).count("  –\n") >= len(late)


def test_where_nothing_reaches_it_the_nearest_is_chosen_and_said_not_to_reach_it(instant):
    by_error, by_time = ws.tune(make_scene(), error=1e-9), ws.tune(make_scene(), milliseconds=0.5)
    assert not by_error.is_reached and not by_time.is_reached
    least = min(trial.error for trial in by_error.trials)
    assert least <= by_error.error <= least + max(0.1 * least, 0.003)
    assert by_time.milliseconds == 1


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ((0.062, 0.052, 0.050), 0.052),  # 0.2 points are not worth 146 ms
        ((0.008, 0.0055, 0.004), 0.0055),
        ((0.50, 0.48, 0.20), 0.20),
    ],
)
def test_where_nothing_is_accurate_enough_a_hair_of_accuracy_is_not_worth_the_time(errors, expected):
    trials = [Trial(None, error, time) for error, time in zip(errors, (8.0, 21.0, 146.0), strict=True)]
    assert tune._nearest(trials).error == expected


@pytest.mark.slow
def test_numbers_of_spheres_that_were_not_tried_are_told(instant, fitted, monkeypatch):
    monkeypatch.setattr(tune, "is_fitted", lambda mesh, count, **_: count in (16, 64))
    assert ws.tune(asking(24), error=1e-9).untried_counts == (32, 128, 256, 512)
    assert ws.tune(asking(24), error=1e-9, fits=True).untried_counts == ()
    assert ws.tune(make_scene(), error=1e-9).untried_counts == ()  # of given spheres


@pytest.mark.parametrize("noise", [(1, 1, 1), (1.03, 0.98, 1), (0.97, 1.02, 1.03)])
def test_of_settings_about_as_fast_the_more_accurate_is_chosen_so_that_noise_does_not_decide(noise):
    trials = [
        Trial(None, error, factor * time)
        for error, time, factor in zip((0.03, 0.02, 0.01), (10.0, 10.2, 12.0), noise, strict=True)
    ]
    assert tune._cheapest(trials).error == 0.02


def test_what_is_chosen_by_error_is_the_same_each_time(instant):
    chosen = [ws.tune(make_scene(), error=0.1) for _ in range(2)]
    assert chosen[0].error == chosen[1].error
    assert chosen[0].toml() == chosen[1].toml()


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({}, "error, milliseconds: got neither, expected one of them"),
        ({"error": 0.1, "milliseconds": 5.0}, "error, milliseconds: got both"),
        ({"error": 0.0}, "error: got 0.0, expected a positive number"),
        ({"milliseconds": float("nan")}, "milliseconds: got nan"),
    ],
)
def test_what_cannot_be_wanted_is_refused(wanted, message):
    with pytest.raises(ValueError, match=message):
        ws.tune(make_scene(), **wanted)


# ---------------------------------------------------------------------------------------------- what is tried


def test_all_methods_are_tried_with_the_scenes_own_spheres_and_receivers(instant):
    scene = make_scene(visibility=ws.Visibility(softness=0.5))
    trials = ws.tune(scene, error=1).trials
    tried = {(trial.scene.visibility.method, trial.scene.bodies[0].receivers) for trial in trials}
    assert tried >= {(method, "auto") for method in ("none", "directional", "log-sh")}
    settings = [trial.scene.visibility for trial in trials]
    assert {each.softness for each in settings if each.method == "directional"} == {0.5}
    assert all(trial.scene.bodies[0].blockers is scene.bodies[0].blockers for trial in trials)


def test_pixels_are_tried_as_receivers_where_vertices_miss_shadows(instant):
    coarse = dataclasses.replace(make_scene().bodies[1], mesh=ws.plane(4.0, 2), receivers="vertex")
    scene = dataclasses.replace(make_scene(), bodies=(make_scene().bodies[0], coarse))
    trials = ws.tune(scene, error=1).trials
    assert {trial.scene.bodies[1].receivers for trial in trials} == {"vertex", "pixel"}
    own, other = (
        min(trial.error for trial in trials if trial.scene.bodies[1].receivers == kind) for kind in ("vertex", "pixel")
    )
    assert other < 0.5 * own


def test_only_spheres_that_were_fitted_before_are_tried_unless_fits_are_wanted(instant, fitted, monkeypatch):
    monkeypatch.setattr(tune, "is_fitted", lambda mesh, count, **_: count in (16, 64))
    counts = {trial.scene.bodies[0].blockers for trial in ws.tune(asking(24), error=1).trials}
    assert counts == {16, 24, 64}
    counts = {trial.scene.bodies[0].blockers for trial in ws.tune(asking(24), error=1, fits=True).trials}
    assert counts == {24, *tune.SPHERE_COUNTS}


@pytest.mark.slow
def test_a_fit_that_is_kept_is_known_to_be(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    mesh = ws.icosphere(1.0, 1)
    assert not ws.spheres.is_fitted(mesh, 2)
    run = Refinement.run
    monkeypatch.setattr(Refinement, "run", lambda self, start, steps: run(self, start, 1))  # of many steps, the first
    ws.fit_spheres(mesh, 2)
    assert ws.spheres.is_fitted(mesh, 2)
    assert ws.spheres.is_fitted(mesh.transformed(scale=3.0), 2)
    assert not ws.spheres.is_fitted(mesh, 3)


def test_grounds_and_given_spheres_are_not_fitted():
    assert blockers.fitted_counts(make_scene()) == {}
    assert blockers.fitted_counts(asking(24)) == {0: 24}
    assert blockers.fitted_counts(asking(0)) == {}


# ---------------------------------------------------------------------------------------------- what is said


def test_the_settings_are_lines_of_a_scene_file(instant, fitted, monkeypatch):
    monkeypatch.setattr(tune, "is_fitted", lambda mesh, count, **_: count == 64)
    scene = asking(24)
    found = ws.tune(scene, error=1)
    for trial in found.trials:
        text = dataclasses.replace(found, chosen=trial).toml()
        lines, visibility = tomllib.loads(text), trial.scene.visibility
        assert lines["visibility"].items() <= dataclasses.asdict(visibility).items()
        assert ws.Visibility(**lines["visibility"]).method == visibility.method
        numbers = [int(number) for number in re.findall(r"^\[\[body\]\]  # body (\d+) \('", text, re.M)]
        changes = dict(zip(numbers, lines.get("body", []), strict=True))
        for number, (before, after) in enumerate(zip(scene.bodies, trial.scene.bodies, strict=True)):
            changed = dataclasses.replace(before, **changes.get(number, {}))
            assert (changed.blockers, changed.receivers) == (after.blockers, after.receivers)


def test_the_table_has_a_line_for_each_trial_and_marks_the_front_and_the_choice(instant):
    found = ws.tune(make_scene(), error=0.2)
    _, *lines = found.table().splitlines()
    assert len(lines) == len(found.trials)
    front = pareto_front([(trial.milliseconds, trial.error) for trial in found.trials])
    assert [number for number, line in enumerate(lines) if line[1] == "*"] == sorted(front)
    assert [number for number, line in enumerate(lines) if line[0] == ">"] == [found.trials.index(found.chosen)]
    assert f"{found.error:.2%}" in lines[found.trials.index(found.chosen)]


def test_it_says_of_which_image_times_are(instant):
    scene = make_scene()
    found = ws.tune(scene, error=0.2)
    head, table = str(found).split(found.table())
    camera = scene.camera
    assert f"{camera.width} × {camera.height}, {scene.supersampling} × {scene.supersampling} samples a pixel" in head
    assert "after all bodies have moved" in head and "extrapolated" in head
    assert "> chosen" in table
    assert "> nearest" in str(dataclasses.replace(found, is_reached=False))
    bounced = [trial._replace(scene=dataclasses.replace(scene, bounces=1)) for trial in found.trials]
    assert "extrapolated" not in str(dataclasses.replace(found, trials=bounced))


def test_times_on_the_front_are_those_of_whole_images(few, monkeypatch):
    """With estimates that put the slowest first, and are wrong the other way round."""
    monkeypatch.setattr(tune, "image_times", lambda scenes, **_: [100.0 - n for n in range(len(scenes))])
    whole = []

    def times(scenes, **_):
        whole.extend(scenes)
        return [200.0 + len(whole)] * len(scenes)

    monkeypatch.setattr(tune, "whole_image_times", times)
    found = ws.tune(make_scene(), error=0.2)
    front = [found.trials[number] for number in pareto_front([trial[:0:-1] for trial in found.trials])]
    assert front and all(trial.milliseconds > 200 and trial.scene in whole for trial in front)
    assert len({id(scene) for scene in whole}) == len(whole)
    assert found.milliseconds > 200


@pytest.mark.parametrize(("load", "is_busy"), [(1.9, False), (3.2, True)])
def test_it_says_that_the_machine_is_busy(instant, monkeypatch, recwarn, load, is_busy):
    monkeypatch.setattr(tune.os, "getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr(tune.os, "cpu_count", lambda: 2)
    ws.tune(make_scene(), error=0.2)
    said = [str(each.message) for each in recwarn if "busy" in str(each.message)]
    assert len(said) == is_busy
    assert all("load average 3.2 on 2 cores" in each for each in said)


# ---------------------------------------------------------------------------------------------- "auto"


def auto(scene, error):
    return dataclasses.replace(scene, visibility=ws.Visibility(method="auto", error=error))


def test_auto_becomes_the_first_setting_that_reaches_the_error():
    scene = make_scene()
    errors = [
        error_of(dataclasses.replace(scene, visibility=visibility))
        for visibility in (ws.Visibility(method="none"), *(ws.Visibility(directions=n) for n in (32, 64, 128)))
    ]
    assert errors[0] > errors[1] > errors[2]
    for wanted, method, directions in ((1.01 * errors[0], "none", None), (1.01 * errors[1], "directional", 32)):
        found = resolved(auto(scene, wanted)).visibility
        assert (found.method, found.directions) == (method, directions)
    assert resolved(auto(scene, (errors[1] + errors[2]) / 2)).visibility.directions == 64


@pytest.mark.parametrize("method", ["directional", "none", "ray-traced"])
def test_another_method_stays_as_it_is(method):
    scene = dataclasses.replace(make_scene(), visibility=ws.Visibility(method))
    assert resolved(scene) is scene


def test_where_none_is_named_it_is_that_of_renderers():
    assert resolved(make_scene()).visibility.method == "directional"


def test_the_choice_is_made_once_for_a_scene(monkeypatch):
    scene = auto(make_scene(), 0.5)
    first = resolved(scene)
    monkeypatch.setattr(tune, "PointSample", None)
    assert resolved(scene) is first


def test_auto_takes_more_spheres_where_directions_do_not_help(few, fitted):
    scene = asking(2)
    own = error_of(dataclasses.replace(scene, visibility=ws.Visibility(directions=64)))
    more = error_of(dataclasses.replace(asking(8), visibility=ws.Visibility(directions=64)))
    assert more < 0.6 * own
    found = resolved(auto(scene, 1.05 * more))
    assert found.bodies[0].blockers in (4, 8)
    assert found.bodies[1] is scene.bodies[1]
    assert error_of(found) <= 1.05 * more


def test_auto_warns_where_nothing_reaches_the_error_and_takes_the_nearest(few):
    with pytest.warns(
        UserWarning, match=r"no setting of method = 'auto' reaches error = 0.0001; directional \d+"
    ) as caught:
        found = resolved(auto(make_scene(), 1e-4))
    assert "interpolation between vertices alone has" in str(caught[0].message)
    assert error_of(found) <= error_of(dataclasses.replace(make_scene(), visibility=ws.Visibility(directions=64)))


def test_auto_does_not_fit_spheres_that_could_not_help(few, fitted):
    with pytest.warns(UserWarning, match="receivers = 'pixel'"):
        resolved(auto(asking(2), 1e-4))
    assert set(fitted) == {2}


def test_a_renderer_shows_what_was_chosen():
    scene = auto(make_scene(), 0.5)
    renderer = ws.Renderer(scene)
    assert renderer.scene.visibility is resolved(scene).visibility
    np.testing.assert_array_equal(renderer.render(), ws.Renderer(resolved(scene)).render())


def test_a_problem_makes_the_choice_once_and_its_still_method_is_not_left_open():
    from warpshadow import inverse

    scene = auto(make_scene(), 0.5)
    target = inverse.Target(np.full((40, 48, 3), 0.5, np.float32))
    assert inverse.Problem(scene, target, inverse.Albedo(0)).scene is resolved(scene)
    with pytest.raises(ValueError, match="still.method: got 'auto'"):
        inverse.Problem(scene, target, inverse.Albedo(0), still=ws.Visibility(method="auto"))


def test_errors_can_be_against_all_light_that_bounces(instant, monkeypatch):
    monkeypatch.setattr(tune, "BOUNCE_COUNTS", (0, 2))
    tuning = tune.tune(make_scene(), error=1e-6, bounces=4)
    errors = {count: min(t.error for t in tuning.trials if t.scene.bounces == count) for count in (0, 2)}
    assert errors[2] < 0.7 * errors[0]
    assert tuning.scene.bounces == 2
    assert tomllib.loads(tuning.toml())["light"] == {"bounces": 2}


def test_auto_of_a_scene_with_bounces_has_shadows_and_bounces(few):
    scene = make_scene(visibility=ws.Visibility("auto", error=0.5))
    chosen = resolved(dataclasses.replace(scene, bounces=1))
    assert (chosen.visibility.method, chosen.bounces) == ("directional", 1)


@pytest.mark.parametrize(("feature", "bounces"), [("gloss", 0), ("gloss", 1), ("emission", 0), ("near light", 1)])
def test_scenes_of_which_one_method_shows_all_are_tuned_and_left_to_auto(few, feature, bounces):
    scene = dataclasses.replace(make_scene(), bounces=bounces)
    ball, ground = scene.bodies
    if feature == "gloss":
        ball = dataclasses.replace(ball, roughness=0.4, receivers="auto")
    elif feature == "emission":
        ball = dataclasses.replace(ball, emission=(1.0, 1.0, 1.0))
    light = ws.EnvironmentMap(scene.light.radiance, radius=9.0) if feature == "near light" else scene.light
    scene = dataclasses.replace(scene, bodies=(ball, ground), light=light)
    tuning = ws.tune(scene, error=0.1, progress=False)
    methods = {trial.scene.visibility.method for trial in tuning.trials}
    assert methods == {"directional"} | ({"none"} if not bounces else set())
    counts = {trial.scene.visibility.directions for trial in tuning.trials} - {None}
    assert counts == ({128} if feature == "gloss" else {32, 64})
    assert tuning.is_reached and ws.render(tuning.scene, progress=False)[..., 3].any()
    automatic = dataclasses.replace(scene, visibility=ws.Visibility("auto", error=0.1))
    assert resolved(automatic).visibility.method == "directional"
    assert "shading" in str(ws.Renderer(automatic, progress=False).explain())


def test_an_interrupted_run_leaves_the_errors_that_it_measured(instant, monkeypatch, capsys):
    shading, count = PointSample.shading, 0

    def interrupted(self, scene):
        nonlocal count
        count += 1
        if count > 5:
            raise KeyboardInterrupt
        return shading(self, scene)

    monkeypatch.setattr(PointSample, "shading", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tune.tune(make_scene(), error=0.1)
    head, *lines = [line for line in capsys.readouterr().err.splitlines() if re.search(r"error$|\d%$", line)]
    assert head.split() == ["method", "bounces", "spheres", "receivers", "error"] and 1 <= len(lines) <= 5


def test_settings_that_compile_kernels_come_first():
    scene = make_scene()
    methods = [("directional", 32), ("directional", 64), ("log-sh", None), ("directional", 128), ("none", None)]
    settings = [dataclasses.replace(scene, visibility=ws.Visibility(m, directions=n)) for m, n in methods]
    order, compiling_count = tune._measuring_order(settings)
    assert sorted(order) == list(range(5)) and compiling_count == 3
    assert {settings[number].visibility.method for number in order[:3]} == {"directional", "log-sh", "none"}
