"""The tables of materials: records have the fields that they list, and shapes tell images from rows."""

import dataclasses

import pytest

import warpshadow as ws
from warpshadow.pipeline.image_inputs import ImageInputs
from warpshadow.scene.material import GLOSS_ARGUMENTS, INPUTS_OF_BODIES


def test_each_row_is_an_argument_of_images_and_each_number_one_of_bodies():
    arguments, fields = ({item.name for item in dataclasses.fields(kind)} for kind in (ImageInputs, ws.Body))
    assert arguments >= set(INPUTS_OF_BODIES)
    assert fields >= set(GLOSS_ARGUMENTS)


@pytest.mark.parametrize(
    ("name", "shape", "is_image"),
    [
        ("albedo", (3,), False),
        ("albedo", (2, 5, 3), False),
        ("textures", (8, 8, 3), True),
        ("emission", (5, 3), False),
        ("emission", (2, 5, 3), False),
        ("emission", (2, 1, 3), False),
        ("emission", (8, 8, 3), True),
        ("emission", (1, 8, 5, 3), True),
        ("roughness", (), False),
        ("roughness", (5,), False),
        ("roughness", (2, 1), False),
        ("roughness", (2, 5), False),
        ("roughness", (2, 8), True),
        ("roughness", (1, 8, 5), True),
    ],
)
def test_a_shape_tells_an_image_from_rows_of_a_mesh_of_five_vertices(name, shape, is_image):
    assert INPUTS_OF_BODIES[name].is_image(shape, 5) == is_image
