"""The layer "shadow": direct light, divided by the same light without blockers."""

from dataclasses import replace

import numpy as np
import warp as wp

from warpshadow.device.memory import empty
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.methods.by_name import make_method
from warpshadow.pipeline.node import Call, Input, Node
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.pipeline.views.view import View
from warpshadow.stages.receivers.receivers import Receivers


def shading_ratio(view: View, call: Call) -> np.ndarray:
    """Divide a view's white image in the map's direct light by that without blockers; 1 where there is no light.

    Returns:
        float32 of shape [view, height, width, 3].
    """
    device, scene = view.merged_scene.device, view.merged_scene.scene
    bodies = tuple(replace(body, blockers=0) for body in scene.bodies)
    without_blockers = make_method(MergedScene(replace(scene, bodies=bodies), device=device), None)
    receivers = Node("", Receivers.without_bodies, view.receivers_node)
    spheres = Input("spheres", tuple(empty((1, 0), dtype=dtype, device=device) for dtype in (wp.vec3, wp.float32)))
    free = ShadingContext(without_blockers.merged_scene, view.materials, view.vertices, spheres, receivers, call)
    methods_and_points = (view.method, view), (without_blockers, free)
    shadings = [method.direct_shading_node(points, method.light) for method, points in methods_and_points]
    images = (view.white_image(shading).value(call) for shading in shadings)
    received, unblocked = (image.numpy()[..., :3].copy() for image in images)
    return np.divide(received, unblocked, out=np.ones_like(received), where=unblocked > 0)
