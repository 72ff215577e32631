"""Sources and nodes: what is computed once, what is computed again, and what is said of it."""

import itertools

import numpy as np
import pytest
import warp as wp

from warpshadow.assets.known_light import HarmonicLight
from warpshadow.device.constants import collecting_constants
from warpshadow.device.tape import recorded
from warpshadow.pipeline.explain import Explanation, decide_which_nodes_run
from warpshadow.pipeline.node import Call, Clock, ExplainRow, Input, Node, detached


@pytest.fixture
def clock():
    return Clock()


def counting(name, log, **options):
    """Make nodes that add their inputs up, and note each time they do."""

    def add(*values):
        log.append(name)
        return sum(values)

    return lambda *inputs: Node(name, add, *inputs, **options)


def array(values=(1.0, 2.0), **options):
    return wp.array(np.array(values, np.float32), device="cpu", **options)


# ---------------------------------------------------------------------------------------------- values


def test_a_node_is_computed_once_for_all_that_ask(clock):
    log = []
    source = Input("vertices", 2)
    first = counting("first", log)(source, 1)
    second, third = counting("second", log)(first, first), counting("third", log)(first)
    total = counting("total", log)(second, third)
    assert [total.value(Call(clock)) for _ in range(2)] == [9, 9]
    assert log == ["first", "second", "third", "total"]


def test_a_node_that_keeps_its_value_asks_nothing_before_it(clock):
    log = []
    transfer = counting("transfer", log, caches=False)(Input("vertices", 2))
    shading = counting("shading", log)(transfer)
    for _ in range(3):
        assert shading.value(Call(clock)) == 2
    assert log == ["transfer", "shading"]
    assert transfer.value(Call(clock)) == 2  # which was thrown away
    assert log == ["transfer", "shading", "transfer"]


def test_what_a_call_may_not_keep_is_computed_once_in_it(clock):
    log = []
    source = Input("vertices", array(requires_grad=True))
    first = Node("first", lambda given: log.append("first") or 3, source)
    total = Node("total", lambda *given: log.append("total") or sum(given), first, first)
    for _ in range(2):
        assert total.value(Call(clock)) == 6
    assert log == ["first", "total"] * 2 and total.requires_grad and not total.is_cached


def test_nothing_is_kept_of_a_call_that_is_captured(clock):
    node = counting("node", [])(Input("vertices", 2))
    assert node.value(Call(clock, caches=False)) == 2 and not node.is_cached


def test_a_call_knows_what_another_found(clock):
    log = []
    node = counting("node", log, caches=False)(Input("vertices", 2))
    call = Call(clock)
    node.value(call)
    node.value(Call(clock, call))
    assert log == ["node"]


def test_a_source_is_made_when_it_is_first_asked_for():
    log = []
    source = Input("vertices", lambda: log.append("made") or 5)
    assert not log
    assert [source.value(), source.value()] == [5, 5] and log == ["made"]


# ---------------------------------------------------------------------------------------------- the same or another


def test_the_same_values_are_the_same_source():
    first = Input.renewed("vertices", array(), None)
    assert Input.renewed("vertices", array(), first) is first
    other = Input.renewed("vertices", array((1.0, 3.0)), first)
    assert other is not first and other.why_new == "vertices changed since the last call" and not first.why_new


def test_a_source_has_the_values_that_it_was_given():
    given = array()
    first = Input.renewed("vertices", given, None)
    given.zero_()
    assert first.value().numpy()[1] == 2
    assert Input.renewed("vertices", given, first) is not first


def test_a_write_that_torch_does_not_count_is_seen():
    numbers = np.ones((1, 3), np.float32)
    given = wp.array(numbers, dtype=wp.float32, device="cpu", copy=False)
    given.version = 7
    first = Input.renewed("radii", given, None)
    numbers[:] = 2
    assert given.numpy()[0, 0] == 2 and Input.renewed("radii", given, first) is not first


def test_on_a_gpu_an_array_of_a_tensor_that_was_not_written_to_is_the_same(monkeypatch):
    monkeypatch.setattr("warpshadow.pipeline.node.is_readable", lambda device: False)
    given, tensor, other = array(), object(), object()

    def again(origin, version):
        same = wp.array(ptr=given.ptr, shape=given.shape, dtype=given.dtype, device="cpu")
        same.origin, same.version = origin, version
        return same

    first = Input.renewed("spheres", (again(tensor, 7),), None)
    monkeypatch.setattr(np, "array_equal", None)  # values are not looked at
    assert Input.renewed("spheres", (again(tensor, 7),), first) is first
    assert Input.renewed("spheres", (again(tensor, 8),), first) is not first
    assert Input.renewed("spheres", (again(other, 7),), first) is not first  # versions of another begin at 0 again
    assert Input.renewed("spheres", (given,), first) is not first


def test_on_a_gpu_an_array_is_not_the_same_as_one_that_a_function_makes(monkeypatch):
    monkeypatch.setattr("warpshadow.pipeline.node.is_readable", lambda device: False)
    of_scene, given = Input("cameras", array), array()
    given.origin, given.version = object(), 7
    assert Input.renewed("cameras", given, of_scene) is not of_scene


def test_while_a_graph_is_captured_no_array_is_the_same(monkeypatch):
    """A graph has to hold the launches that its replays repeat on what is written to the array later."""
    given, tensor = array(), object()
    given.origin, given.version = tensor, 7
    first = Input.renewed("spheres", given, None)
    assert Input.renewed("spheres", given, first) is first
    monkeypatch.setattr(wp.Device, "is_capturing", True)
    assert Input.renewed("spheres", given, first) is not first


