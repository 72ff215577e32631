"""How good an image is made follows from what images took."""

from warpshadow.viewer.quality import (
    FULL,
    MAX_MOVING_PIXELS,
    MIN_MOVING_PIXELS,
    MOVING_SECONDS,
    STILL_SECONDS,
    FrameRate,
)


def test_a_slow_motion_gets_fewer_pixels_down_to_a_least_and_a_quick_one_more_up_to_a_most():
    frame_rate = FrameRate()
    first = frame_rate.moving().pixels
    frame_rate.learn_from(MOVING_SECONDS)
    assert frame_rate.moving().pixels == first
    frame_rate.learn_from(2 * MOVING_SECONDS)
    assert frame_rate.moving().pixels == first // 2
    for _ in range(20):
        frame_rate.learn_from(10.0)
    assert frame_rate.moving().pixels == MIN_MOVING_PIXELS
    for _ in range(20):
        frame_rate.learn_from(0.0)
    assert frame_rate.moving().pixels == MAX_MOVING_PIXELS


def chain(seconds_a_pixel, canvas):
    """Pixels of the images of a page at rest, and what each takes."""
    frame_rate = FrameRate()
    quality, seconds = frame_rate.moving(), 0.0
    pixels, times = [], []
    while (quality := frame_rate.find_better(quality, seconds, canvas)) is not None:
        seconds = seconds_a_pixel * quality.pixels
        pixels.append(quality.pixels)
        times.append(seconds)
    return pixels, times


def test_at_rest_images_grow_to_the_canvas_and_no_further():
    assert chain(1e-7, 800 * 600)[0] == [256**2, 512**2, 800 * 600]
    assert chain(1e-7, 100 * 100)[0] == [100 * 100]
    assert chain(1e-9, 8000 * 6000)[0][-1] == FULL


def test_no_image_is_begun_that_would_take_too_long():
    pixels, times = chain(2e-6, 4000 * 3000)
    assert times[-1] <= STILL_SECONDS and pixels[-1] > 4e5
    assert chain(1e-4, 4000 * 3000)[0] == [256**2]
