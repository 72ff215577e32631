"""Time of videos: the set-up of a renderer, beside stills of all frames."""

from dataclasses import replace

import pytest

import warpshadow as ws
from warpshadow.tuning import video_time
from warpshadow.tuning.video_time import remark_on_stills, setup_seconds, still_seconds

BALL = ws.Body(ws.icosphere(subdivisions=2).transformed(scale=1.7), name="ball").on_ground()
SCENE = ws.Scene([BALL, ws.Body(ws.infinite_ground(6.0))], ws.synthetic_sky(height=16))


@pytest.fixture(autouse=True)
def nothing_is_fitted(monkeypatch):
    monkeypatch.setattr(video_time, "is_fitted", lambda *_, **__: False)


def test_a_few_frames_are_said_to_be_done_sooner_as_stills():
    assert "all 2 frames take about" in remark_on_stills(SCENE, 2)
    frame_count = int(setup_seconds(SCENE) / still_seconds(SCENE)) + 1
    assert remark_on_stills(SCENE, frame_count - 1) and not remark_on_stills(SCENE, frame_count)


def test_nothing_is_said_where_stills_would_be_by_another_method_or_bounce():
    assert not remark_on_stills(replace(SCENE, visibility=ws.Visibility("directional")), 2)
    assert not remark_on_stills(replace(SCENE, bounces=1), 2)


def test_nothing_is_said_where_the_set_up_is_on_disk(monkeypatch):
    monkeypatch.setattr(video_time, "is_fitted", lambda *_, **__: True)
    assert setup_seconds(SCENE) == 0 and not remark_on_stills(SCENE, 2)