def test_values_that_were_there_before_are_noted_while_they_are_collected(clock):
    source = Input("vertices", array())
    node, other = Node("first", lambda given: [given], source), Node("second", type, source, caches=False)
    value = node.value(Call(clock))
    with collecting_constants() as held:
        node.value(Call(clock))
        other.value(Call(clock))
    assert [item is expected for item, expected in zip(held, (value, source.value()), strict=True)] == [True, True]


def test_what_has_a_gradient_is_never_the_same():
    given = array(requires_grad=True)
    first = Input.renewed("vertices", given, None)
    assert first.requires_grad and first.value() is given
    assert Input.renewed("vertices", given, first) is not first
    assert Input.renewed("vertices", array(), first) is not first


def test_coefficients_are_compared_and_other_things_are_what_they_are():
    first = Input.renewed("light", HarmonicLight(np.ones((4, 3))), None)
    assert Input.renewed("light", HarmonicLight(np.ones((4, 3))), first) is first
    assert Input.renewed("light", HarmonicLight(np.zeros((4, 3))), first) is not first
    sky = object()
    last = Input.renewed("light", sky, first)
    assert Input.renewed("light", sky, last) is last and Input.renewed("light", object(), last) is not last


# ---------------------------------------------------------------------------------------------- what is said


def wired(vertices=2, cameras=3, **options):
    """Silhouettes of what cameras see, which no gradient passes, and an image."""
    vertices = Input("vertices", vertices)
    cameras = Input("cameras", cameras, why_new="cameras changed since the last call")
    clip = Node("clip positions", lambda a, b: 1, vertices, cameras, items="4 vertices")
    silhouettes = Node("silhouettes", lambda clip: clip, clip, has_adjoint=False)
    normals = Node("normals", lambda a: 1, vertices)
    sides = Node("sides", lambda clip: clip, clip, why_idle="every body is closed")
    image = Node("image", lambda *given: sum(given), sides, detached(silhouettes), normals, caches=False)
    return image, {node.row.name: node for node in (clip, silhouettes, normals, sides, image)}


def test_each_node_says_why_it_runs_or_does_not(clock):
    image, nodes = wired()
    call = Call(clock)
    explanation = Explanation(image, call, clock.timings, is_host=True)
    whys = {name: (stage.forward.runs, stage.forward.why) for name, stage in explanation.stages.items()}
    assert whys == {
        "clip positions": (True, "cameras changed since the last call"),
        "sides": (False, "every body is closed"),
        "silhouettes": (True, "cameras changed since the last call"),
        "normals": (True, "nothing is cached yet"),
        "image": (True, "cameras changed since the last call"),
    }
    assert list(explanation.stages)[0] == "clip positions" and explanation["clip positions"].items == "4 vertices"
    image.value(call)
    decisions = decide_which_nodes_run(image, Call(clock))
    assert decisions[nodes["normals"]].why == "cached: vertices are the same"
    assert decisions[nodes["clip positions"]].why == "cached: vertices and cameras are the same"
    assert decisions[image].runs


def test_what_is_not_asked_for_is_left_out_for_the_reason_of_who_would_ask(clock):
    transfer = Node("transfer", lambda a: a, Input("vertices", 1), caches=False)
    shading = Node("shading", lambda a, b: a + b, transfer, Input("light", 2))
    shading.value(Call(clock))
    decisions = decide_which_nodes_run(shading, Call(clock))
    assert not decisions[transfer] and decisions[transfer].why == "cached: vertices and light are the same"


def test_an_explanation_computes_nothing(clock):
    node = Node("node", None, Input("vertices", lambda: pytest.fail("asked for")))
    assert Explanation(node, Call(clock), {}, is_host=True)["node"]


def test_gradients_pass_where_they_can(clock):
    image, _ = wired(array(requires_grad=True), array())
    explanation = Explanation(image, Call(clock), {}, is_host=True)
    backward = {name: stage.backward.runs for name, stage in explanation.stages.items()}
    assert backward == {"clip positions": True, "sides": False, "silhouettes": False, "normals": True, "image": True}
    assert explanation["normals"].forward.why == "a gradient to vertices is asked for"
    assert explanation["normals"].backward.why == "a gradient to vertices is asked for"
    assert explanation["silhouettes"].backward.why == "nothing before it requires a gradient"
    assert explanation["sides"].backward.why == "nothing is computed"


def test_a_detached_input_matters_and_gets_no_gradient(clock):
    vertices = Input("vertices", array(requires_grad=True))
    inputs = (detached(vertices, is_constant=is_constant) for is_constant in (False, True))
    fixed, constant = (Node("node", None, each) for each in inputs)
    assert fixed.requires_grad and not fixed.differentiated_inputs and list(fixed.root_inputs) == [vertices]
    assert not constant.requires_grad and not constant.root_inputs and not constant.dependencies[0].dependencies


# ---------------------------------------------------------------------------------------------- times


def test_parts_of_a_stage_and_of_its_adjoint_are_timed_together(clock, monkeypatch):
    """By a clock that ticks when it is looked at."""
    ticks = itertools.count()
    monkeypatch.setattr(clock, "now", lambda: next(ticks))
    stage = ExplainRow("transfer")
    node = Node("", None, Input("vertices", array(requires_grad=True)), rows=(stage,))
    with recorded() as tape:
        call = Call(clock)
        for _ in range(3):
            with node.timed(call, stage):
                pass
    timing = clock.timings["transfer"]
    assert timing.forward == 3 and timing.backward is None
    for _ in range(2):
        tape.backward()
        assert timing.backward == 3
    with node.timed(Call(clock), stage):
        pass
    assert clock.timings["transfer"].forward == 1 and clock.timings["transfer"].backward is None


def test_what_is_idle_takes_no_time(clock):
    node = Node("sides", lambda: 1, why_idle="every body is closed")
    assert node.value(Call(clock)) == 1 and not clock.timings
