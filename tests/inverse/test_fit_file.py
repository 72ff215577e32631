"""Fit files: every key, its default, and the message for everything that can be wrong with it."""

import functools
import warnings

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow import inverse
from warpshadow.assets.color import linear_to_srgb, srgb_to_linear
from warpshadow.inverse.fit_file import FitFileError, load_fit

SCENE = """
[camera]
eye = [0, 1, 4]
target = [0, 0, 0]
size = [8, 6]
[light]
sh = [[1, 1, 1], [0, 0, 0], [0.5, 0, 0], [0, 0, 0]]
[[body]]
primitive = "icosphere"
subdivisions = 1
blockers = 0
[[body]]
primitive = "plane"
segments = 1
"""
MINIMAL = 'scene = "scene.toml"\n[[target]]\nimage = "photo.exr"\n[free]\nlight = true\n'
# Half a step of 8-bit sRGB where it is steepest.
EIGHT_BITS = 0.006


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Load a text beside scene.toml and photo.exr, from another folder."""
    monkeypatch.chdir("/")
    (tmp_path / "scene.toml").write_text(SCENE)
    ws.write_image(tmp_path / "photo.exr", np.full((6, 8, 3), 0.5, np.float32))

    def load_text(text):
        (tmp_path / "fit.toml").write_text(text)
        return load_fit(tmp_path / "fit.toml")

    return load_text


@pytest.fixture
def refused(load):
    def refuse(text, *parts, error=FitFileError):
        with pytest.raises(error) as caught:
            load(text)
        for part in ("fit.toml: ", *parts):
            assert part in str(caught.value), f"{part!r} is not in {str(caught.value)!r}"

    return refuse


# ---------------------------------------------------------------------------------------------- what is right


def test_a_camera_that_is_framed_on_a_free_body_draws_a_warning_with_the_lines_to_write(load, tmp_path):
    placed = "eye = [0, 1, 4]\ntarget = [0, 0, 0]"
    framed = SCENE.replace(placed, 'framing = "auto"\ndirection = [1, 1, 2]').replace("blockers = 0", "blockers = 8")
    (tmp_path / "scene.toml").write_text(framed)
    free_pose = MINIMAL + "[[free.pose]]\nbody = 0\n"
    with pytest.warns(UserWarning, match="framed on the start .*but icosphere may have been elsewhere") as caught:
        camera = load(free_pose).problem.scene.camera
    lines = str(caught[0].message).partition("\n")[2]
    (tmp_path / "scene.toml").write_text(framed.replace('framing = "auto"\ndirection = [1, 1, 2]', lines))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        written = load(free_pose).problem.scene.camera
        (tmp_path / "scene.toml").write_text(framed)
        load(MINIMAL)  # no pose is free
        load(free_pose.replace("[free]", "[target.camera]\neye = [0, 1, 4]\ntarget = [0, 0, 0]\n[free]"))
    np.testing.assert_allclose(written.eye, camera.eye, atol=1e-4)
    np.testing.assert_allclose(written.rotation, camera.rotation, atol=1e-4)


def test_all_but_a_scene_a_target_and_what_is_free_has_the_defaults_of_python(load):
    fit = load(MINIMAL)
    problem = fit.problem
    assert problem.free == (inverse.Light(),)
    assert problem.loss == inverse.Loss()
    assert (problem.still.method, problem.still.samples) == ("ray-traced", ws.Visibility().samples)
    assert fit.stages == (inverse.Stage(),)
    assert (fit.optimizer, fit.tolerance, fit.seed) == (inverse.default_optimizer, 1e-4, 0)
    (target,) = problem.targets
    assert target.mask is None and target.camera is None
    np.testing.assert_array_equal(target.image, np.full((6, 8, 3), 0.5))
    assert len(problem.scene.bodies) == 2


def test_everything_that_can_be_free_is_read(load, tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE.replace("blockers = 0", "blockers = 8"))
    text = MINIMAL.replace("light = true", "light = {order = 3, nonnegativity = 0.5}\nexposure = true")
    fit = load(
        text + "camera = {focal = true}\n[[free.albedo]]\nbody = 0\nper_vertex = true\n"
        '[[free.pose]]\nbody = 0\nrotation = "6d"\nscale = true\n[[free.pose]]\nbody = 1\n'
        "[[free.texture]]\nbody = 1\nsize = [16, 8]\nsmoothness = 1\n"
        "total_variation = 0.1\npalette = 2\ncolors = 3\n"
        "[[free.deformation]]\nbody = 0\nrigidity = 3\ncount = 5\n[[free.radii]]\nbody = 0\npersistence = 0.5\n"
    )
    assert fit.problem.free == (
        inverse.Light(order=3, nonnegativity=0.5),
        inverse.Exposure(),
        inverse.CameraPose(focal=True),
        inverse.Albedo(0, per_vertex=True),
        inverse.Texture(1, (16, 8), smoothness=1.0, total_variation=0.1, palette=2.0, colors=3),
        inverse.Pose(0, rotation="6d", scale=True),
        inverse.Pose(1),
        inverse.Deformation(0, rigidity=3.0, count=5),
        inverse.Radii(0, persistence=0.5),
    )


def test_light_of_cells_takes_the_place_of_harmonics_and_what_is_false_is_not_free(load):
    fit = load(MINIMAL.replace("light = true", "light = {directions = 64}\ncamera = false\nexposure = false"))
    assert fit.problem.free == (inverse.Light(order=None, directions=64),)


def test_loss_still_tolerance_seed_and_stages_are_read(load):
    fit = load(
        "tolerance = 0\nseed = 7\n" + MINIMAL + '[loss]\nkind = "huber"\ndelta = 1\ncoverage = 0\nreduction = "sum"\n'
        "[still]\nmethod = 'directional'\nmerging = 0\n"
        "[[stage]]\niterations = 3\nlearning_rate = 1\nscale = 0.5\nsoftness = 2\n"
        "directions = 32\nsupersampling = 1\ncandidates = 4\n[[stage]]\n"
    )
    assert fit.problem.loss == inverse.Loss("huber", 1.0, 0.0, "sum")
    assert (fit.problem.still.method, fit.problem.still.merging) == ("directional", 0)
    assert fit.stages == (inverse.Stage(3, 1.0, 0.5, 2.0, 32, 1, 4), inverse.Stage())
    assert (fit.tolerance, fit.seed) == (0, 7)


def test_what_stands_still_is_seen_by_rays_unless_another_method_is_named(load):
    still = load(MINIMAL + "[still]\nsamples = 64\n").problem.still
    assert (still.method, still.samples) == ("ray-traced", 64)


def test_softness_where_no_shadow_has_any_is_refused(load):
    with pytest.raises(FitFileError, match=r"stages\[0\]: softness: got 2, which 'ray-traced' does not read"):
        load(MINIMAL + "[[stage]]\nsoftness = 2\n")
    with pytest.raises(FitFileError, match=r"\[still\]: softness: got 2, which 'ray-traced' does not read"):
        load(MINIMAL + "[still]\nsoftness = 2\n")


@pytest.mark.parametrize("name", ["pose", "deformation"])
def test_stages_that_work_can_be_named(load, name):
    make = {"pose": inverse.pose_stages, "deformation": inverse.deformation_stages}[name]
    fit = load(f'stages = "{name}"\n' + MINIMAL)
    assert fit.stages == make(fit.problem)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lines", "kind", "options"),
    [
        ('name = "adam"\n', torch.optim.Adam, {"betas": (0.8, 0.99)}),
        ("betas = [0.5, 0.75]\n", torch.optim.Adam, {"betas": (0.5, 0.75)}),
        ('name = "sgd"\nmomentum = 0.5\nnesterov = true\n', torch.optim.SGD, {"momentum": 0.5, "nesterov": True}),
        ('name = "rmsprop"\nalpha = 0.9\n', torch.optim.RMSprop, {"alpha": 0.9}),
        ('name = "lbfgs"\nmax_iter = 3\n', torch.optim.LBFGS, {"max_iter": 3, "line_search_fn": "strong_wolfe"}),
    ],
)
def test_every_optimizer_is_torchs_with_the_options_that_are_given(load, lines, kind, options):
    made = load(MINIMAL + "[optimizer]\n" + lines).optimizer([torch.zeros(1, requires_grad=True)], lr=0.25)
    assert type(made) is kind
    (group,) = made.param_groups
    assert {name: group[name] for name in options} == options
    assert all(type(group[name]) is type(value) for name, value in options.items())  # or a checkpoint cannot be read
    assert group["lr"] == 0.25


# ---------------------------------------------------------------------------------------------- targets


def target_of(load, tmp_path, pixels, name, lines=""):
    if pixels is not None:
        ws.write_image(tmp_path / name, pixels)
    return load(MINIMAL.replace("photo.exr", name).replace("[free]", lines + "[free]")).problem.targets[0]


def test_a_photograph_is_decoded_from_srgb_and_says_nothing_of_coverage(load, tmp_path):
    pixels = np.random.default_rng(0).uniform(size=(6, 8, 3)).astype(np.float32)
    target = target_of(load, tmp_path, pixels, "photo.png")
    assert np.abs(target.image - pixels).max() < EIGHT_BITS and target.image.shape[2] == 3


def test_a_rendered_exr_is_taken_as_it_is_with_its_coverage(load, tmp_path):
    pixels = np.random.default_rng(0).uniform(0, 9, size=(6, 8, 4)).astype(np.float32)
    np.testing.assert_array_equal(target_of(load, tmp_path, pixels, "photo.exr").image, pixels)


def test_the_straight_alpha_of_a_png_is_multiplied_in(load, tmp_path):
    pixels = np.random.default_rng(0).uniform(size=(6, 8, 4)).astype(np.float32)
    pixels[..., :3] *= pixels[..., 3:]
    target = target_of(load, tmp_path, ws.Picture(pixels, exposure=0), "photo.png")
    np.testing.assert_allclose(target.image, pixels, atol=2 * EIGHT_BITS)


def test_a_gray_photograph_becomes_rgb(load, tmp_path):
    target = target_of(load, tmp_path, np.full((6, 8, 1), 0.25, np.float32), "photo.png")
    np.testing.assert_allclose(target.image, np.full((6, 8, 3), 0.25), atol=EIGHT_BITS)


@pytest.mark.parametrize("name", ["mask.png", "mask.exr"])
@pytest.mark.parametrize("channel_count", [1, 3, 4])
def test_a_mask_counts_as_it_is_stored(load, tmp_path, name, channel_count):
    """Code 128 of a PNG is a half, not a fifth as it were as light."""
    stored = np.linspace(0, 1, 48).reshape(6, 8)
    pixels = srgb_to_linear(stored) if name == "mask.png" else stored
    pixels = np.repeat(pixels[..., None], channel_count, axis=2)
    pixels[..., 3:] = 1
    ws.write_image(tmp_path / name, pixels if name == "mask.exr" else ws.Picture(pixels, exposure=0))
    target = target_of(load, tmp_path, None, "photo.exr", f'mask = "{name}"\n')
    np.testing.assert_allclose(target.mask, stored, atol=0.5 / 255 + 1e-5 if name == "mask.png" else 1e-6)


@pytest.mark.parametrize("channels", [(1, 0, 0), (1, 1, 1, 0.5)])
def test_a_mask_of_colors_or_with_transparency_is_refused(refused, tmp_path, channels):
    ws.write_image(tmp_path / "mask.png", np.broadcast_to(np.float32(channels), (6, 8, len(channels))))
    text = MINIMAL.replace("[free]", 'mask = "mask.png"\n[free]')
    refused(text, "1st [[target]]", "mask: got colors or transparency in", "mask.png, expected gray")


def test_a_target_may_have_a_camera_of_the_images_size(load):
    text = MINIMAL.replace("[free]", "[target.camera]\neye = [1, 1, 4]\ntarget = [0, 0, 0]\nfov_y = 30\n[free]")
    camera = load(text).problem.targets[0].camera
    expected = ws.Camera.look_at((1, 1, 4), (0, 0, 0), fov_y=30, size=(8, 6))
    np.testing.assert_array_equal(camera.clip_matrix(), expected.clip_matrix())


def test_the_cameras_that_a_fit_writes_can_be_given(load):
    lines = (
        "[target.camera]\nintrinsics = [[9, 0, 4], [0, 9, 3], [0, 0, 1]]\n"
        "rotation = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]\ntranslation = [0, 0, 4]\n"
    )
    camera = load(MINIMAL.replace("[free]", lines + "[free]")).problem.targets[0].camera
    assert (camera.intrinsics[0, 0], camera.width, camera.height) == (9, 8, 6)


def test_several_views_are_several_targets(load, tmp_path):
    ws.write_image(tmp_path / "two.exr", np.full((6, 8, 3), 0.25, np.float32))
    first, second = load(MINIMAL.replace("[free]", '[[target]]\nimage = "two.exr"\n[free]')).problem.targets
    assert first.image.mean() == 0.5 and second.image.mean() == 0.25


# ---------------------------------------------------------------------------------------------- what is wrong


@pytest.mark.parametrize(
    ("text", "where", "nearest"),
    [
        (MINIMAL + "[optimiser]\n", "the fit", "optimizer"),
        (MINIMAL.replace("image", "imege"), "1st [[target]]", "image"),
        (MINIMAL.replace("[free]", "[target.camera]\neyes = 1\n[free]"), "1st [[target]]: camera", "eye"),
        (MINIMAL + "exposur = true\n", "[free]", "exposure"),
        (MINIMAL.replace("true", "{ordr = 3}"), "[free] light", "order"),
        (MINIMAL + "camera = {focus = true}\n", "[free] camera", "focal"),
        (MINIMAL + "[[free.pose]]\nbody = 0\n[[free.pose]]\nbdy = 1\n", "2nd [[free.pose]]", "body"),
        (MINIMAL + '[loss]\nkin = "l1"\n', "[loss]", "kind"),
        (MINIMAL + "[still]\nsample = 3\n", "[still]", "samples"),
        (MINIMAL + "[optimizer]\nbeta = 3\n", "[optimizer]", "betas"),
        (MINIMAL + "[[stage]]\niteration = 3\n", "1st [[stage]]", "iterations"),
    ],
)
def test_an_unknown_key_of_any_table_names_the_nearest_known_key(refused, text, where, nearest):
    refused(text, f"{where}: unknown key", f"did you mean '{nearest}'?")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["scene is missing", "[[target]]", "[free]"]),
        (MINIMAL[: MINIMAL.index("[free]")], ["free is missing"]),
        (MINIMAL.replace("[[target]]", "[target]"), ["[target]: expected [[target]]"]),
        (MINIMAL.replace("light = true", ""), ["free: got none"]),
        (MINIMAL.replace('image = "photo.exr"', ""), ["1st [[target]]", "image: missing, expected a file name"]),
        (MINIMAL + "[free.pose]\nbody = 0\n", ["[free.pose]: expected [[free.pose]]"]),
        (MINIMAL + "pose = true\n", ["[free] pose: got true, expected a table for each body:\n[[free.pose]]\nbody = "]),
        (MINIMAL + "[[free.pose]]\n", ["1st [[free.pose]]", "body: missing, expected the number of a body"]),
        (
            MINIMAL + "[[free.pose]]\nbody = 2\n",
            ["1st [[free.pose]]", "body: got 2, expected the number of a body, from 0 to 1"],
        ),
        (MINIMAL + "[[free.pose]]\nbody = 0\n[[free.pose]]\nbody = 0\n", ["free: got pose[0] twice"]),
        (MINIMAL + "[[free.texture]]\nbody = 0\n", ["1st [[free.texture]]", "whose mesh has no uvs"]),
        (MINIMAL.replace("true", "3"), ["[free] light", "3", "table"]),
        (MINIMAL.replace("true", "{order = 3, directions = 16}"), ["[free] light", "order, directions", "one of them"]),
        ('stages = "poses"\n' + MINIMAL, ["stages: got 'poses'", "did you mean 'pose'"]),
        ('stages = "pose"\n' + MINIMAL + "[[stage]]\n", ["either stages or [[stage]]"]),
        (MINIMAL + "loss = 3\n", ["[free]", "unknown key 'loss'"]),
        (MINIMAL + '[optimizer]\nname = "adamw"\n', ["[optimizer]", "did you mean 'adam'"]),
        (MINIMAL + '[optimizer]\nname = "sgd"\nbetas = [0, 1]\n', ["[optimizer]", "unknown key 'betas'"]),
        (MINIMAL + "x =", ["not valid TOML"]),
    ],
)
def test_missing_and_contradictory_keys_say_what_is_accepted(refused, text, parts):
    refused(text, *parts)


NOT_A_NUMBER = ('"1"', "true", "[1]", "nan", "inf")
NOT_WHOLE = ('"1"', "true", "[1]", "2.0")
NOT_TRUE_OR_FALSE = ("1", '"yes"', "[true]")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "key", "values"),
    [
        ("", "tolerance", NOT_A_NUMBER),
        ("", "seed", NOT_WHOLE),
        ("[[stage]]", "iterations", (*NOT_WHOLE, "0")),
        ("[[stage]]", "candidates", (*NOT_WHOLE, "0")),
        ("[[stage]]", "learning_rate", (*NOT_A_NUMBER, "0")),
        ("[[stage]]", "scale", (*NOT_A_NUMBER, "0", "2")),
        ("[[stage]]", "softness", (*NOT_A_NUMBER, "-1")),
        ("[[stage]]", "directions", (*NOT_WHOLE, "7")),
        ("[[stage]]", "supersampling", (*NOT_WHOLE, "17")),
        ("[loss]", "kind", ("3", '"l3"')),
        ("[loss]", "delta", (*NOT_A_NUMBER, "0")),
        ("[still]", "method", ("3", '"rays"')),
        ("[still]", "samples", (*NOT_WHOLE, "0")),
        ("[optimizer]", "name", ("3", '["adam"]')),
        ("[optimizer]", "betas", ("3", "[0.5]", '["a", 1]', "[0.5, 0.5, 0.5]")),
        ("[[free.pose]]\nbody = 0", "rotation", ("3", '"euler"')),
        ("[[free.pose]]\nbody = 0", "scale", NOT_TRUE_OR_FALSE),
        ("[[free.texture]]\nbody = 0", "size", ("3", "[3]", "[3, 4.5]", "[true, 3]")),
        ("[[free.texture]]\nbody = 0", "smoothness", (*NOT_A_NUMBER, "-1")),
        ("[[free.texture]]\nbody = 0", "total_variation", (*NOT_A_NUMBER, "-1")),
        ("[[free.texture]]\nbody = 0", "palette", (*NOT_A_NUMBER, "-1")),
        ("[[free.texture]]\nbody = 0", "colors", (*NOT_WHOLE, "1")),
        ("[[free.deformation]]", "body", NOT_WHOLE),
    ],
)
def test_a_wrong_value_is_refused_with_its_key_and_what_is_accepted(refused, table, key, values):
    for value in values:
        line = f"{key} = {value}\n"
        refused(MINIMAL + f"{table}\n{line}" if table else line + MINIMAL, f"{key}: got", "expected")


def test_an_option_out_of_an_optimizers_range_is_refused_before_the_fit(refused):
    refused(MINIMAL + "[optimizer]\nbetas = [2, 0.9]\n", "[optimizer]", "beta")
    refused(MINIMAL + '[optimizer]\nname = "sgd"\nmomentum = -1\n', "[optimizer]", "momentum")


@pytest.mark.parametrize("name", ["scene.toml", "photo.exr"])
def test_a_missing_file_is_named(refused, name):
    refused(MINIMAL.replace(name, "no"), "no such file", "no", error=FileNotFoundError)


def test_a_missing_mask_is_named(refused):
    text = MINIMAL.replace("[free]", 'mask = "no.png"\n[free]')
    refused(text, "1st [[target]]", "mask: no such file", error=FileNotFoundError)


def test_a_missing_fit_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.toml: no such fit file"):
        load_fit(tmp_path / "none.toml")


def test_a_mistake_in_the_scene_names_both_files(refused, tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE.replace("eye", "eyes"))
    refused(MINIMAL, "scene.toml: [camera]", "did you mean 'eye'")


def test_images_of_other_proportions_need_a_camera(refused, tmp_path):
    ws.write_image(tmp_path / "wide.exr", np.ones((6, 16, 3), np.float32))
    refused(MINIMAL.replace("photo", "wide"), "16 × 6", "8 × 6")


def test_a_mask_of_another_size_is_refused(refused, tmp_path):
    ws.write_image(tmp_path / "mask.png", linear_to_srgb(np.ones((3, 4, 1), np.float32)))
    refused(MINIMAL.replace("[free]", 'mask = "mask.png"\n[free]'), "1st [[target]]", "mask: got shape")


# ---------------------------------------------------------------------------------------------- running it


def test_a_loaded_fit_runs_with_its_stages_optimizer_tolerance_and_seed(load, monkeypatch):
    got = {}
    monkeypatch.setattr("warpshadow.inverse.fit_file.fit", lambda *args, **options: got.update(options, args=args))
    fit = load("tolerance = 0.5\nseed = 3\n" + MINIMAL + '[optimizer]\nname = "sgd"\n')
    fit.run(device="cpu", progress=True)
    assert isinstance(fit.optimizer, functools.partial)
    expected = {"optimizer": fit.optimizer, "tolerance": 0.5, "seed": 3, "device": "cpu", "progress": True}
    assert got == expected | {"args": (fit.problem, fit.stages)}
