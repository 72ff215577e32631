"""How good an image is made follows from what images took."""

from warpshadow.viewer.quality import FEWEST, FULL, LONGEST, MOST, SECONDS, Pace


def test_a_slow_motion_gets_fewer_pixels_down_to_a_least_and_a_quick_one_more_up_to_a_most():
    pace = Pace()
    first = pace.moving().pixels
    pace.took(SECONDS)
    assert pace.moving().pixels == first
    pace.took(2 * SECONDS)
    assert pace.moving().pixels == first // 2
    for _ in range(20):
        pace.took(10.0)
    assert pace.moving().pixels == FEWEST
    for _ in range(20):
        pace.took(0.0)
    assert pace.moving().pixels == MOST


def chain(seconds_a_pixel, canvas):
    """Pixels of the images of a page at rest, and what each takes."""
    pace = Pace()
    quality, seconds = pace.moving(), 0.0
    pixels, times = [], []
    while (quality := pace.better(quality, seconds, canvas)) is not None:
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
    assert times[-1] <= LONGEST and pixels[-1] > 4e5
    assert chain(1e-4, 4000 * 3000)[0] == [256**2]
